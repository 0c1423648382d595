"""Where compiled kernels are kept, and when a kept one is still valid.

A kernel is compiled together with every kernel that it calls, so a kept kernel is valid only while its own source file
and all files of the package that it imports, directly or not, have the same contents. The name of a kernel's folder
contains the hash of these contents. A changed kernel therefore has no folder yet and is compiled, an outdated folder is
never read again, and checkouts with the same kernels share one folder. (numba's own cache checks the file of the kernel
alone, and would reuse a kernel whose callee has changed.)

A kept kernel that cannot be read (damaged, cut off) is compiled anew. Several folders are searched, so that the kernels
of a read-only installation are found. A new kernel is kept in the first folder that can be written to; if there is none
(read-only, full), nothing is kept, and one warning reports it. Kernels are code: only folders that nobody else can
write to count (`trusted_folders`). Importing reads and writes nothing.
"""

import contextlib
import logging
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.core.runtime import rtsys

from stereophd.core.numerics.compilation import kernel_units
from stereophd.core.numerics.compilation.kernel_units import PACKAGE_PARENT, source_digest
from stereophd.core.numerics.compilation.trusted_folders import can_make, is_trusted, make_folder

FOLDER_NAME = "stereophd-kernels"
# Kernels that have not been used for this long are removed when a new kernel is kept.
UNUSED_DAYS = 30

_DAY_S = 86400.0
_DIGEST_LENGTH = 20
_KERNEL_NAME = re.compile(rf"[\w.]+-[0-9a-f]{{{_DIGEST_LENGTH}}}")
_HAS_USERS = hasattr(os, "getuid")

LOGGER = logging.getLogger("stereophd")
PROGRESS = logging.getLogger("stereophd.progress")


def _candidates() -> list[Path]:
    """Return the folders in which kernels may be kept, in the order in which they are tried.

    That of the environment variable ``NUMBA_CACHE_DIR``, ``__pycache__`` of the package, the user's cache folder, and
    a folder in the temporary folder.
    """
    stated = os.environ.get("NUMBA_CACHE_DIR")
    parents = [Path(stated)] if stated else []
    parents.append(PACKAGE_PARENT / "stereophd" / "__pycache__")
    user, home = os.environ.get("XDG_CACHE_HOME"), os.environ.get("HOME")
    if user:
        parents.append(Path(user))
    elif home and Path(home).is_dir():
        parents.append(Path(home) / ".cache")
    folders = [parent / FOLDER_NAME for parent in parents]
    with contextlib.suppress(OSError):  # the system has no temporary folder
        folders.append(Path(tempfile.gettempdir()) / f"{FOLDER_NAME}-{os.getuid() if _HAS_USERS else 'user'}")
    return folders


@cache
def kernel_folders() -> tuple[Path, ...]:
    """Return the folders searched for kept kernels, in order; a new one is kept in the first that can be written to.

    What lies there is used only as long as nobody else can change it (`is_trusted`).
    """
    folders = tuple(_candidates())
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        stated = os.environ.get(name)
        if stated and Path(stated).is_dir() and not is_trusted(Path(stated)) and LOGGER.hasHandlers():
            LOGGER.warning(
                "%s=%s: expected a folder that only this user or root can write to, as to all that lead to it, found "
                "another: no kernels are read from it or kept there",
                name, stated
            )  # fmt: skip
    return folders


def place_to_keep() -> Path | None:
    """Return the folder in which a new kernel would be kept, or None if no folder can be written to."""
    return next((folder for folder in kernel_folders() if can_make(folder)), None)


# Folders that a kernel could not be written to in this process.
_FAILED: set[Path] = set()


@cache
def _note_nothing_kept() -> None:
    """Warn once that kernels cannot be kept; worker processes have no handlers and stay silent."""
    if LOGGER.hasHandlers():
        LOGGER.warning(
            "compiled kernels cannot be kept, so every run compiles them, for up to a minute: none of these "
            "folders can be written to by this user, and by nobody else: %s; set NUMBA_CACHE_DIR to one that can",
            ", ".join(map(str, kernel_folders())),
        )


@cache
def note_compilation() -> None:
    """Tell once that kernels are compiled: it is the first wait of a new user."""
    PROGRESS.info("compiling kernels: once, up to a minute", extra={"at_once": True})


@cache
def _mark_used(folder: Path) -> None:
    """Set the modification time of a kernel's folder to now, if it is more than a day old."""
    with contextlib.suppress(OSError):
        if time.time() - folder.stat().st_mtime > _DAY_S:
            os.utime(folder)


