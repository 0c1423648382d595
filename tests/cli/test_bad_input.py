"""Bad input ends `track` with exit code 2 and one clear sentence, and leaves nothing behind."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import io
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.cli.app import run
from stereophd.io.tables.writing import TableWriter

from .conftest import CONFIG, Outcome, write_config, write_log

Call = Callable[..., Outcome]
CAP_DAC_OVERRIDE = 1 << 1  # bits and version of linux/capability.h
CAPABILITY_VERSION_3 = 0x20080522


@contextlib.contextmanager
def obeying_permissions() -> Iterator[None]:
    """Root may write anywhere, but not in this block; skips where Linux does not let it give up that right.

    Another user would not do: it may not read root's Python, which imports modules while the command runs.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    thread = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION_3, 0)
    rights = (ctypes.c_uint32 * 6)()  # effective, permitted and inheritable ones, 32 of them at a time
    if not hasattr(libc, "capget") or libc.capget(thread, rights):
        pytest.skip("this system has no capabilities")
    before = rights[0]
    rights[0] &= ~CAP_DAC_OVERRIDE
    assert libc.capset(thread, rights) == 0, os.strerror(ctypes.get_errno())
    try:
        yield
    finally:
        rights[0] = before
        assert libc.capset(thread, rights) == 0, os.strerror(ctypes.get_errno())


def check(outcome: Outcome, expected: str, out: Path) -> None:
    """Exit code 2, one sentence with `expected` on stderr, nothing on stdout, and no output folder."""
    assert outcome.code == 2, outcome.err
    assert outcome.out == ""
    assert outcome.sentence.startswith("error: ")
    assert expected in outcome.sentence
    assert not out.exists()


def rewrite(log: Path, **columns: Any) -> None:
    """Replace columns of a log; None removes one."""
    table = pq.read_table(log)
    for name, column in columns.items():
        index = table.schema.names.index(name)
        table = table.remove_column(index) if column is None else table.set_column(index, name, column)
    pq.write_table(table, log)


def changed(log: Path, name: str, row: int, value: Any) -> pa.Array:
    """Return a column of a log with one value changed."""
    values = pq.read_table(log)[name].to_pylist()
    values[row] = value
    return pa.array(values)


@pytest.fixture
def track(call: Call, config: Path, log: Path, tmp_path: Path) -> Callable[..., None]:
    """Return a function that tracks and checks the error."""

    def function(expected: str, *options: str) -> None:
        check(call("track", config, log, "--out", tmp_path / "out", *options), expected, tmp_path / "out")

    return function


class TestConfiguration:
    def test_misspelt_key(self, track: Callable[..., None], config: Path) -> None:
        config.write_text(config.read_text().replace("velocity_std", "velocity_sdt"))
        line = config.read_text()[: config.read_text().index("velocity_sdt")].count("\n") + 1
        track(f"{config}:{line}: filter.birth.velocity_sdt: unknown key; did you mean velocity_std?")

    def test_negative_sigma(self, track: Callable[..., None], config: Path) -> None:
        track(
            "cameras.left.detector.sigma_px.0: expected a number > 0, found -1",
            "--set",
            "cameras.left.detector.sigma_px=[-1, 1]",
        )

    def test_rotation_that_is_none(self, track: Callable[..., None], config: Path) -> None:
        matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]]
        left = {**CONFIG["cameras"]["left"], "pose": {"center": [0, 0, 0], "rotation_matrix": matrix}}
        write_config(config, cameras={**CONFIG["cameras"], "left": left})
        track("cameras.left.pose.rotation_matrix: expected a rotation matrix")

    def test_no_filter(self, track: Callable[..., None]) -> None:
        track("filter", "--set", "filter=null")

    def test_no_cameras(self, track: Callable[..., None]) -> None:
        track("expected cameras", "--set", "cameras=null")

    def test_not_there(self, call: Call, log: Path, tmp_path: Path) -> None:
        outcome = call("track", tmp_path / "nothing.yaml", log, "--out", tmp_path / "out")
        check(outcome, "nothing.yaml: there is no such file", tmp_path / "out")


