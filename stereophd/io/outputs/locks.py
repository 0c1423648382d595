"""One run at a time writes to an output folder.

The lock is a file in the folder that the run keeps locked (`flock`). The operating system releases the lock when the
process ends in any way, so a file that a killed process left behind blocks no other run. On a file system without
locks, the process that the file names holds the lock while it is alive on this machine.
"""

import contextlib
import errno
import os
import socket
import stat
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

# What a lock file begins with; a file with another content is not ours.
_OWNER = b"process "

# Never through a link, and without waiting for the other end of a pipe; 0 where the system has no such flag.
_FLAGS = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)

# Folders that this process holds (real paths): a command may take its folder more than once.
_HELD: set[str] = set()


@contextlib.contextmanager
def output_lock(path: Path | str) -> Iterator[None]:
    """Make an output folder if need be, and keep other runs out of it.

    At the end the folders that were made for it, and hold nothing, are removed. Raises InputError when another run is
    writing to it, it is a file, or it cannot be made or written to.
    """
    folder = Path(path)
    if "\0" in str(folder):
        raise InputError(f"output folder {str(folder)!r}: expected a path, found one with a null character")
    made = [p for p in (folder, *folder.parents) if not p.exists()]
    key = os.path.realpath(folder)
    if key in _HELD:
        yield
        return
    try:
        try:
            if folder.exists() and not folder.is_dir():
                raise InputError(f"output folder {folder}: expected a folder, found a file")
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = lock_file(folder / LOCK_NAME, f"output folder {folder}", "choose another folder")
            with contextlib.suppress(OSError):  # a full disk: the name of the process is for the message only
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, _OWNER + f"{os.getpid()} on {socket.gethostname()}".encode(), 0)
        except PermissionError as error:
            raise InputError(f"output folder {folder}: Permission denied; expected a writable folder") from error
        except OSError as error:
            raise write_error(error, folder) from error
        _HELD.add(key)
        try:
            yield
        finally:
            _HELD.discard(key)
            with contextlib.suppress(OSError):
                (folder / LOCK_NAME).unlink()
            os.close(descriptor)
    finally:
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()


def lock_file(path: Path, what: str, remedy: str) -> int:
    """Open a file that only one process may write, made if missing, and lock it; its content stays.

    Returns its descriptor; the lock lasts until it is closed. Raises InputError when another run has locked it (`what`
    and `remedy` are for this message), or it is not a file (a link, for instance), and OSError when it cannot be made.
    """
    while True:
        try:
            descriptor = os.open(path, _FLAGS, 0o666)
        except OSError as error:
            if path.is_symlink() or error.errno in (errno.ELOOP, errno.ENXIO, errno.EISDIR):
                raise InputError(f"{path}: expected a file of this program or none, found a link or folder") from error
            raise
        try:
            found = os.fstat(descriptor)
            if not stat.S_ISREG(found.st_mode):
                raise InputError(f"{path}: expected a file of this program or none, found no regular file")
            if path.name == LOCK_NAME and found.st_size and not _beginning(descriptor).startswith(_OWNER):
                raise InputError(f"{path}: expected the lock of a run, found another file; remove it")
            if not _lock(descriptor):
                owner = _owner(descriptor) if path.name == LOCK_NAME else ""
                raise InputError(
                    f"{what}: another run is writing to it ({owner or 'unknown process'}); wait until it ends, or "
                    f"{remedy}"
                )
            if _is_at(descriptor, path):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        # The run that held it removed the file just now.
        os.close(descriptor)


def _beginning(descriptor: int) -> bytes:
    """Return the first bytes of an open file (`os.pread` is not on every system)."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    found = os.read(descriptor, 300)
    os.lseek(descriptor, 0, os.SEEK_SET)
    return found


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
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _owner(descriptor: int) -> str:
    return _beginning(descriptor).decode(errors="replace")


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
