"""Put the files of a run in their places in one step.

The files of a run are staged in a separate folder. A folder that this run made is exchanged for the staged one, in one
call of the operating system. In a folder that existed before, the files are moved one by one under a journal. The old
files are kept until all new ones are in place. If a move fails, all moves are undone. If the process is killed in
between, the next command that reads or writes the folder completes the moves (`complete`).

The staged folder holds::

    new/            the files of the run
    old/            files of an earlier run that were moved out of the way
    journal.json    files of the earlier run that the new one does not replace
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from stereophd.errors import InputError
from stereophd.io.outputs.disk import TEMPORARY_PREFIX, sync
from stereophd.io.outputs.locks import LOCK_NAME, output_lock

NEW, OLD, JOURNAL = "new", "old", "journal.json"

# A staged folder has this name from the moment in which its files count.
COMMIT_NAME = f"{TEMPORARY_PREFIX}commit"

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def files_below(folder: Path) -> Iterator[Path]:
    """Walk all files (and empty folders) below `folder`, as relative paths."""
    for root, directories, files in os.walk(folder, onerror=_raise):
        here = Path(root)
        for name in files:
            yield (here / name).relative_to(folder)
        if not files and not directories and here != folder:
            yield here.relative_to(folder)


def _files_in(folder: Path) -> list[Path]:
    """Return all files below a folder, without empty folders."""
    return [path for path in files_below(folder) if not (folder / path).is_dir()]


def _raise(error: OSError) -> None:
    raise error


def commit_folder(staged: Path, folder: Path) -> bool:
    """Exchange a folder that this run made, and nothing else uses, for the staged one.

    Parameters
    ----------
    staged
        As above, inside `folder`.
    folder
        The output folder, locked; the lock stays valid.

    Returns
    -------
    bool
        Whether it was done; if not, everything is as it was (the system knows no such exchange, or the folder
        is one that cannot be moved).
    """
    place = folder.resolve()
    if Path.cwd().is_relative_to(place):
        return False
    beside = beside_of(place)
    try:
        shutil.rmtree(beside, ignore_errors=True)
        os.link(place / LOCK_NAME, staged / NEW / LOCK_NAME)
        os.replace(staged / NEW, beside)
    except OSError:
        with contextlib.suppress(OSError):
            (staged / NEW / LOCK_NAME).unlink()
        return False
    if not _exchange(beside, place):
        try:
            (beside / LOCK_NAME).unlink()
            os.replace(beside, staged / NEW)
        except OSError:
            shutil.rmtree(beside, ignore_errors=True)
            raise
        return False
    sync(place.parent)
    shutil.rmtree(beside, ignore_errors=True)
    return True


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


def commit_files(staged: Path, folder: Path, stale: Iterable[Path]) -> None:
    """Move staged files into a folder, and old ones out of it.

    Parameters
    ----------
    staged
        As above, inside `folder`.
    folder
        The output folder, locked.
    stale
        Files of an earlier run, relative to `folder`.

    Raises
    ------
    OSError
        A move failed. The folder is as it was before, unless taking back failed too: then `complete` finishes the
        moves at the next command.
    """
    new = _files_in(staged / NEW)
    old = list(stale)
    (staged / JOURNAL).write_text(json.dumps({"stale": [str(path) for path in old if path not in new]}))
    sync(staged / JOURNAL)
    sync(staged)
    journal = folder / COMMIT_NAME
    os.replace(staged, journal)
    moved: list[tuple[Path, Path]] = []
    try:
        sync(folder)
        for relative in old:
            _move(folder / relative, journal / OLD / relative, moved)
        for relative in new:
            _move(journal / NEW / relative, folder / relative, moved)
        for changed in {(folder / relative).parent for relative in new}:
            sync(changed)
    except OSError:
        for source, target in reversed(moved):
            os.replace(target, source)
        _remove_empty(folder, new)
        os.replace(journal, staged)
        raise
    _remove_empty(folder, old)
    (journal / JOURNAL).unlink()
    # If the process is killed from here on, the next run removes the rest of the staged folder.
    shutil.rmtree(journal, ignore_errors=True)


def _move(source: Path, target: Path, moved: list[tuple[Path, Path]]) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(source, target)
    moved.append((source, target))


def _remove_empty(folder: Path, files: Iterable[Path]) -> None:
    """Remove folders that are empty without `files`."""
    for relative in files:
        for path in (relative, *relative.parents):
            with contextlib.suppress(OSError):
                if path != Path():
                    (folder / path).rmdir()


def complete(folder: Path) -> None:
    """Finish the moves of a run that was killed while it made them.

    Parameters
    ----------
    folder
        An output folder, or any other.

    Raises
    ------
    InputError
        They cannot be finished: a run is writing to the folder, or the folder cannot be written to.
    """
    journal = folder / COMMIT_NAME
    if not journal.is_dir():
        return
    try:
        with output_lock(folder):
            if (journal / JOURNAL).is_file():
                for relative in _files_in(journal / NEW):
                    target = folder / relative
                    target.parent.mkdir(parents=True, exist_ok=True)
                    os.replace(journal / NEW / relative, target)
                stale = [Path(name) for name in json.loads((journal / JOURNAL).read_text())["stale"]]
                for relative in stale:
                    if relative.is_absolute() or ".." in relative.parts:
                        raise InputError(f"{journal / JOURNAL}: expected names of files in {folder}, found {relative}")
                    if (folder / relative).is_file():
                        (folder / relative).unlink()
                _remove_empty(folder, stale)
                (journal / JOURNAL).unlink()
            shutil.rmtree(journal)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            f"{folder}: a run was killed while it moved its files there, and they cannot be moved now: "
            f"{reason or error}"
        ) from error
