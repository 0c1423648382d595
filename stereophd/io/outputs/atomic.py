"""Outputs that are either complete or absent.

Everything is written under a temporary name on the same file system, flushed to the disk, and put into place in one
step (`io.outputs.commit`); a failure before that (an error, a full disk, Ctrl-C) leaves no trace, and the next run
removes what a killed process left. One run at a time writes to a folder (`stereophd.io.outputs.locks`). Errors of
the user, such as a folder that holds other files or a full disk, become `InputError`.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from types import TracebackType
from typing import Self

from stereophd.errors import InputError
from stereophd.io.outputs import disk
from stereophd.io.outputs.commit import MOVING_IN, NEW, OLD, beside_of, commit, files_below, is_folder, settle
from stereophd.io.outputs.locks import LOCK_NAME, lock_file, output_lock


def temporary_beside(path: Path) -> Path:
    """Return the temporary name under which `atomic_write` writes a file."""
    return path.with_name(f"{disk.TEMPORARY_PREFIX}{path.name}.tmp")


@contextlib.contextmanager
def atomic_write(path: Path | str, replace: bool = True) -> Iterator[Path]:
    """Give a temporary path beside `path`; at a clean exit it replaces `path`, else it is removed.

    The temporary file is already there, empty, to be opened and written by the caller; the folder must exist. One
    process at a time may write a file: the temporary name follows from the file's, so that the next call removes what a
    killed process left. With `replace` an existing file is replaced, also one that came during the block.

    Raises InputError when the place cannot be written to (disk full, no permission, ...), another process is writing
    it, or it is there already and must not be replaced.
    """
    target = Path(path)
    if not replace and os.path.lexists(target):
        raise _exists(target)
    temporary: Path | None = None
    descriptor: int | None = None
    try:
        name = temporary_beside(target)
        descriptor = lock_file(name, str(target), "choose another file")
        if os.fstat(descriptor).st_nlink > 1:  # a run that was killed had given the file its name, too
            name.unlink()
            os.close(descriptor)
            descriptor = lock_file(name, str(target), "choose another file")
        temporary = name
        os.truncate(descriptor, 0)
        yield temporary
        disk.sync(temporary)
        with disk.signals_deferred():
            temporary.chmod(0o666 & ~disk.current_umask())
            (os.replace if replace else _put)(temporary, target)
            disk.sync_names(target.parent)
    except OSError as error:
        if temporary is None or error.errno in disk.USER_ERRNOS:
            raise disk.write_error(error, target) from error
        raise
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        if descriptor is not None:
            os.close(descriptor)


def _put(temporary: Path, target: Path) -> None:
    """Give a file its name, if no other has it."""
    try:
        os.link(temporary, target, follow_symlinks=False)
        return
    except FileExistsError:
        pass
    except (OSError, NotImplementedError):  # a file system without hard links
        if not os.path.lexists(target):
            os.replace(temporary, target)
            return
    raise _exists(target)


def _exists(target: Path) -> InputError:
    return InputError(f"{target}: the file exists; use `force=True` to replace it")


def _matches(relative: Path, names: Iterable[str]) -> bool:
    """Whether a file below an output folder is one of `names` (patterns, compared part by part)."""
    parts = relative.parts
    if _is_temporary(relative):
        return True
    for name in names:
        patterns = Path(name).parts
        if len(patterns) == len(parts) and all(map(fnmatchcase, parts, patterns)):
            return True
    return False


def output_folder(path: Path | str, force: bool, names: Iterable[str]) -> list[Path]:
    """Check that an output folder, which is there and locked, may be used.

    `force` says whether outputs of an earlier run may be replaced; `names` are the files that the command writes,
    relative to the folder, where each part may be a pattern (``run-*/truth.parquet``). Returns the files of an earlier
    run that are there now, relative to the folder; empty folders do not count.

    Raises InputError when it holds files that are not ours, has a folder in the place of a file, holds an earlier run
    and `force` is not given, or cannot be written to.
    """
    folder = Path(path)
    names = list(names)
    existing: list[Path] = []
    try:
        settle(folder)
        for relative in files_below(folder):
            if is_folder(folder / relative):
                # Empty folders may be the user's, or those of a run that was killed as it began: they stay.
                if _matches(relative, names) and not _is_temporary(relative):
                    raise InputError(f"output folder {folder}: {relative}: expected a file or nothing, found a folder")
                continue
            if not _matches(relative, names):
                raise InputError(
                    f"output folder {folder}: expected a new folder or one of an earlier run of this command, found "
                    f"one with {relative}, which this command does not write; choose another folder"
                )
            existing.append(relative)
    except OSError as error:
        raise InputError(f"output folder {folder}: {error.strerror or error}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"output folder {folder}: Permission denied; expected a writable folder")
    ours = [relative for relative in existing if not _is_temporary(relative)]
    if ours and not force:
        raise InputError(f"output folder {folder} already holds {ours[0]}; use `force=True` to replace it")
    return ours


def _is_temporary(relative: Path) -> bool:
    return any(part.startswith(disk.TEMPORARY_PREFIX) for part in relative.parts)


def _remove_leftovers(folder: Path) -> None:
    """Remove what killed runs left in a folder, and beside it; the folder is locked, so none of them is alive."""
    shutil.rmtree(beside_of(folder.resolve()), ignore_errors=True)
    for path in folder.glob(f"{disk.TEMPORARY_PREFIX}*"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        elif path.name != LOCK_NAME:
            path.unlink(missing_ok=True)


def tidy(path: Path | str) -> None:
    """Finish or remove what a killed run left in an output folder, if anything.

    Raises InputError when a run is writing to the folder, or the folder cannot be written to.
    """
    folder = Path(path)
    if not folder.is_dir():
        return
    if any(folder.glob(f"{disk.TEMPORARY_PREFIX}*")) or beside_of(folder.resolve()).exists():
        with output_lock(folder):
            settle(folder)
            _remove_leftovers(folder)


class OutputFolder:
    """All files of one run, put in place together or not at all.

    ::

        with OutputFolder(out_dir, ["tracks.parquet", "report.json"], force) as out:
            write(out.path("tracks.parquet"))

    Inside the block the files lie in a temporary folder inside `path`, and other runs are kept out of `path`. A clean
    exit flushes them, puts them into place in one step, and removes what an earlier run (under `force`) left behind,
    so that the folder holds one run's files only. Any exception removes everything that was written, and the folders
    that were made. If even that fails (a disk that refuses every move), nothing is removed, and the next run that
    writes to the folder finishes what was begun.

    The folder is created if missing. `names` are all files that the command may write, as in `output_folder`; `force`
    says whether the outputs of an earlier run may be replaced. Raises InputError as `output_folder`; and, from inside
    the block, when a write fails because of the disk.
    """

    def __init__(self, path: Path | str, names: Iterable[str], force: bool = False) -> None:
        self.folder = Path(path)
        self._names = list(names)
        self._force = force
        self._held = contextlib.ExitStack()
        self._staged: Path | None = None

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as held:
            try:
                held.enter_context(output_lock(self.folder))
                output_folder(self.folder, self._force, self._names)
                _remove_leftovers(self.folder)
                self._staged = Path(tempfile.mkdtemp(prefix=disk.TEMPORARY_PREFIX, dir=self.folder))
                held.callback(self._discard)
                (self._staged / NEW).mkdir()
                (self._staged / OLD).mkdir()
            except OSError as error:
                raise disk.write_error(error, self.folder) from error
            self._held = held.pop_all()
        return self

    def path(self, name: str) -> Path:
        """Return where to write the file `name` for now; its parent folder exists.

        `name` must be one of the `names` of this folder (else `ValueError`: a fault of the program).
        """
        if self._staged is None:
            raise ValueError("OutputFolder.path is only valid inside its with block")
        if not _matches(Path(name), self._names):
            raise ValueError(f"{name} is not among the names of this output folder: {self._names}")
        target = self._staged / NEW / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._held:
            if error is None:
                try:
                    self._commit()
                except OSError as failure:
                    raise self._explain(failure) from failure
            elif isinstance(error, OSError) and error.errno in disk.USER_ERRNOS and self._is_ours(error):
                raise self._explain(error) from error

    def _is_ours(self, error: OSError) -> bool:
        """Whether an error of the block comes from a write here (a bare ENOSPC names no file)."""
        if error.filename is None:
            return True
        path = Path(os.fsdecode(error.filename))
        if self._staged in path.parents:
            return True
        # Tables of an unfinished run lie beside the staged folder; other files of the output folder may be inputs.
        inside = path.relative_to(self.folder).parts if self.folder in path.parents else ("",)
        return inside[0].startswith(disk.UNFINISHED_PREFIX)

    def _explain(self, error: OSError) -> InputError:
        """Name the final file, not the temporary one."""
        path = self.folder
        if error.filename is not None and self._staged is not None:
            written = Path(os.fsdecode(error.filename))
            for inside in (self._staged / NEW, self.folder / MOVING_IN / NEW):
                if inside in written.parents:
                    path = self.folder / written.relative_to(inside)
        return disk.write_error(error, path)

    def _commit(self) -> None:
        """Flush, then put everything into place."""
        staged = self._staged
        assert staged is not None
        for root, _, files in os.walk(staged / NEW):
            for name in (*files, ""):
                disk.sync(Path(root) / name)
        with disk.signals_deferred():
            commit(staged, self.folder, lambda path: _matches(path, self._names))
            self._staged = None

    def _discard(self) -> None:
        if self._staged is not None:
            shutil.rmtree(self._staged, ignore_errors=True)
            self._staged = None
