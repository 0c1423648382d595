"""Documents made to harm: each is refused within bounds of time and memory, whatever it claims."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import resource
import signal
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from stereophd.cli.app import run
from stereophd.errors import InputError
from stereophd.io import documents

# Beyond what this process has: far more than a command takes, and far less than what these documents expand to.
MOST_CPU_S, MOST_MEMORY_BYTES = 20, 3_000_000_000
# A fork that waits for a thread which it does not have takes no time of the processor.
MOST_WALL_S = 300

ALIASES = "a: &a [1,2,3,4,5,6,7,8,9]\n" + "".join(
    f"{b}: &{b} [{','.join(9 * [f'*{a}'])}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGES = "a: &a {}\n" + "".join(
    f"{b}: &{b} {{<<: [{','.join(9 * [f'*{a}'])}]}}\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
ENTITIES = (
    '<!DOCTYPE l [<!ENTITY e0 "lollollol">'
    + "".join(f'<!ENTITY e{k} "{10 * f"&e{k - 1};"}">' for k in range(1, 10))
    + "]><opencv_storage>&e9;</opencv_storage>"
)
HEAD = b"camn,frame,timestamp,cam_received_timestamp,x,y\n"


def _braidz(info: bytes, table: bytes) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("cam_info.csv.gz", gzip.compress(info, 1))
        archive.writestr("data2d_distorted.csv.gz", gzip.compress(HEAD + table, 1))
    return target.getvalue()


def _npz(shape: tuple[int, ...], data: bytes) -> bytes:
    header, target = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("camera_matrix.npy", header.getvalue() + data)
    return target.getvalue()


def _long_frame() -> bytes:
    count, target = 4_000_000, io.BytesIO()
    zeros = np.zeros(count)
    names = pa.DictionaryArray.from_arrays(pa.array(zeros.astype(np.int32)), pa.array(["left"])).cast(pa.string())
    columns = {"time_s": zeros, "camera": names, "frame": zeros.astype(np.int64), "u_px": zeros, "v_px": zeros}
    pq.write_table(pa.table(columns), target, compression="zstd")
    return target.getvalue()


def _sleap(folder: Path) -> bytes:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "made.h5", "w") as file:
        file.create_dataset("tracks", shape=(1, 2, 3, 10**9), chunks=(1, 2, 3, 1000), dtype="f8")
        file["node_names"] = [b"a", b"b", b"c"]
    return (folder / "made.h5").read_bytes()


# name of the file -> its content, the command that reads it (FILE stands for it) and what the refusal says
HARMFUL: dict[str, tuple[Callable[[Path], bytes], str, str]] = {
    "aliases.yaml": (lambda _: ALIASES.encode(), "config check FILE", "expand without end"),
    "merges.yaml": (lambda _: MERGES.encode(), "config show FILE", "expand without end"),
    "deep.yaml": (lambda _: b"[" * 200_000, "config check FILE", "nested too deeply"),
    "foreign.yaml": (lambda _: b"%YAML:1.0\n" + ALIASES.encode(), "import opencv FILE --out OUT", "expand without end"),
    "seen.yaml": (lambda _: ALIASES.encode(), "info FILE", "expand without end"),
    "entities.xml": (lambda _: ENTITIES.encode(), "import opencv FILE --out OUT", "amplification"),
    "deep.xml": (lambda _: b"<opencv_storage>" + b"<a>" * 300_000, "import opencv FILE --out OUT", "expected"),
    "claim.npz": (lambda _: _npz((10**12,), b"\0" * 100), "import opencv FILE --out OUT", "claims an array"),
    "large.npz": (lambda _: _npz((6 * 10**7,), bytes(4 * 10**8)), "import opencv FILE --out OUT", "when unpacked"),
    "table.braidz": (
        lambda _: _braidz(b"camn,cam_id\n0,a\n", b"0,1,1,1,1,1\n" * 8_000_000),
        "import braid FILE --out OUT",
        "when unpacked",
    ),
    "info.braidz": (lambda _: _braidz(b"0" * 10**8, b""), "import braid FILE --out OUT", "when unpacked"),
    "instant.braidz": (
        lambda _: _braidz(b"camn,cam_id\n0,a\n", b"0,1,1,1,1,1\n0,1,1,1,2,2\n" * 1_500_000),
        "import braid FILE --out OUT",
        "at one time",
    ),
    "frames.analysis.h5": (_sleap, "import sleap FILE --out OUT", "that claim to be"),
    "rows.parquet": (lambda _: _long_frame(), "info FILE", "that claim to be"),
}


def run_bounded(words: list[str], said: Path) -> int:
    """Run a command in a fork of this process, which has loaded everything; return its exit code."""
    most_memory = psutil.Process().memory_info().vms + MOST_MEMORY_BYTES
    pid = os.fork()
    if pid == 0:
        code = 3
        try:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(MOST_WALL_S)
            resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_S, MOST_CPU_S))
            resource.setrlimit(resource.RLIMIT_AS, (most_memory, most_memory))
            with said.open("w") as stream, contextlib.redirect_stderr(stream):
                code = run(words)
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def test_a_command_that_never_ends_is_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(f"{__name__}.MOST_WALL_S", 1)
    monkeypatch.setattr(f"{__name__}.run", lambda words: threading.Event().wait())
    assert run_bounded([], tmp_path / "said") == -signal.SIGALRM


@pytest.mark.parametrize("name", HARMFUL)
def test_a_document_made_to_harm_is_refused(name: str, tmp_path: Path) -> None:
    make, command, expected = HARMFUL[name]
    file = tmp_path / name
    file.write_bytes(make(tmp_path))
    words = [str(file) if w == "FILE" else str(tmp_path / "out") if w == "OUT" else w for w in command.split()]
    code = run_bounded(words, tmp_path / "said")
    said = (tmp_path / "said").read_text()
    assert code == 2, said[-500:]
    assert expected in said
    assert not (tmp_path / "out").exists()


def test_aliases_and_merges_within_bounds_are_read() -> None:
    text = "a: &a {x: 1}\nb: [*a, *a]\nc: {<<: *a, y: 2}"
    expected = {"a": {"x": 1}, "b": [{"x": 1}, {"x": 1}], "c": {"x": 1, "y": 2}}
    assert documents.load_yaml(text, "file.yaml") == expected


def test_expanded_values_are_counted_without_expanding_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(documents, "MAX_NODES", 1000)
    # mappings and lists: 1 + 1 + (1 + 9) for the first, and so on; the limit is crossed by a known margin
    text = "- &a [1, 1]\n" + "- [" + ",".join(["*a"] * 330) + "]"
    documents.compose_yaml(text, "file.yaml", yaml.SafeLoader)  # 3 + 1 + 3 * 330 + 1 values
    with pytest.raises(InputError, match=r"file.yaml:2: expected a finite document"):
        documents.compose_yaml(text.replace("- [*a", "- [*a,*a,*a" + ",*a" * 4), "file.yaml", yaml.SafeLoader)


def test_an_array_that_an_archive_holds_is_read(tmp_path: Path) -> None:
    values = {"K": np.arange(9.0).reshape(3, 3), "n": np.array(3)}
    np.savez_compressed(tmp_path / "cameras.npz", **values)
    arrays = documents.load_npz(tmp_path / "cameras.npz")
    assert arrays.keys() == values.keys()
    np.testing.assert_array_equal(arrays["K"], values["K"])


def test_a_log_of_constants_within_bounds_is_no_false_claim(tmp_path: Path) -> None:
    pq.write_table(pa.table({"x": np.zeros(100_000)}), tmp_path / "flat.parquet", compression="zstd")
    documents.check_parquet(pq.ParquetFile(tmp_path / "flat.parquet").metadata, "flat.parquet")
