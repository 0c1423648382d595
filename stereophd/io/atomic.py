"""Outputs that are either there in full or not there at all.

Everything is written under a temporary name on the same file system, flushed to the disk, and moved
into place with `os.replace`; whatever goes wrong before that (an error, a full disk, Ctrl-C) leaves
no trace. The user's faults, such as a folder that holds other files or a disk without room, become
`InputError`.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from types import TracebackType

from stereophd.errors import InputError
from stereophd.io.disk import USER_ERRNOS, current_umask, signals_deferred, sync, write_error

# Temporary names start so; a folder left behind by a killed process is recognised as ours.
TEMPORARY_PREFIX = ".stereophd-partial-"


@contextlib.contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Give a temporary path beside `path`; at a clean exit it replaces `path`, else it is removed.

    Parameters
    ----------
    path
        The file to write. Its folder must exist; an existing file is replaced.

    Yields
    ------
    Path
        The temporary file (already there, empty), to be opened and written by the caller.

    Raises
    ------
    InputError
        The place cannot be written to (no room, no permission, ...).
    """
    target = Path(path)
    temporary: Path | None = None
    try:
        descriptor, name = tempfile.mkstemp(prefix=TEMPORARY_PREFIX, dir=target.parent)
        os.close(descriptor)
        temporary = Path(name)
        yield temporary
        sync(temporary)
        with signals_deferred():
            # mkstemp makes files that only their owner can read; outputs follow the umask.
            temporary.chmod(0o666 & ~current_umask())
            os.replace(temporary, target)
            sync(target.parent)
    except OSError as error:
        if temporary is None or error.errno in USER_ERRNOS:
            raise write_error(error, target) from error
        raise
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _matches(relative: Path, names: Iterable[str]) -> bool:
    """Whether a file below an output folder is one of `names` (patterns, compared part by part)."""
    parts = relative.parts
    if parts[0].startswith(TEMPORARY_PREFIX):
        return True
    for name in names:
        patterns = Path(name).parts
        if len(patterns) == len(parts) and all(map(fnmatchcase, parts, patterns)):
            return True
    return False


def _files(folder: Path) -> Iterator[Path]:
    """Walk all files (and empty folders) below `folder`, as relative paths."""
    for root, directories, files in os.walk(folder, onerror=_raise):
        here = Path(root)
        for name in files:
            yield (here / name).relative_to(folder)
        if not files and not directories and here != folder:
            yield here.relative_to(folder)


def _raise(error: OSError) -> None:
    raise error


def output_folder(path: Path | str, force: bool, names: Iterable[str]) -> list[Path]:
    """Check that an output folder may be used, and make it if it is not there.

    Parameters
    ----------
    path
        The folder.
    force
        Whether outputs of an earlier run may be replaced.
    names
        The files that the command writes, relative to the folder; each part may be a pattern
        (``run-*/truth.parquet``).

    Returns
    -------
    list of Path
        The files of an earlier run that are there now, relative to the folder.

    Raises
    ------
    InputError
        It is not a folder, holds files that are not ours, holds an earlier run and `force` is not
        given, or cannot be made or written to.
    """
    folder = Path(path)
    names = list(names)
    existing: list[Path] = []
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"output folder {folder}: expected a folder, found a file")
        folder.mkdir(parents=True, exist_ok=True)
        for relative in _files(folder):
            if not _matches(relative, names):
                raise InputError(
                    f"output folder {folder} exists and is not of this command, which does not write the {relative} "
                    "in it; choose another folder"
                )
            existing.append(relative)
    except OSError as error:
        raise InputError(f"output folder {folder}: {error.strerror or error}") from error
    ours = [relative for relative in existing if not relative.parts[0].startswith(TEMPORARY_PREFIX)]
    if ours and not force:
        raise InputError(f"output folder {folder} already holds {ours[0]}; use --force to replace it")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"output folder {folder}: no permission to write there")
    return existing