class TestLog:
    @pytest.mark.parametrize("name", ["time_s", "camera", "frame", "u_px", "v_px"])
    def test_missing_column(self, track: Callable[..., None], log: Path, name: str) -> None:
        rewrite(log, **{name: None})
        track(f"{log}: missing column {name}")

    def test_wrong_type(self, track: Callable[..., None], log: Path) -> None:
        rewrite(log, u_px=pq.read_table(log)["u_px"].cast(pa.string()))
        track(f"{log}: column u_px: expected type double, found string")

    def test_truncated(self, track: Callable[..., None], log: Path) -> None:
        os.truncate(log, log.stat().st_size // 2)
        track(f"{log}: expected a detection log (Parquet file), found one that is truncated or damaged")

    def test_damaged_inside(self, track: Callable[..., None], log: Path) -> None:
        content = log.read_bytes()
        log.write_bytes(content[:4] + b"\xff" * 200 + content[204:])
        track(f"{log}: the file is damaged or truncated")

    def test_empty_file(self, track: Callable[..., None], log: Path) -> None:
        log.write_bytes(b"")
        track(f"{log}: expected a detection log (Parquet file), found an empty file")

    def test_no_rows(self, track: Callable[..., None], log: Path) -> None:
        pq.write_table(pq.read_table(log).slice(0, 0), log)
        track(f"{log}: expected a detection log, found one without rows")

    def test_not_parquet(self, track: Callable[..., None], log: Path) -> None:
        log.write_text("time_s,camera,frame,u_px,v_px\n0,left,0,1,1\n")
        track(f"{log}: expected a detection log (Parquet file), found a CSV table; `stereophd import csv` turns it")

    def test_not_there(self, track: Callable[..., None], log: Path) -> None:
        log.unlink()
        track(f"{log}: there is no such file")

    def test_unknown_camera(self, track: Callable[..., None], log: Path) -> None:
        rewrite(log, camera=changed(log, "camera", 6, "lfet"))
        track(f"{log}: row 6: camera: expected one of the cameras left, right, found lfet; did you mean left?")

    def test_time_backwards(self, track: Callable[..., None], log: Path) -> None:
        rewrite(log, time_s=changed(log, "time_s", 12, -1.0))
        track(f"{log}: row 12: time_s: expected rows in order of time, found -1 after 1")

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("name", ["u_px", "v_px"])
    def test_non_finite_pixels(self, track: Callable[..., None], log: Path, name: str, value: float) -> None:
        rewrite(log, **{name: changed(log, name, 9, value)})
        track(f"{log}: row 9: u_px, v_px: expected finite numbers")

    def test_bad_rows_are_dropped_on_request(self, call: Call, config: Path, log: Path, tmp_path: Path) -> None:
        rewrite(log, u_px=changed(log, "u_px", 9, np.nan), camera=changed(log, "camera", 6, "lfet"))
        outcome = call("track", config, log, "--out", tmp_path / "out", "--set", "input.on_bad_row=drop")
        assert outcome.code == 0, outcome.err
        assert (tmp_path / "out" / "tracks.parquet").exists()


CSV_TEXT = "time_s,camera,frame,u_px,v_px\n0,left,0,1,1\n"
ORDER = "commands take the configuration first, then the logs"
WANTS_LOG = "expected a detection log (Parquet file), found"
WANTS_CONFIG = "expected a configuration (YAML), found"
WANTS_CAMERAS = "expected a file of cameras (YAML), found"
WANTS_TRACKS = "expected a table of tracks (Parquet file), found"
TURNS = "`stereophd import csv` turns it into a log"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["track", "LOG", "CONFIG"], f"LOG: {WANTS_CONFIG} a Parquet file; {ORDER}"),
        (["calibrate", "LOG", "CONFIG"], f"LOG: {WANTS_CONFIG} a Parquet file; {ORDER}"),
        (["simulate", "LOG"], f"LOG: {WANTS_CONFIG} a Parquet file; {ORDER}"),
        (["experiment", "LOG"], f"LOG: {WANTS_CONFIG} a Parquet file; {ORDER}"),
        (["track", "CSV", "LOG"], f"CSV: {WANTS_CONFIG} a CSV table; {TURNS}; {ORDER}"),
        (["track", "CONFIG", "LOG", "--cameras", "LOG"], f"LOG: {WANTS_CAMERAS} a Parquet file"),
        (["track", "CONFIG", "LOG", "--cameras", "CSV"], f"CSV: {WANTS_CAMERAS} a CSV table"),
        (["track", "CONFIG", "CSV"], f"CSV: {WANTS_LOG} a CSV table; {TURNS}"),
        (["track", "CONFIG", "CONFIG"], f"CONFIG: {WANTS_LOG} a YAML file; {ORDER}"),
        (["track", "CONFIG", "JSON"], f"JSON: {WANTS_LOG} a JSON file; `stereophd import`"),
        (["track", "CONFIG", "HDF5"], f"HDF5: {WANTS_LOG} an HDF5 file; `stereophd import`"),
        (["check", "CONFIG", "CSV"], f"CSV: {WANTS_LOG} a CSV table; {TURNS}"),
        (["init", "--log", "CSV"], f"CSV: {WANTS_LOG} a CSV table; {TURNS}"),
        (["info", "CSV"], f"report.json or an output folder, found a CSV table; {TURNS}"),
        (["evaluate", "CSV", "CSV", "--cutoff", "1"], f"CSV: {WANTS_TRACKS} a CSV table"),
        (["export", "csv", "CSV"], f"CSV: {WANTS_TRACKS} a CSV table"),
        (["import", "csv", "LOG"], "LOG: expected a file of format csv, found a Parquet file; a log needs no import"),
        (["import", "mot", "LOG"], "LOG: expected a file of format mot, found a Parquet file; a log needs no import"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_a_file_of_another_kind(
    call: Call, config: Path, log: Path, tmp_path: Path, words: list[str], expected: str
) -> None:
    """The refusal says what the file is, and what helps."""
    files = {"CONFIG": config, "LOG": log, "CSV": tmp_path / "d.csv", "JSON": tmp_path / "d", "HDF5": tmp_path / "h5"}
    files["CSV"].write_text(CSV_TEXT)
    files["JSON"].write_text('{"a": 1}')
    files["HDF5"].write_bytes(b"\x89HDF\r\n\x1a\n\0\0")
    out = tmp_path / "out"
    end = {"check": [], "info": [], "init": [out]}.get(words[0], ["--out", out])
    outcome = call(*(files.get(word, word) for word in words), *end)
    for name, path in files.items():
        expected = expected.replace(f"{name}: ", f"{path}: ")
    check(outcome, expected, out)


@pytest.mark.usefixtures("without_checks")  # of what is written, not of the log
class TestOutput:
    def test_a_folder_that_is_not_ours(self, call: Call, config: Path, log: Path, tmp_path: Path) -> None:
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "thesis.tex").write_text("precious")
        for options in ([], ["--force"]):
            outcome = call("track", config, log, "--out", tmp_path / "out", *options)
            assert outcome.code == 2
            assert (
                "found one with thesis.tex, which this command does not write; choose another folder"
                in outcome.sentence
            )
        assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]

    def test_a_file_in_its_place(self, call: Call, config: Path, log: Path) -> None:
        outcome = call("track", config, log, "--out", log)
        assert outcome.code == 2
        assert "expected a folder, found a file" in outcome.sentence

    def test_no_permission(self, call: Call) -> None:
        with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
            folder = Path(name)
            write_config(folder / "config.yaml")
            write_log(folder / "log.parquet")
            folder.chmod(0o555)
            stack.callback(folder.chmod, 0o755)
            if os.geteuid() == 0:
                stack.enter_context(obeying_permissions())
            words = (folder / "config.yaml", folder / "log.parquet", "--out", folder / "out")
            check(call("track", *words), "Permission denied", folder / "out")

    @pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
    def test_a_writer_that_fails(
        self, track: Callable[..., None], monkeypatch: pytest.MonkeyPatch, number: int
    ) -> None:
        def full(self: TableWriter) -> None:
            raise OSError(number, os.strerror(number), str(self.path))

        monkeypatch.setattr(TableWriter, "_flush", full)
        track(os.strerror(number))

    @pytest.mark.parametrize("command", ["simulate", "track"])
    def test_a_disk_that_fills_up(
        self, call: Call, config: Path, small_disk: Path, tmp_path: Path, command: str
    ) -> None:
        # Noise does not compress: these detections and their tracks need more than the disk has.
        if command == "simulate":
            words = [config, "--set", "cameras.left.detector.clutter_per_frame=900"]
        else:
            log = write_log(tmp_path / "long.parquet", frames=100, detections=20)
            words = [config, log, "--set", "filter.extraction={confirm: 1e-4, release: 1e-4}"]
        outcome = call(command, *words, "--out", small_disk / "out")
        # simulate estimates the size of its outputs before it begins
        expected = "on the disk" if command == "simulate" else "No space left on device"
        check(outcome, expected, small_disk / "out")
        assert list(small_disk.iterdir()) == []

    @pytest.fixture
    def small_disk(self, tmp_path: Path) -> Iterator[Path]:
        """A file system of 64 KB."""
        folder = tmp_path / "disk"
        folder.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
        try:
            done = subprocess.run(mount, capture_output=True, check=False)
        except OSError:
            pytest.skip("there is no mount command to make a small tmpfs with")
        if done.returncode:
            pytest.skip("no permission to mount a small tmpfs")
        yield folder
        subprocess.run(["umount", str(folder)], check=True)


def test_a_misspelt_target(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STEREOPHD_TARGET", "portabel")
    words = (write_config(tmp_path / "config.yaml"), write_log(tmp_path / "log.parquet"), "--out", tmp_path / "out")
    check(call("track", *words), "STEREOPHD_TARGET: expected portable or nothing, found 'portabel'", tmp_path / "out")


def test_without_room_for_the_message_the_exit_code_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr("sys.stderr", Full())
    assert run(["track", "missing.yaml", "missing.parquet"]) == 2