@cache
def _prune(folder: Path) -> None:
    """Remove kernels that have not been used for `UNUSED_DAYS`; runs once a process, when a kernel is kept."""
    oldest = time.time() - UNUSED_DAYS * _DAY_S
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if _KERNEL_NAME.fullmatch(path.name) and path.stat().st_mtime < oldest:
                shutil.rmtree(path, ignore_errors=True)


class _Locator(_CacheLocator):  # type: ignore[misc]
    """Name and validity of one kernel's folder."""

    def __init__(self, function: Callable[..., object], file: str) -> None:
        self._file = Path(file).resolve()
        self._line = function.__code__.co_firstlineno
        self._digest = source_digest(self._file)
        self._py_file = str(self._file)

    def get_cache_path(self) -> str:
        """Return the name of the folder; where it lies is decided by `KernelCache`."""
        name = ".".join(self._file.relative_to(PACKAGE_PARENT).with_suffix("").parts[1:])
        return f"{name}-{self._digest[:_DIGEST_LENGTH]}"

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., object], py_file: str) -> Self:
        return cls(py_func, py_file)


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes: ClassVar = [_Locator]


class KernelCache(FunctionCache):  # type: ignore[misc]
    """Cache of one kernel's compiled forms, in the place of numba's own."""

    _cache_path = None  # `folder_in` has it

    def __init__(self, function: Callable[..., object], for_python: bool) -> None:
        # not numba's: it looks for the folder at once, and of most kernels a run needs none
        self._py_func, self._for_python = function, for_python

    @cached_property
    def _impl(self) -> _Implementation:
        return _Implementation(self._py_func)

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return (*super()._index_key(sig, codegen), self._for_python)

    def folder_in(self, folder: Path) -> Path:
        """Return where this kernel is kept in one of the `kernel_folders`."""
        return folder / str(self._impl.locator.get_cache_path())

    def _file_in(self, folder: Path) -> IndexDataCacheFile:
        stamp = self._impl.locator.get_source_stamp()
        return IndexDataCacheFile(str(self.folder_in(folder)), self._impl.filename_base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return a kept form, or None if none is kept or it cannot be read for any reason.

        Machine code needs none of what numba knows of Python's functions, which takes a quarter of a second to install
        (`target_context.refresh`): that waits until a kernel is compiled. It needs the runtime that counts references
        to arrays; without it the process ends at the first array that a kernel makes.
        """
        rtsys.initialize(target_context)
        key = self._index_key(sig, target_context.codegen())
        for folder in kernel_folders():
            if not is_trusted(self.folder_in(folder)):
                continue
            try:
                data = self._file_in(folder).load(key)
                if data is not None:
                    apart, units, names, reduced, environments = data
                    if not kernel_units.load_units(units, target_context):
                        continue
                    # numba learns them from the code for callers, which a kept form may not hold
                    target_context.codegen()._engine._defined_symbols.update(names)
                    form = self._impl.rebuild(target_context, (*reduced, environments))
                    kernel_units.set_apart(form, self._py_func, units, apart)
                    _mark_used(self.folder_in(folder))
                    return form
            except Exception:  # a damaged file may raise anything
                continue
        note_compilation()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a form in the first folder that can be written to."""
        units, names = kernel_units.units_of(data), [each.name for each in data.library.get_defined_functions()]
        # callers see the form without its code, which takes a while to read; those in Python never do
        apart = self._for_python or kernel_units.is_large(data)
        kernel_units.set_apart(data, self._py_func, units, apart)
        if not self._impl.check_cachable(data):
            return
        key = self._index_key(sig, data.codegen)
        *reduced, environments = self._impl.reduce(data)
        # machine code reads nothing of those without constants, and each would import a module of numba
        needed = tuple(each for each in environments if each.consts)
        form = apart, units, names, reduced, needed
        for folder in kernel_folders():
            if folder not in _FAILED and self._save(folder, key, form):
                _prune(folder)
                return
        _note_nothing_kept()

    def _save(self, folder: Path, key: Any, form: Any) -> bool:
        """Keep a form in a folder, or return False: it cannot be written to, or the disk is full."""
        file = self._file_in(folder)
        try:
            if not (make_folder(folder) and make_folder(self.folder_in(folder))):
                _FAILED.add(folder)
                return False
            try:
                file.save(key, form)
            except OSError:
                raise
            except Exception:  # a damaged index: start anew
                file.flush()
                file.save(key, form)
        except OSError:
            _FAILED.add(folder)
            return False
        return True


def is_kept(kernel: Any) -> bool:
    """Whether compiled forms of a kernel (as decorated by `compiled`) are kept from an earlier run."""
    # as numba names its files: module, function, first line, version of Python
    name = f"{kernel._cache._impl.filename_base}*"
    kept = (kernel._cache.folder_in(folder) for folder in kernel_folders())
    return any(any(folder.glob(name)) for folder in kept if is_trusted(folder))
