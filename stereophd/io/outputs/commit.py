"""Put the files of a run in their places in one step, and never through a link.

The files of a run are staged in a folder inside the output folder::

    new/    the files of the run
    old/    what was moved out of the way

Where the system can, the whole output folder is exchanged for ``new`` in one call. Elsewhere the entries of the folder
move by themselves: those of the earlier run into ``old``, under the name `MOVING_OUT`; then, under `MOVING_IN`, those
of ``new`` into the folder. The change of the name is the step from the old run to the new one. If a move fails, all
moves are undone. If the process is killed in between, the next run that writes to the folder moves everything back
(`MOVING_OUT`) or in (`MOVING_IN`): see `settle`. A reader never moves anything; it refuses such a folder
(`refuse_unsettled`).

Only entries of the output folder itself move, and a link moves as a link: no content of a folder can lead a move out
of it.
"""

import contextlib
import ctypes
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from stereophd.errors import InputError
from stereophd.io.outputs.disk import TEMPORARY_PREFIX, UNFINISHED_PREFIX, sync, sync_names
from stereophd.io.outputs.locks import LOCK_NAME

NEW, OLD = "new", "old"

# Names of a staged folder while entries move.
MOVING_OUT, MOVING_IN = f"{TEMPORARY_PREFIX}moving-out", f"{TEMPORARY_PREFIX}moving-in"

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def files_below(folder: Path) -> Iterator[Path]:
    """Walk all files, links and empty folders below `folder`, as relative paths; no link is followed."""
    for root, directories, files in os.walk(folder, onerror=_raise):
        path = Path(root)
        links = [name for name in directories if (path / name).is_symlink()]
        for name in (*files, *links):
            yield (path / name).relative_to(folder)
        if not files and not directories and path != folder:
            yield path.relative_to(folder)


def _raise(error: OSError) -> None:
    raise error


def is_folder(path: Path) -> bool:
    """Whether a path is a folder itself, not a link to one."""
    return path.is_dir() and not path.is_symlink()


def commit(staged: Path, folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """Put the files staged inside the folder, as above, in the place of the earlier ones; `staged` is gone afterwards.

    The folder is locked, and the lock stays valid. `is_ours` says whether a file, relative to the folder, is one that
    this command writes: other files stay. Raises OSError when a move failed: the folder is as it was before, unless
    taking back failed too; then `settle` does it. Raises InputError when a folder that has to go holds a file of
    somebody else, which has come since the run began.
    """
    place = folder.resolve()
    foreign = [path for path in files_below(place) if not is_ours(path) and not is_folder(place / path)]
    if not (not foreign and _exchange_folder(staged, place)):
        _move_entries(staged, place, foreign)


def _exchange_folder(staged: Path, place: Path) -> bool:
    """Exchange a folder for the staged one, if the system can; if not, everything is as it was."""
    if os.path.ismount(place) or Path.cwd().is_relative_to(place):
        return False
    new, beside = staged / NEW, beside_of(place)
    shutil.rmtree(beside, ignore_errors=True)
    try:
        before, after = place.stat(), new.stat()
        if before.st_uid != after.st_uid:
            return False
        if before.st_gid != after.st_gid:
            os.chown(new, -1, before.st_gid)
        for path in files_below(place):  # folders that somebody made stay
            if is_folder(place / path) and not path.parts[0].startswith((TEMPORARY_PREFIX, UNFINISHED_PREFIX)):
                (new / path).mkdir(parents=True, exist_ok=True)
        shutil.copystat(place, new)
        os.link(place / LOCK_NAME, new / LOCK_NAME, follow_symlinks=False)
        os.replace(new, beside)
    except (OSError, NotImplementedError):
        _unlock(new)
        return False
    if not _exchange(beside, place):
        try:
            _unlock(beside)
            os.replace(beside, new)
        except OSError:
            shutil.rmtree(beside, ignore_errors=True)
            raise
        return False
    sync_names(place.parent)
    shutil.rmtree(beside, ignore_errors=True)
    return True


def _unlock(folder: Path) -> None:
    with contextlib.suppress(OSError):
        (folder / LOCK_NAME).unlink()


def beside_of(folder: Path) -> Path:
    """Return the name, beside a folder, that its successor has before they are exchanged."""
    return folder.parent / f"{TEMPORARY_PREFIX}{folder.name}"


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step, where the system can."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    return bool(rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0)


def _move_entries(staged: Path, folder: Path, foreign: Iterable[Path]) -> None:
    """Move the entries of a folder out of it, and those of the staged one into it."""
    new = sorted(os.listdir(staged / NEW))
    staying = {path.parts[0]: path for path in foreign}
    old = [
        path.name
        for path in sorted(folder.iterdir())
        if not path.name.startswith(TEMPORARY_PREFIX) and path.name not in staying
        and (path.name in new or not is_folder(path) or any(not is_folder(path / one) for one in files_below(path)))
    ]  # fmt: skip
    if blocked := [path for name, path in staying.items() if name in new]:
        raise InputError(
            f"output folder {folder}: {blocked[0]} has come into it since the run began, and is not of this command; "
            "move it away, or choose another folder"
        )
    out, into = folder / MOVING_OUT, folder / MOVING_IN
    moved: list[tuple[Path, Path]] = []

    def move(source: Path, target: Path) -> None:
        os.replace(source, target)
        moved.append((source, target))

    try:
        move(staged, out)
        for name in old:
            move(folder / name, out / OLD / name)
        sync(out / OLD)
        sync(folder)
        move(out, into)
        for name in new:
            move(into / NEW / name, folder / name)
        sync(folder)
    except OSError:
        for source, target in reversed(moved):
            os.replace(target, source)
        raise
    # If the process is killed from here on, the next run removes the rest of the staged folder.
    shutil.rmtree(into, ignore_errors=True)


def _waiting(folder: Path) -> tuple[Path, list[str]] | None:
    """Return where entries wait that have to move into a folder, and their names; None if none do."""
    for waiting in (folder / MOVING_OUT / OLD, folder / MOVING_IN / NEW):
        if is_folder(waiting.parent) and is_folder(waiting) and (names := sorted(os.listdir(waiting))):
            return waiting, names
    return None


def refuse_unsettled(path: Path | str) -> None:
    """Refuse to read a file whose folder is between two runs, since it may be of the one or of the other.

    The path is a file of an output folder, or the folder itself. Raises InputError when a run was killed while it moved
    its files into that folder, or is moving them now.
    """
    for folder in (Path(path), *list(Path(path).parents)[:2]):
        with contextlib.suppress(OSError):
            if _waiting(folder) is not None:
                raise InputError(
                    f"{path}: a run was killed while it moved its files into {folder}, or is moving them now; the next "
                    "run that writes there finishes it (with `force=True` or `resume=True`)"
                )


def settle(folder: Path) -> None:
    """Finish or take back the moves of a run that was killed while it made them; the folder is locked.

    Raises InputError when they cannot be finished: the folder is not writable, or something has taken their places.
    """
    try:
        while (found := _waiting(folder)) is not None:
            waiting, names = found
            for name in names:
                os.replace(waiting / name, folder / name)
            waiting.rmdir()
    except OSError as error:
        raise InputError(
            f"{folder}: a run was killed while it moved its files there, and they cannot be moved now: "
            f"{error.strerror or error}"
        ) from error
