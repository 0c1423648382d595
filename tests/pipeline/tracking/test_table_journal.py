"""The tables of a killed run are continued from whatever the moment of the kill left of them."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stereophd.io.outputs.checkpoints import MARK, write_checkpoint
from stereophd.pipeline.tracking.table_journal import TableJournal

from stereophd.commands.track import track
from stereophd.config.loading import LoadedConfig
from stereophd.errors import InputError
from stereophd.io.tables import continued_tables
from stereophd.pipeline.tracking import table_journal
from stereophd.pipeline.tracking.checkpoint import SavedRun

from .test_checkpoint import Killed, files, killed_after, often, scene

__all__ = ["often", "scene"]

pytestmark = pytest.mark.usefixtures("without_checks", "often")

TABLES = {"scans.parquet.part", "tracks.parquet.part"}


@pytest.fixture
def whole(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> dict[str, bytes]:
    track(*scene, tmp_path / "whole")
    return files(tmp_path / "whole")


def kept(out: Path) -> dict[str, bytes]:
    """Return the files of the unfinished run."""
    return {Path(name).name: text for name, text in files(out).items() if name.startswith("partial-")}


def raise_killed(*_: Any) -> None:
    raise Killed


def test_an_unfinished_run_keeps_a_state_and_its_tables_and_no_records(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for records in (5, 30):
        killed_after(monkeypatch, records, lambda: track(*scene, tmp_path / "out", force=True))
        assert set(kept(tmp_path / "out")) == {"state.npz", *TABLES}


def test_killed_before_the_tables_were_moved(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, bytes]
) -> None:
    out, move = tmp_path / "out", table_journal.ContinuedTable.move
    for moves in (0, 1):
        left = iter(range(moves))

        def move_some(self: Any, path: Path) -> None:
            if next(left, None) is None:  # noqa: B023
                raise Killed
            move(self, path)

        with monkeypatch.context() as patch:
            patch.setattr(table_journal.ContinuedTable, "move", move_some)
            with pytest.raises(Killed):
                track(*scene, out, resume=True)
        assert "state.npz" in kept(out)
        assert len(TABLES & set(kept(out))) == moves
    track(*scene, out, resume=True)
    assert files(out) == whole


def test_killed_between_the_tables_and_the_end_continues(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, bytes]
) -> None:
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr("stereophd.commands.track.check_losses", raise_killed)
        with pytest.raises(Killed):
            track(*scene, out)
    assert set(kept(out)) == {"state.npz", *TABLES}
    with monkeypatch.context() as patch:
        # Nothing but the state after the last record is used: no event is tracked again.
        patch.setattr(TableJournal, "add", raise_killed)
        track(*scene, out, resume=True)
    assert files(out) == whole


def test_without_hard_links_the_tables_move(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, bytes]
) -> None:
    def refused(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(os, "link", refused)
        patch.setattr("stereophd.commands.track.check_losses", raise_killed)
        with pytest.raises(Killed):
            track(*scene, out)
    assert set(kept(out)) == {"state.npz"}
    track(*scene, out, resume=True)
    assert files(out) == whole


def test_a_copy_by_hard_links_stays_whole(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, bytes]
) -> None:
    out = tmp_path / "out"
    killed_after(monkeypatch, 20, lambda: track(*scene, out))
    shutil.copytree(out, tmp_path / "copy", copy_function=os.link)
    before = files(tmp_path / "copy")
    track(*scene, out, resume=True)
    assert files(out) == whole
    assert files(tmp_path / "copy") == before


def test_a_damaged_table_is_refused(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    killed_after(monkeypatch, 20, lambda: track(*scene, out))
    (part,) = out.glob("partial-*/tracks.parquet.part")
    part.write_bytes(part.read_bytes()[:3])
    with pytest.raises(InputError, match=r"tracks\.parquet\.part: .* damaged"):
        track(*scene, out, resume=True)


def test_the_state_of_another_version_is_refused(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    killed_after(monkeypatch, 20, lambda: track(*scene, out))
    (state,) = out.glob("partial-*/state.npz")
    with np.load(state) as archive:
        identity = json.loads(bytes(archive[MARK]))["identity"]
    write_checkpoint(state, identity, {"run": SavedRun(None, 0, 0.0, {}, np.zeros((0, 2)), np.zeros((0, 3)), [], [])})
    with pytest.raises(InputError, match="expected the state of a run, found something else"):
        track(*scene, out, resume=True)


def test_tables_without_a_state_are_not_ours(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    mine = tmp_path / "out" / "partial-mine" / "tracks.parquet.part"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(InputError, match=r"tracks\.parquet\.part"):
        track(*scene, tmp_path / "out", force=True)
    assert mine.read_text() == "mine"


def test_a_full_disk_is_an_error_that_names_the_folder(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    out = tmp_path / "out"
    killed_after(monkeypatch, 20, lambda: track(*scene, out))
    with monkeypatch.context() as patch:
        patch.setattr(continued_tables, "sync", full)
        with pytest.raises(InputError, match=r"cannot write .*out: No space left"):
            track(*scene, out, resume=True)
    track(*scene, out, resume=True)
    assert {path.name for path in out.iterdir()} == {"report.json", "scans.parquet", "tracks.parquet"}
