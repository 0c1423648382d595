"""A killed `track` continues from its checkpoint to the bytes of an undisturbed run."""

from __future__ import annotations

import errno
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import LoadedConfig, load_cameras, load_config
from stereophd.errors import InputError
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.outputs import disk, saved
from stereophd.io.outputs.disk import TEMPORARY_PREFIX
from stereophd.io.outputs.saved import decoder, encode
from stereophd.io.tables import writing
from stereophd.pipeline.runs import unfinished
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.tracking.associations import Associated, Associations
from stereophd.pipeline.tracking.loop import RunState

from ..test_stream import SINGLE
from .test_report_times import SCENE

pytestmark = pytest.mark.usefixtures("without_checks")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedConfig, Path]:
    folder = tmp_path_factory.mktemp("journal")
    (folder / "scene.yaml").write_text(SCENE)
    loaded = load_config(folder / "scene.yaml", ["simulate.duration_s=10.0"])
    simulate(loaded, folder / "scene")
    return loaded, folder / "scene" / "detections.parquet"


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class Killed(BaseException):
    """As an end of the process: nothing is caught or tidied up."""


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the state after every record, in small parts."""
    monkeypatch.setattr(unfinished, "KEEP_EVERY_S", 0.0)
    monkeypatch.setattr(unfinished, "MOST_SHARE", 1e9)
    monkeypatch.setattr(writing, "ROW_GROUP_ROWS", 7)
    monkeypatch.setattr(saved, "PART_BYTES", 5000)


def killed_after(monkeypatch: pytest.MonkeyPatch, records: int, run: Callable[[], Any]) -> None:
    """Run until so many states were kept."""
    count, keep = 0, UnfinishedRun.keep

    def counted(*arguments: Any) -> None:
        nonlocal count
        if count == records:
            raise Killed
        count += 1
        keep(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(UnfinishedRun, "keep", counted)
        with pytest.raises(Killed):
            run()


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize(
    "changes",
    [
        ["report.associations=true"],
        ["report.smooth={}"],
        ["report.min_track_length=1.0"],
        ["report.times=grid 0.35"],
        ["report.times=camera right"],
        ["report.max_position_std=1.0", "report.std_columns=true"],
        [
            "report.associations=true",
            "report.min_track_length=1.0",
            "report.std_columns=true",
            "report.max_position_std=1.0",
            "filter.extraction.confirm=0.05",  # short false tracks, which the least length leaves out
        ],
        ["report.min_track_length=100.0"],  # no track is that long: nothing is decided before the end
    ],
    ids=str,
)
def test_resume_gives_the_bytes_of_an_undisturbed_run(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: list[str]
) -> None:
    loaded, log = load_config(scene[0].path, changes), scene[1]
    track(loaded, log, tmp_path / "whole")
    whole = files(tmp_path / "whole")
    out = tmp_path / "out"
    for records in (3, 8, 1, 20):
        killed_after(monkeypatch, records, lambda: track(loaded, log, out, resume=True))
        assert list(out.glob("partial-*/state.saved"))
        assert not list(out.glob("*.parquet"))
    with pytest.raises(InputError, match="unfinished run; use `resume=True`"):
        track(loaded, log, out)
    track(loaded, log, out, resume=True)
    assert files(out) == whole


@pytest.mark.usefixtures("often")
def test_resume_with_uncertain_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their part of the tracks is found for many rows at once, and a kill divides these otherwise."""
    folder = Path(__file__).resolve().parents[3] / "sample_data"
    write_cameras(
        tmp_path / "cameras.yaml", load_cameras(folder / "hall" / "cameras.yaml").cameras, "m",
        covariance={"right.focal": [1e-5], "right.rotation_y": [0.0, 1e-6]},
    )  # fmt: skip
    loaded = load_config(folder / "hall.yaml", ["report.std_columns=true"], cameras_path=tmp_path / "cameras.yaml")
    log = tmp_path / "detections.parquet"
    table = pq.read_table(folder / "hall" / "detections.parquet")
    pq.write_table(table.filter(pc.less(table["time_s"], 3.0)), log)
    report = track(loaded, log, tmp_path / "whole")
    assert report["cameras_part"]["common_std"] > 0.0
    for records in (20, 3):
        killed_after(monkeypatch, records, lambda: track(loaded, log, tmp_path / "out", resume=True))
    track(loaded, log, tmp_path / "out", resume=True)
    assert files(tmp_path / "out") == files(tmp_path / "whole")


@pytest.mark.usefixtures("often")
def test_resume_of_an_estimator_of_one_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = load_config(SINGLE, ["simulate.duration_s=10.0"])
    simulate(loaded, tmp_path / "scene")
    log = tmp_path / "scene" / "detections.parquet"
    track(loaded, log, tmp_path / "whole")
    killed_after(monkeypatch, 5, lambda: track(loaded, log, tmp_path / "out"))
    track(loaded, log, tmp_path / "out", resume=True)
    assert files(tmp_path / "out") == files(tmp_path / "whole")


