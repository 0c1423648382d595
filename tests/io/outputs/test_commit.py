"""The files of a run come into their places in one step, whichever move fails and whenever the process is killed."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

import pytest

import stereophd.io.outputs.commit as commit
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.commit import MOVING_IN, MOVING_OUT, refuse_unsettled, settle
from stereophd.io.outputs.disk import TEMPORARY_PREFIX

NAMES = ["tracks.parquet", "report.json", "scans.parquet", "run-*/truth.parquet"]
OLD = {"tracks.parquet": "old", "report.json": "old", "run-0007/truth.parquet": "old"}
NEW = {"tracks.parquet": "new", "scans.parquet": "new", "run-0001/truth.parquet": "new"}

# More than there are calls of os.replace in one run.
MOST_CALLS = 20


def contents(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def seen(folder: Path) -> dict[str, str]:
    """Return what a reader sees."""
    return {name: text for name, text in contents(folder).items() if not name.startswith(TEMPORARY_PREFIX)}


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


@pytest.fixture(params=["exchange", "moves"])
def ways(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The system can exchange two folders, or it cannot."""
    if request.param == "moves":
        monkeypatch.setattr(commit, "_exchange", lambda one, other: False)
    return str(request.param)


@pytest.mark.parametrize("before", [{}, OLD], ids=["empty", "earlier run"])
def test_each_failing_move_leaves_the_old_files_or_the_new_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: dict[str, str], ways: str
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
    if ways == "moves":  # back from beside, the staged folder, old entries, the change of the name, new entries
        assert failed == 2 + (3 if before else 0) + 1 + 3


@pytest.mark.parametrize("before", [{}, OLD], ids=["empty", "earlier run"])
def test_each_failing_flush_leaves_the_old_files_or_the_new_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: dict[str, str], ways: str
) -> None:
    """What is in its place when the disk refuses to confirm it is a run that has succeeded."""
    for failing in range(1, MOST_CALLS):
        out, counter = tmp_path / f"{failing}" / "out", [0]
        write(out, before)

        def fails_once(descriptor: int, failing: int = failing, counter: list[int] = counter) -> None:
            counter[0] += 1
            if counter[0] == failing:
                raise OSError(errno.EIO, "Input/output error")

        monkeypatch.setattr(os, "fsync", fails_once)
        expected = before
        with contextlib.suppress(InputError):
            run(out, force=True)
            expected = NEW
        assert contents(out) == expected, failing
        assert {path.name for path in out.parent.glob("*")} <= {"out"}


def test_a_disk_that_refuses_every_move_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commit, "_exchange", lambda one, other: False)
    write(tmp_path, OLD)
    replace, counter = os.replace, [0]

    def fails_from_the_sixth(source: Path, target: Path) -> None:
        counter[0] += 1
        if counter[0] >= 6:
            raise OSError(errno.EIO, "Input/output error", str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", fails_from_the_sixth)
    with pytest.raises(InputError, match="cannot write"):
        run(tmp_path, force=True)
    monkeypatch.setattr(os, "replace", replace)
    settle(tmp_path)
    assert seen(tmp_path) == OLD


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked process")
@pytest.mark.parametrize("before", [{}, OLD], ids=["fresh", "earlier run"])
@pytest.mark.parametrize("way", ["exchange", "moves"])
def test_killed_at_any_step_the_next_command_finds_one_run(tmp_path: Path, before: dict[str, str], way: str) -> None:
    outcomes, refused = set(), 0
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
            as_left = contents(out)
            try:
                refuse_unsettled(out / "tracks.parquet")
                assert seen(out) in (before, NEW), f"step {step}"
            except InputError:
                refused += 1
            assert contents(out) == as_left  # a reader changes nothing
            settle(out)
            assert seen(out) in (before, NEW), f"step {step}"
            outcomes.add(seen(out) == NEW)
        # what is left over goes with the next run
        run(out, force=True)
        assert contents(folder) == {f"out/{name}": text for name, text in NEW.items()}, f"step {step}"
        if not killed:
            break
    assert not killed
    assert outcomes == {True, False}
    assert (refused > 0) == (way == "moves")


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


@pytest.mark.parametrize("name", [MOVING_OUT, MOVING_IN])
def test_what_a_received_folder_holds_moves_nothing_elsewhere(tmp_path: Path, name: str) -> None:
    gift, home = tmp_path / "gift", tmp_path / "home"
    write(home, {".bashrc": "mine", "thesis.tex": "keep"})
    gift.mkdir()
    (gift / "sub").symlink_to(home)
    for inside in ("new", "old"):
        write(gift / name / inside / "sub", {".bashrc": "evil"})
    with pytest.raises(InputError, match="a run was killed while it moved its files into"):
        refuse_unsettled(gift / "tracks.parquet")
    with pytest.raises(InputError, match="cannot be moved now"):
        settle(gift)
    assert contents(home) == {".bashrc": "mine", "thesis.tex": "keep"}


@pytest.mark.parametrize("name", [MOVING_OUT, MOVING_IN])
def test_a_link_in_place_of_a_staged_folder_is_not_followed(tmp_path: Path, name: str) -> None:
    home = tmp_path / "home"
    write(home, {"new/a": "mine", "old/a": "mine"})
    (tmp_path / "gift").mkdir()
    (tmp_path / "gift" / name).symlink_to(home)
    settle(tmp_path / "gift")
    run(tmp_path / "gift", force=True)
    assert contents(home) == {"new/a": "mine", "old/a": "mine"}
    assert contents(tmp_path / "gift") == NEW


@pytest.mark.usefixtures("ways")
def test_a_file_that_came_during_the_run_stays(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, OLD)
    with OutputFolder(out, NAMES, force=True) as folder:
        for name, text in NEW.items():
            folder.path(name).write_text(text)
        (out / "notes.txt").write_text("mine")
    assert contents(out) == {**NEW, "notes.txt": "mine"}


@pytest.mark.usefixtures("ways")
def test_an_empty_folder_of_the_user_stays(tmp_path: Path) -> None:
    write(tmp_path / "out", OLD)
    (tmp_path / "out" / "mine").mkdir()
    run(tmp_path / "out", force=True)
    assert (tmp_path / "out" / "mine").is_dir()
    assert contents(tmp_path / "out") == NEW


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
