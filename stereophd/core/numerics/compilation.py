"""How the package's hot loops are compiled (numba)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])

# Sums may be reordered and contracted, but NaN and infinity keep their meaning: samples behind a
# camera produce them, and the test of the field of view relies on comparisons with them being false.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}


STAMP_FILE = "kernels.stamp"


def drop_outdated(package: Path) -> bool:
    """Remove compiled kernels below a package if any of its sources is not as it was when they were compiled.

    numba looks at the file of a kernel alone, and would go on using one that contains an older version of a
    kernel of another file. Where the folders cannot be written nothing is done. Return whether sources had changed.
    """
    described = [
        f"{path.relative_to(package)} {path.stat().st_size} {path.stat().st_mtime_ns}"
        for path in sorted(package.rglob("*.py"))
    ]
    stamp = hashlib.sha256("\n".join(described).encode()).hexdigest()
    file = package / "__pycache__" / STAMP_FILE
    with suppress(OSError):
        if file.read_text(encoding="utf-8") == stamp:
            return False
    with suppress(OSError):
        for path in [*package.rglob("__pycache__/*.nbi"), *package.rglob("__pycache__/*.nbc")]:
            path.unlink(missing_ok=True)
        file.parent.mkdir(exist_ok=True)
        file.write_text(stamp, encoding="utf-8")
    return True


drop_outdated(Path(__file__).parents[2])


def compiled(function: Function) -> Function:
    """Compile a kernel: cached on disk, without the interpreter lock, IEEE division by zero.

    Returns the compiled dispatcher, with the type of `function`.
    """
    return cast("Function", numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def compiled_fast(function: Function) -> Function:
    """As `compiled`, with sums that the compiler may reorder, so that loops over samples vectorise.

    Only for a large function that is all sums, and is not inlined: its code is then the same wherever it is
    called from. What is inlined is compiled anew with each caller, and where sums may be reordered its last bits
    depend on the caller, and on which of the copies of it a process finds first: a run that compiles and one
    that finds compiled code would differ.
    """
    decorate = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FASTMATH)
    return cast("Function", decorate(function))
