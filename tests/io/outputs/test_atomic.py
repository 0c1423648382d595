"""Outputs are there in full or not at all."""

from __future__ import annotations

import errno
import os
import signal
from pathlib import Path

import pytest

from stereophd.errors import InputError
from stereophd.io.outputs.atomic import OutputFolder, atomic_write, output_folder, temporary_beside
from stereophd.io.outputs.disk import TEMPORARY_PREFIX

NAMES = ["tracks.parquet", "report.json", "run-*/truth.parquet"]


def contents(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_atomic_write_replaces_at_the_end_only(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with atomic_write(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
        assert temporary.parent == tmp_path
    assert contents(tmp_path) == {"a.txt": "new"}


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_atomic_write_leaves_nothing_after_an_error(tmp_path: Path, error: type[BaseException]) -> None:
    def fail() -> None:
        with atomic_write(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert contents(tmp_path) == {}


def test_what_a_killed_run_had_finished_stays_until_the_next_is_whole(tmp_path: Path) -> None:
    """It had given the file its name, and was killed before it removed the temporary one."""
    target = tmp_path / "a.txt"
    target.write_text("old")
    os.link(target, temporary_beside(target))
    with atomic_write(target) as temporary:
        temporary.write_text("ne")
        assert target.read_text() == "old"
        temporary.write_text("new")
    assert contents(tmp_path) == {"a.txt": "new"}


def test_atomic_write_follows_the_umask(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "a.txt") as temporary:
        temporary.write_text("x")
    mask = os.umask(0)
    os.umask(mask)
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o666 & ~mask


def test_atomic_write_to_a_missing_folder_is_an_input_error(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match=r"cannot write .*nowhere/a\.txt: No such file"),
        atomic_write(tmp_path / "nowhere" / "a.txt"),
    ):
        pass


def test_output_folder_puts_all_files_in_place_together(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "out"
    with OutputFolder(folder, NAMES) as out:
        out.path("tracks.parquet").write_text("t")
        out.path("run-0003/truth.parquet").write_text("u")
        assert not [name for name in contents(folder) if not name.startswith(TEMPORARY_PREFIX)]
    assert contents(folder) == {"tracks.parquet": "t", "run-0003/truth.parquet": "u"}


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_output_folder_leaves_no_trace_after_an_error(tmp_path: Path, error: type[BaseException]) -> None:
    def fail() -> None:
        with OutputFolder(tmp_path / "deep" / "out", NAMES) as out:
            out.path("run-0003/truth.parquet").write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_output_folder_keeps_the_earlier_run_after_an_error(tmp_path: Path) -> None:
    (tmp_path / "tracks.parquet").write_text("old")

    def fail() -> None:
        with OutputFolder(tmp_path, NAMES, force=True) as out:
            out.path("tracks.parquet").write_text("new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert contents(tmp_path) == {"tracks.parquet": "old"}


def test_force_replaces_the_earlier_run_and_removes_its_other_files(tmp_path: Path) -> None:
    for name in ("tracks.parquet", "report.json", "run-0007/truth.parquet"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("old")
    with OutputFolder(tmp_path, NAMES, force=True) as out:
        out.path("tracks.parquet").write_text("new")
    assert contents(tmp_path) == {"tracks.parquet": "new"}
    assert [p.name for p in tmp_path.iterdir()] == ["tracks.parquet"]


def test_an_earlier_run_is_refused_without_force(tmp_path: Path) -> None:
    (tmp_path / "tracks.parquet").write_text("old")
    with (
        pytest.raises(InputError, match=r"already holds tracks\.parquet; use `force=True`"),
        OutputFolder(tmp_path, NAMES),
    ):
        pass
    assert contents(tmp_path) == {"tracks.parquet": "old"}


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("name", ["thesis.tex", "sub/tracks.parquet", "run-1/other", ".hidden"])
def test_a_folder_that_is_not_ours_is_refused_even_with_force(tmp_path: Path, force: bool, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("precious")
    with (
        pytest.raises(InputError, match=f"found one with {name}, which this command"),
        OutputFolder(tmp_path, NAMES, force),
    ):
        pass
    assert contents(tmp_path) == {name: "precious"}


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("folder", ["run-1", "run-1/partial-ab", "run-2/photos", "photos", "run-1/a/b"])
def test_an_empty_folder_is_neither_foreign_nor_a_run(tmp_path: Path, folder: str, force: bool) -> None:
    """A run that is killed as it begins has made folders, and no file."""
    (tmp_path / folder).mkdir(parents=True)
    names = ["summary.json", "run-*/tracks.parquet", "run-*/partial-*/*.npz"]
    assert output_folder(tmp_path, force, names) == []
    with OutputFolder(tmp_path, names, force) as out:
        out.path("summary.json").write_text("{}")
    assert contents(tmp_path) == {"summary.json": "{}"}
    assert (tmp_path / folder).is_dir()


def test_an_empty_folder_in_the_place_of_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "tracks.parquet").mkdir()
    with pytest.raises(InputError, match=r"tracks.parquet: expected a file or nothing, found a folder"):
        output_folder(tmp_path, True, NAMES)


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("x")
    with pytest.raises(InputError, match="expected a folder, found a file"), OutputFolder(tmp_path / "out", NAMES):
        pass


def test_what_a_killed_process_left_is_ours(tmp_path: Path) -> None:
    leftover = tmp_path / f"{TEMPORARY_PREFIX}x"
    leftover.mkdir()
    (leftover / "tracks.parquet").write_text("half")
    with OutputFolder(tmp_path, NAMES) as out:
        out.path("tracks.parquet").write_text("t")
    assert contents(tmp_path) == {"tracks.parquet": "t"}


def test_a_name_that_was_not_announced_is_a_fault_of_the_program(tmp_path: Path) -> None:
    with OutputFolder(tmp_path / "out", NAMES) as out, pytest.raises(ValueError, match="not among the names"):
        out.path("surprise.txt")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_a_disk_error_names_the_final_file(tmp_path: Path, number: int) -> None:
    def fail() -> None:
        with OutputFolder(tmp_path / "out", NAMES) as out:
            path = out.path("tracks.parquet")
            path.write_text("half")
            raise OSError(number, os.strerror(number), str(path))

    with pytest.raises(InputError, match="cannot write") as caught:
        fail()
    assert str(caught.value) == f"cannot write {tmp_path / 'out' / 'tracks.parquet'}: {os.strerror(number)}"
    assert list(tmp_path.iterdir()) == []


def test_an_error_on_another_file_stays_what_it_is(tmp_path: Path) -> None:
    def fail() -> None:
        with OutputFolder(tmp_path / "out", NAMES):
            raise PermissionError(errno.EACCES, "Permission denied", "/some/input")

    with pytest.raises(PermissionError):
        fail()


@pytest.mark.parametrize(("name", "ours"), [("partial-0123/tracks.part", True), ("detections.parquet", False)])
def test_an_error_inside_the_output_folder_is_ours_where_an_unfinished_run_lies(
    tmp_path: Path, name: str, ours: bool
) -> None:
    """An input may lie in the output folder: that it cannot be read is no failed write."""

    def fail() -> None:
        with OutputFolder(tmp_path, NAMES):
            raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / name))

    with pytest.raises(InputError if ours else PermissionError):
        fail()


def test_ctrl_c_while_moving_waits_until_all_files_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = os.replace

    def interrupted(source: Path, target: Path) -> None:
        replace(source, target)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(os, "replace", interrupted)

    def run() -> None:
        with OutputFolder(tmp_path / "out", NAMES) as out:
            out.path("tracks.parquet").write_text("t")
            out.path("report.json").write_text("r")

    with pytest.raises(KeyboardInterrupt):
        run()
    assert contents(tmp_path / "out") == {"report.json": "r", "tracks.parquet": "t"}


def test_a_killed_atomic_write_is_removed_by_the_next(tmp_path: Path) -> None:
    temporary_beside(tmp_path / "a.txt").write_text("half")
    with atomic_write(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
    assert contents(tmp_path) == {"a.txt": "new"}


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "a") as first:
        with pytest.raises(InputError, match="another run is writing to it"), atomic_write(tmp_path / "a"):
            pass
        first.write_text("first")
    assert (tmp_path / "a").read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_file_that_came_meanwhile_stays_where_it_must_not_be_replaced(tmp_path: Path) -> None:
    def write() -> None:
        with atomic_write(tmp_path / "a", replace=False) as first:
            first.write_text("first")
            (tmp_path / "a").write_text("came")

    with pytest.raises(InputError, match="the file exists"):
        write()
    assert (tmp_path / "a").read_text() == "came"
    with atomic_write(tmp_path / "b", replace=False) as other:
        other.write_text("new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


def test_a_temporary_name_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    temporary_beside(tmp_path / "a").symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="found a link"), atomic_write(tmp_path / "a"):
        pass
    assert (tmp_path / "precious").read_text() == "mine"