@pytest.mark.usefixtures("often")
def test_another_configuration_cannot_resume(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded, log = scene
    killed_after(monkeypatch, 3, lambda: track(loaded, log, tmp_path / "out"))
    other = load_config(loaded.path, [], 77)
    with pytest.raises(InputError, match="another configuration"):
        track(other, log, tmp_path / "out", resume=True)
    track(other, log, tmp_path / "out", resume=True, force=True)
    assert not list((tmp_path / "out").glob("partial-*"))


@pytest.mark.usefixtures("often")
def test_a_foreign_file_in_the_way_stays(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    mine = tmp_path / "out" / "partial-mine" / "notes.saved"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(InputError, match=r"notes\.saved"):
        track(*scene, tmp_path / "out", force=True)
    assert mine.read_text() == "mine"


def test_a_short_run_keeps_nothing(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    track(*scene, tmp_path / "out")
    assert sorted(files(tmp_path / "out")) == ["report.json", "scans.parquet", "tracks.parquet"]


def test_claims_to_one_event_are_kept_once() -> None:
    """A frame of very many detections: the state grows with their number, not with its square."""
    count = 2000
    rows = np.arange(count)
    event = Associated(1.0, "left", 7, np.zeros((count, 2)), rows, rows, np.ones(count))
    run = RunState(None, associations=Associations({-1: 5}, [event]))
    kind: Any = RunState
    content = encode(run)
    assert len(content) < 100 * count
    restored = decoder(kind[None])(content).associations
    assert restored.known == {-1: 5}
    assert restored.waiting[0].camera == "left"
    np.testing.assert_array_equal(restored.waiting[0].track_ids, rows)


def kinds(out: Path) -> set[str]:
    """Return what the files of the unfinished run hold."""
    return {re.sub(r"-\d{5}\.part$", "", path.name) for path in out.glob("partial-*/*")}


@pytest.mark.usefixtures("often")
def test_an_unfinished_run_keeps_a_state_and_rows_and_no_records(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for records in (5, 30):
        killed_after(monkeypatch, records, lambda: track(*scene, tmp_path / "out", force=True))
        assert kinds(tmp_path / "out") == {"state.saved", "scans.parquet", "tracks.parquet"}


@pytest.mark.usefixtures("often")
def test_killed_between_the_tables_and_the_end_continues(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    track(*scene, tmp_path / "whole")

    def raise_killed(*_: Any) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr("stereophd.pipeline.checks.run_checks.check_losses", raise_killed)
        with pytest.raises(Killed):
            track(*scene, out)
    with monkeypatch.context() as patch:
        # Nothing but the state after the last record is used: no event is tracked again.
        patch.setattr(UnfinishedRun, "keep", raise_killed)
        track(*scene, out, resume=True)
    assert files(out) == files(tmp_path / "whole")


def test_killed_before_the_first_state_begins_anew(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows without a state count for nothing, also without `resume`."""
    monkeypatch.setattr(writing, "ROW_GROUP_ROWS", 7)
    monkeypatch.setattr(saved, "PART_BYTES", 1)
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        # a process that is killed removes nothing
        patch.setattr("stereophd.pipeline.runs.unfinished.shutil.rmtree", lambda *_, **__: None)
        killed_after(monkeypatch, 20, lambda: track(*scene, out))
    assert kinds(out) == {"scans.parquet", "tracks.parquet"}
    (partial,) = out.glob("partial-*")
    (partial / f"{TEMPORARY_PREFIX}tracks.parquet-00009.part.tmp").touch()  # killed as it was made
    track(*scene, out)
    track(*scene, tmp_path / "whole")
    assert files(out) == files(tmp_path / "whole")


def test_an_error_before_the_first_state_leaves_nothing(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "ROW_GROUP_ROWS", 7)
    monkeypatch.setattr(saved, "PART_BYTES", 1)
    killed_after(monkeypatch, 20, lambda: track(*scene, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("name", ["tracks.parquet-00000.part", "state.saved"])
@pytest.mark.parametrize("damage", ["cut off", "link", "another's"])
def test_what_is_damaged_or_not_ours_is_refused(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, damage: str
) -> None:
    out = tmp_path / "out"
    killed_after(monkeypatch, 20, lambda: track(*scene, out))
    (path,) = out.glob(f"partial-*/{name}")
    content = path.read_bytes()
    if damage == "cut off":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "another's":
        path.write_bytes(b"mine")
    else:
        path.rename(tmp_path / "mine")
        path.symlink_to(tmp_path / "mine")
    before = files(tmp_path)
    with pytest.raises(InputError, match=name):
        track(*scene, out, resume=True)
    assert files(tmp_path) == before


@pytest.mark.usefixtures("often")
def test_a_full_disk_is_an_error_that_names_the_folder(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    out = tmp_path / "out"
    killed_after(monkeypatch, 20, lambda: track(*scene, out))
    with monkeypatch.context() as patch:
        patch.setattr(disk, "sync", full)
        with pytest.raises(InputError, match=r"cannot write .*tracks\.parquet-\d+\.part: No space left"):
            track(*scene, out, resume=True)
    track(*scene, out, resume=True)
    assert {path.name for path in out.iterdir()} == {"report.json", "scans.parquet", "tracks.parquet"}


def test_resume_tidies_up_after_a_run_that_was_killed_at_its_end(
    scene: tuple[LoadedConfig, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    track(*scene, out)
    whole = files(out)
    (out / f"{TEMPORARY_PREFIX}lock").write_text("process 1 on nowhere")
    track(*scene, out, resume=True)
    assert files(out) == whole