class OutputFolder:
    """All files of one run, put in place together or not at all.

    ::

        with OutputFolder(out_dir, ["tracks.parquet", "report.json"], force) as out:
            write(out.path("tracks.parquet"))

    Inside the block the files lie in a temporary folder inside `path`. A clean exit flushes them,
    moves them into place, and removes what an earlier run (under `force`) left behind, so that the
    folder holds one run's files only. Any exception removes everything that was written, and the
    folders that were made.

    Parameters
    ----------
    path
        The output folder; made if it is not there.
    names
        Every file that the command may write, as in `output_folder`.
    force
        Whether the outputs of an earlier run may be replaced.

    Raises
    ------
    InputError
        As `output_folder`; and, from inside the block, when a write fails because of the disk.
    """

    def __init__(self, path: Path | str, names: Iterable[str], force: bool = False) -> None:
        self.folder = Path(path)
        self._names = list(names)
        self._force = force
        self._stale: list[Path] = []
        self._made: list[Path] = []
        self._temporary: Path | None = None

    def __enter__(self) -> OutputFolder:
        try:
            self._made = [p for p in (self.folder, *self.folder.parents) if not p.exists()]
            self._stale = output_folder(self.folder, self._force, self._names)
            self._temporary = Path(tempfile.mkdtemp(prefix=TEMPORARY_PREFIX, dir=self.folder))
        except OSError as error:
            self._discard()
            raise write_error(error, self.folder) from error
        except BaseException:
            self._discard()
            raise
        return self

    def path(self, name: str) -> Path:
        """Return where to write the file `name` for now; its parent folder exists.

        `name` must be one of the `names` of this folder (else `ValueError`: a fault of the program).
        """
        if self._temporary is None:
            raise ValueError("OutputFolder.path is only valid inside its with block")
        if not _matches(Path(name), self._names):
            raise ValueError(f"{name} is not among the names of this output folder: {self._names}")
        target = self._temporary / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None:
            try:
                self._commit()
            except OSError as failure:
                self._discard()
                raise self._explain(failure) from failure
            except BaseException:
                self._discard()
                raise
            return
        self._discard()
        if isinstance(error, OSError) and error.errno in USER_ERRNOS and self._is_ours(error):
            raise self._explain(error) from error

    def _is_ours(self, error: OSError) -> bool:
        """Whether an error of the block comes from a write here (a bare ENOSPC names no file)."""
        if error.filename is None:
            return True
        return self._temporary is not None and self._temporary in Path(os.fsdecode(error.filename)).parents

    def _explain(self, error: OSError) -> InputError:
        """Name the final file, not the temporary one."""
        path = self.folder
        if error.filename is not None and self._temporary is not None:
            written = Path(os.fsdecode(error.filename))
            if self._temporary in written.parents:
                path = self.folder / written.relative_to(self._temporary)
        return write_error(error, path)

    def _commit(self) -> None:
        """Flush, then move everything into place; on failure take back what was moved."""
        temporary = self._temporary
        assert temporary is not None
        written = [p for p in _files(temporary) if (temporary / p).is_file()]
        for relative in written:
            sync(temporary / relative)
        moved: list[Path] = []
        with signals_deferred():
            try:
                for relative in written:
                    target = self.folder / relative
                    target.parent.mkdir(parents=True, exist_ok=True)
                    os.replace(temporary / relative, target)
                    moved.append(target)
                self._remove_stale(set(written))
            except OSError:
                for target in moved:
                    target.unlink(missing_ok=True)
                raise
            shutil.rmtree(temporary, ignore_errors=True)
            self._temporary = None
            for folder in {self.folder, *(target.parent for target in moved)}:
                sync(folder)

    def _remove_stale(self, written: set[Path]) -> None:
        """Remove what an earlier run wrote and this one did not, and folders that are empty then."""
        for relative in self._stale:
            target = self.folder / relative
            if relative in written:
                continue
            if target.is_dir():
                target.rmdir()
            else:
                target.unlink(missing_ok=True)
            for parent in relative.parents:
                with contextlib.suppress(OSError):
                    if parent != Path():
                        (self.folder / parent).rmdir()

    def _discard(self) -> None:
        """Remove the temporary folder, and the folders made for it that hold nothing else."""
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)
        for folder in self._made:
            with contextlib.suppress(OSError):
                folder.rmdir()
