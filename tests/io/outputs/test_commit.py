"""The files of a run come into their places in one step, whichever move fails and whenever the process is killed."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

import stereophd.io.outputs.commit as commit
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import TEMPORARY_PREFIX, OutputFolder
from stereophd.io.outputs.commit import COMMIT_NAME, JOURNAL, complete

NAMES = ["tracks.parquet", "report.json", "scans.parquet", "run-*/truth.parquet"]
OLD = {"tracks.parquet": "old", "report.json": "old", "run-0007/truth.parquet": "old"}
NEW = {"tracks.parquet": "new", "scans.parquet": "new", "run-0001/truth.parquet": "new"}

# More than there are calls of os.replace in one run.
MOST_CALLS = 20


def contents(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def run(folder: Path, force: bool) -> None:
    with OutputFolder(folder, NAMES, force) as out:
        for name, text in NEW.items():
            out.path(name).write_text(text)


@pytest.fixture(autouse=True)
def no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@pytest.fixture(params=["exchange", "journal"])
def ways(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The system can exchange two folders, or it cannot."""
    if request.param == "journal":
        monkeypatch.setattr(commit, "_exchange", lambda one, other: False)
    return str(request.param)


@pytest.mark.usefixtures("ways")
@pytest.mark.parametrize("before", [{}, OLD], ids=["empty", "earlier run"])
def test_each_failing_move_leaves_the_old_files_or_the_new_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: dict[str, str]
) -> None:
    replace, counter = os.replace, [0]
    failed = 0
    for failing in range(1, MOST_CALLS):
        out = tmp_path / f"{failing}" / "out"
        write(out, before)
        counter[0] = 0

        def fails_once(source: Path, target: Path, failing: int = failing) -> None:
            counter[0] += 1
            if counter[0] == failing:
                raise OSError(errno.EIO, "Input/output error", str(source))
            replace(source, target)

        monkeypatch.setattr(os, "replace", fails_once)
        try:
            run(out, force=True)
        except InputError as error:
            failed += "cannot write" in str(error)
            assert contents(tmp_path / f"{failing}") == {f"out/{name}": text for name, text in before.items()}
        else:
            assert contents(out) == NEW
        monkeypatch.setattr(os, "replace", replace)
        assert not [p for p in out.parent.rglob("*") if p.name.startswith(TEMPORARY_PREFIX)]
        if counter[0] < failing:
            break
    assert counter[0] < failing, "expected fewer moves"
    assert failed >= (len(before) > 0) * (len(OLD) + len(NEW))


def test_a_disk_that_refuses_every_move_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, OLD)
    replace, counter = os.replace, [0]

    def fails_from_the_fourth(source: Path, target: Path) -> None:
        counter[0] += 1
        if counter[0] >= 4:
            raise OSError(errno.EIO, "Input/output error", str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", fails_from_the_fourth)
    with pytest.raises(InputError, match="cannot write"):
        run(tmp_path, force=True)
    monkeypatch.setattr(os, "replace", replace)
    complete(tmp_path)
    assert contents(tmp_path) == NEW


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked process")
@pytest.mark.parametrize("before", [{}, OLD], ids=["fresh", "earlier run"])
@pytest.mark.parametrize("way", ["exchange", "journal"])
def test_killed_at_any_step_the_next_command_finds_one_run(tmp_path: Path, before: dict[str, str], way: str) -> None:
    seen = set()
    for step in range(1, 100):
        folder = tmp_path / str(step)
        folder.mkdir()
        out = folder / "out"
        write(out, before)
        child = os.fork()
        if child == 0:
            _die_at(step, way, out)
        _, status = os.waitpid(child, 0)
        killed = os.WIFSIGNALED(status)
        if out.exists():
            complete(out)
            found = {k: v for k, v in contents(out).items() if not k.startswith(TEMPORARY_PREFIX)}
            assert found in (before, NEW), f"step {step}"
            seen.add(found == NEW)
        # what is left over goes with the next run
        run(out, force=True)
        assert contents(folder) == {f"out/{name}": text for name, text in NEW.items()}, f"step {step}"
        if not killed:
            break
    assert not killed
    assert seen == {True, False}


def _die_at(step: int, way: str, out: Path) -> None:
    """Run in a forked process that is killed before it changes the disk for the nth time."""
    left = [step]

    def deadly(function):  # type: ignore[no-untyped-def]
        def call(*arguments, **options):  # type: ignore[no-untyped-def]
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), 9)
            return function(*arguments, **options)

        return call

    try:
        for name in ("replace", "unlink", "rmdir", "link"):
            setattr(os, name, deadly(getattr(os, name)))
        commit._exchange = deadly(commit._exchange) if way == "exchange" else lambda one, other: False
        run(out, force=True)
    finally:
        os._exit(0)


def test_a_reader_completes_a_commit(tmp_path: Path) -> None:
    from stereophd.io.tables.reading import open_parquet

    write(tmp_path / COMMIT_NAME / "new", NEW)
    (tmp_path / COMMIT_NAME / JOURNAL).write_text('{"stale": ["report.json", "run-0007/truth.parquet"]}')
    write(tmp_path, OLD)
    with pytest.raises(InputError, match="not Parquet"):
        open_parquet(tmp_path / "tracks.parquet")
    assert contents(tmp_path) == NEW


def test_a_forged_journal_removes_nothing_elsewhere(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(tmp_path, {"precious": "p"})
    (out / COMMIT_NAME / "new").mkdir(parents=True)
    (out / COMMIT_NAME / JOURNAL).write_text('{"stale": ["../precious"]}')
    with pytest.raises(InputError, match="expected names of files in"):
        complete(out)
    assert (tmp_path / "precious").exists()


def test_the_folder_of_this_process_stays_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    inode = tmp_path.stat().st_ino
    run(Path(), force=False)
    assert contents(tmp_path) == NEW
    assert tmp_path.stat().st_ino == inode


def test_a_link_to_a_folder_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "real")
    run(tmp_path / "out", force=False)
    assert (tmp_path / "out").is_symlink()
    assert contents(tmp_path / "real") == NEW
