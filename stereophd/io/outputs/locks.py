"""One run at a time writes to an output folder.

The lock is a file in the folder that the run keeps locked (`flock`). The operating system releases the lock when the
process ends in any way, so a file that a killed process left behind blocks no other run. On a file system without
locks, the process that the file names holds the lock while it is alive on this machine.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from stereophd.errors import InputError
from stereophd.io.outputs.disk import TEMPORARY_PREFIX, write_error

try:
    import fcntl
except ImportError:  # not a POSIX system: the process that the file names counts
    fcntl = None  # type: ignore[assignment]

LOCK_NAME = f"{TEMPORARY_PREFIX}lock"

# Errors of a file system without locks.
_NO_LOCKS = frozenset({errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL})

# Folders that this process holds (real paths), and whether it made them: a command may take its folder more than once.
_HELD: dict[str, bool] = {}


@contextlib.contextmanager
def output_lock(path: Path | str) -> Iterator[bool]:
    """Make an output folder if need be, and keep other runs out of it.

    At the end the folders that were made for it, and hold nothing, are removed.

    Parameters
    ----------
    path
        The folder.

    Yields
    ------
    bool
        Whether the folder was made here.

    Raises
    ------
    InputError
        Another run is writing to it, it is a file, or it cannot be made or written to.
    """
    folder = Path(path)
    if "\0" in str(folder):
        raise InputError(f"output folder {str(folder)!r}: expected a path, found one with a null character")
    made = [p for p in (folder, *folder.parents) if not p.exists()]
    key = os.path.realpath(folder)
    if key in _HELD:
        yield _HELD[key]
        return
    try:
        try:
            if folder.exists() and not folder.is_dir():
                raise InputError(f"output folder {folder}: expected a folder, found a file")
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = _locked(folder)
        except PermissionError as error:
            raise InputError(f"output folder {folder}: Permission denied; expected a writable folder") from error
        except OSError as error:
            raise write_error(error, folder) from error
        _HELD[key] = folder in made
        try:
            yield folder in made
        finally:
            del _HELD[key]
            with contextlib.suppress(OSError):
                (folder / LOCK_NAME).unlink()
            os.close(descriptor)
    finally:
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()


def _locked(folder: Path) -> int:
    """Return the descriptor of the lock file of a folder, locked."""
    path = folder / LOCK_NAME
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _lock(descriptor):
                owner = _owner(descriptor) or "unknown process"
                raise InputError(
                    f"output folder {folder}: another run is writing to it ({owner}); "
                    "wait until it ends, or choose another folder"
                )
            if _is_at(descriptor, path):
                with contextlib.suppress(OSError):  # a full disk: the name of the process is for the message only
                    os.ftruncate(descriptor, 0)
                    os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        # The run that held it removed the file just now.
        os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Lock an open file, or return False if another process holds it."""
    if fcntl is not None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        else:
            return True
    return not _is_alive(_owner(descriptor))


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one at a path."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _owner(descriptor: int) -> str:
    return os.pread(descriptor, 300, 0).decode(errors="replace")


def _is_alive(owner: str) -> bool:
    """Whether the process that a lock file names is alive, as far as this machine knows."""
    words = owner.split()
    if len(words) != 4 or not words[1].isdigit():
        return False
    if words[3] != socket.gethostname():
        return True
    try:
        os.kill(int(words[1]), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return int(words[1]) != os.getpid()
