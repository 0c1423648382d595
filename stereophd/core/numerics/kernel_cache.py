"""Where compiled kernels are kept, and when a kept one is still valid.

A kernel is compiled together with every kernel that it calls, so a kept one is valid only while its own source file and
all files of the package that it imports, directly or not, have the same contents. The folder of a kernel carries the
hash of these contents in its name: a changed kernel finds no folder and is compiled, an old folder is never read again,
and checkouts with the same kernels share one folder. (numba's own cache looks at the file of the kernel alone, and
goes on using a caller of a changed kernel.)

Kept kernels that cannot be read (damaged, cut off) are compiled anew; where nothing can be written, nothing is kept.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

# The folder that holds the package.
_ROOT = Path(__file__).resolve().parents[3]
_IMPORT = re.compile(r"^\s*from (stereophd(?:\.\w+)*) import ([^\n#]+)", re.MULTILINE)


@cache
def _imported_files(file: Path) -> frozenset[Path]:
    """Return the files of the package that a file imports directly."""
    found = set()
    for module, names in _IMPORT.findall(file.read_text(encoding="utf-8")):
        path = _ROOT.joinpath(*module.split("."))
        if path.with_suffix(".py").is_file():
            found.add(path.with_suffix(".py"))
        for name in re.findall(r"\w+", names):
            if (path / f"{name}.py").is_file():
                found.add(path / f"{name}.py")
    return frozenset(found)


@cache
def source_digest(file: Path) -> str:
    """Return the hash of the contents of a source file and of all files of the package that it imports, in turn."""
    files, waiting = {file}, [file]
    while waiting:
        new = _imported_files(waiting.pop()) - files
        files |= new
        waiting += new
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


@cache
def cache_folder() -> Path | None:
    """Return the folder of kept kernels, or None where no folder can be written.

    The first of these that can be written: that of the environment variable ``NUMBA_CACHE_DIR``, ``__pycache__`` of
    the package, the user's cache folder, and a folder of this user alone in the temporary folder (it holds code).
    """
    stated = os.environ.get("NUMBA_CACHE_DIR")
    candidates = [Path(stated)] if stated else []
    candidates.append(_ROOT / "stereophd" / "__pycache__")
    if "XDG_CACHE_HOME" in os.environ:
        candidates.append(Path(os.environ["XDG_CACHE_HOME"]))
    elif "HOME" in os.environ:
        candidates.append(Path(os.environ["HOME"]) / ".cache")
    for candidate in candidates:
        if _can_be_written(candidate / "stereophd-kernels"):
            return candidate / "stereophd-kernels"
    own = Path(tempfile.gettempdir()) / f"stereophd-kernels-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    return own if _can_be_written(own) and _is_private(own) else None


def _can_be_written(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _is_private(folder: Path) -> bool:
    """Whether a folder is this user's, and nobody else may write to it."""
    found = folder.lstat()
    return not hasattr(os, "getuid") or (found.st_uid == os.getuid() and found.st_mode & 0o077 == 0)


class _Locator(_CacheLocator):  # type: ignore[misc]
    """Folder and validity of one kernel."""

    def __init__(self, function: Callable[..., object], file: str) -> None:
        self._file = Path(file).resolve()
        self._line = function.__code__.co_firstlineno
        self._digest = source_digest(self._file)
        # The error for a folder that cannot be written is raised when a kernel is kept, and means: keep nothing.
        self._folder = cache_folder() or Path(os.devnull)
        self._py_file = str(self._file)

    def get_cache_path(self) -> str:
        name = ".".join(self._file.relative_to(_ROOT).with_suffix("").parts[1:])
        return str(self._folder / f"{name}-{self._digest[:20]}")

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., object], py_file: str) -> _Locator:
        return cls(py_func, py_file)


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes: ClassVar = [_Locator]


class KernelCache(FunctionCache):  # type: ignore[misc]
    """Cache of one kernel's compiled forms, in the place of numba's own."""

    _impl_class = _Implementation

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return a kept form, or None: none is kept, or it cannot be read (whatever is wrong with it)."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a damaged file may raise anything
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a form, where there is a place for it."""
        try:
            super().save_overload(sig, data)
        except OSError:
            return
        except Exception:  # a damaged index: start anew
            self.flush()
            super().save_overload(sig, data)


def is_kept(kernel: Any) -> bool:
    """Whether compiled forms of a kernel (as decorated by `compiled`) are kept from an earlier run."""
    return any(Path(kernel._cache.cache_path).glob(f"{kernel.py_func.__name__}-*"))
