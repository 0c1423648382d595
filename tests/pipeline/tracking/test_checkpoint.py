"""A killed `track` continues from its checkpoint to the bytes of an undisturbed run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stereophd.io.outputs.columns import pack, unpack

from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import TEMPORARY_PREFIX
from stereophd.io.outputs.provenance import sha256_of
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.tracking import checkpoint, table_journal
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
    """Keep the state after every record, and two records in a chunk at most."""
    monkeypatch.setattr(checkpoint, "KEEP_EVERY_S", 0.0)
    monkeypatch.setattr(checkpoint, "MOST_SHARE", 1e9)


def killed_after(monkeypatch: pytest.MonkeyPatch, records: int, run: Callable[[], Any]) -> None:
    """Run until so many records were kept."""
    count = 0

    def counted(add: Callable[..., None]) -> Callable[..., None]:
        def one_more(*arguments: Any) -> None:
            nonlocal count
            if count == records:
                raise Killed
            count += 1
            add(*arguments)

        return one_more

    with monkeypatch.context() as patch:
        for kind in (checkpoint.RecordJournal, table_journal.TableJournal):
            patch.setattr(kind, "add", counted(kind.add))
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
        assert list(out.glob("partial-*/state.npz"))
        assert not list(out.glob("*.parquet"))
    with pytest.raises(InputError, match="unfinished run; use `resume=True`"):
        track(loaded, log, out)
    track(loaded, log, out, resume=True)
    assert files(out) == whole


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
    mine = tmp_path / "out" / "partial-mine" / "notes.npz"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(InputError, match=r"notes\.npz"):
        track(*scene, tmp_path / "out", force=True)
    assert mine.read_text() == "mine"


def test_a_short_run_keeps_nothing(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    track(*scene, tmp_path / "out")
    assert sorted(files(tmp_path / "out")) == ["report.json", "scans.parquet", "tracks.parquet"]


@dataclass(frozen=True)
class Inner:
    """Part of a `Thing`."""

    rows: Any


@dataclass(frozen=True)
class Thing:
    """A class with a field of each kind."""

    number: float
    text: str
    maybe: float | None
    inner: Inner
    counts: dict[int, dict[str, int]]
    scalar: Any
    many: tuple[Inner, ...] = ()


def test_claims_to_one_event_are_kept_once() -> None:
    """A frame of very many detections: the state grows with their number, not with its square."""
    count = 2000
    rows = np.arange(count)
    event = Associated(1.0, "left", 7, np.zeros((count, 2)), rows, np.ones(count))
    run = RunState(None, associations=Associations({-1: 5}, {int(label): [(event, int(label))] for label in rows}))
    saved = checkpoint.SavedRun.of(run, [])
    assert len(saved.claimed) == 1
    restored = saved.run_state(None).associations
    assert restored.known == {-1: 5}
    assert restored.pending == run.associations.pending


def test_columns_give_equal_objects() -> None:
    things = [
        Thing(0.1 * k, "ab"[k % 2], None if k % 3 else 1.5, Inner(np.full((k, 2), k / 3)), {k: {"a": 1}} if k else {},
              np.float64(k), (Inner(np.full(k, 0.1)),) * (k % 3))
        for k in range(5)
    ]  # fmt: skip
    back = unpack(pack(things), {"Thing": Thing, "Inner": Inner})
    for one, other in zip(things, back, strict=True):
        assert repr(one) == repr(other)
        assert one.inner.rows.tobytes() == other.inner.rows.tobytes()


def test_a_value_without_a_column_is_a_fault_of_the_program() -> None:
    with pytest.raises(TypeError, match="rows"):
        pack([Inner(object())])


def test_resume_tidies_up_after_a_run_that_was_killed_at_its_end(
    scene: tuple[LoadedConfig, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    track(*scene, out)
    whole = files(out)
    (out / f"{TEMPORARY_PREFIX}lock").write_text("process 1 on nowhere")
    identity = sha256_of(json.loads(whole["report.json"])["provenance"])
    left = UnfinishedRun(out, identity).folder
    left.mkdir()
    (left / "state.npz").write_bytes(b"")
    track(*scene, out, resume=True)
    assert files(out) == whole
    assert not left.exists()
