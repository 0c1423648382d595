"""The disk and the signals below atomic writes."""

import contextlib
import errno
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import BinaryIO

from stereophd.errors import InputError

LOGGER = logging.getLogger(__name__)

# Temporary names start so; what a killed process left behind is recognised as ours.
TEMPORARY_PREFIX = ".stereophd-partial-"
# Folders inside an output folder in which unfinished runs keep what they have done.
UNFINISHED_PREFIX = "partial-"

# Failures of a write that come from the place written to, not from the program.
USER_ERRNOS = frozenset(
    getattr(errno, name)
    for name in (
        *("ENOSPC", "EDQUOT", "EFBIG", "EACCES", "EPERM", "EROFS", "EIO", "ENAMETOOLONG", "ENOTDIR", "EISDIR"),
        *("ENOTEMPTY", "EEXIST", "ELOOP", "EMFILE", "ENFILE", "ETXTBSY", "EBUSY"),
    )
    if hasattr(errno, name)
)


def write_error(error: OSError, path: Path) -> InputError:
    """Return the `InputError` that names the output that could not be written, and why."""
    return InputError(f"cannot write {path}: {error.strerror or error}")


def for_arrow(path: Path) -> Path | BinaryIO:
    """Return what pyarrow opens to read a file: its path, or the open file where the name is not text in UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return open(path, "rb")
    return path


def sync(path: Path) -> None:
    """Flush a file or folder to the disk; file systems that cannot sync folders are left to it."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def sync_names(folder: Path) -> None:
    """Flush a folder after files have got their final names in it: they are there, whatever the disk says.

    An error is a warning, and none if the folder may not be read.
    """
    try:
        sync(folder)
    except PermissionError:
        pass
    except OSError as error:
        LOGGER.warning("%s: %s: the outputs are in place, but may not survive a power failure", folder, error.strerror)


@contextlib.contextmanager
def signals_deferred() -> Iterator[None]:
    """Hold back SIGINT and SIGTERM for the few milliseconds in which files change places."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        received.append(number)

    number: int
    previous: dict[int, Callable[[int, FrameType | None], object] | int] = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        handler = signal.getsignal(number)
        # None: installed outside Python and not restorable from here.
        if handler is not None:
            previous[number] = handler
            signal.signal(number, remember)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if received:
        signal.raise_signal(received[0])


def current_umask() -> int:
    """Return the process's umask (it can only be read by setting it)."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
