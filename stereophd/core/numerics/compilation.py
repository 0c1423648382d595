"""How the package's hot loops are compiled (numba)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from stereophd.core.numerics.kernel_cache import KernelCache

Function = TypeVar("Function", bound=Callable[..., object])

# Sums may be reordered and contracted, but NaN and infinity keep their meaning: samples behind a
# camera produce them, and the test of the field of view relies on comparisons with them being false.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}


def compiled(function: Function) -> Function:
    """Compile a kernel: cached on disk, without the interpreter lock, IEEE division by zero.

    Returns the compiled dispatcher, with the type of `function`.
    """
    return cast("Function", _cached(numba.njit(nogil=True, error_model="numpy")(function)))


def compiled_fast(function: Function) -> Function:
    """As `compiled`, with sums that the compiler may reorder, so that loops over samples vectorise.

    Only for a large function that is all sums, and is not inlined: its code is then the same wherever it is
    called from. What is inlined is compiled anew with each caller, and where sums may be reordered its last bits
    depend on the caller, and on which of the copies of it a process finds first: a run that compiles and one
    that finds compiled code would differ.
    """
    decorate = numba.njit(nogil=True, error_model="numpy", fastmath=FASTMATH)
    return cast("Function", _cached(decorate(function)))


def _cached(dispatcher: Any) -> Any:
    """Return a dispatcher that keeps its compiled forms in a `KernelCache` (where numba's `cache=True` has its own)."""
    dispatcher._cache = KernelCache(dispatcher.py_func)
    return dispatcher
