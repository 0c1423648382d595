"""What makes numba's compiler faster while it compiles kernels of the package, without changing what it compiles.

numba's compiler is Python for the greater part. While it runs, two costs are avoided: Python's search for garbage
(little of what a compiler makes becomes garbage before it ends), and the repeated choice of the form of a built-in
function (the operators, `math.sqrt`, `len`, ...) for the same types of arguments, for which numba tries all forms that
it knows at every place.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator
from typing import Any

from numba.core.types import functions

# Types of calls of built-in functions, by function, context and types of arguments.
_CALL_TYPES: dict[tuple[Any, ...], Any] = {}

# numba's class of built-in functions, untyped: one of its methods is exchanged for a while
_FUNCTION: Any = functions.Function
_get_call_type = _FUNCTION.get_call_type


@contextlib.contextmanager
def quick_compilation() -> Iterator[None]:
    """Compile kernels in the block; blocks may be nested, and only one thread compiles (numba has one lock)."""
    if _FUNCTION.get_call_type is not _get_call_type:
        yield
        return
    collects = gc.isenabled()
    gc.disable()
    _FUNCTION.get_call_type = _remembered_call_type
    try:
        yield
    finally:
        _FUNCTION.get_call_type = _get_call_type
        if collects:
            gc.enable()


def _remembered_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return the signature of a call, as numba finds it at the first of the same kind."""
    key = self, context, tuple(args), tuple(sorted(kws.items()))
    found = _CALL_TYPES.get(key)
    if found is None:
        found = _CALL_TYPES[key] = _get_call_type(self, context, args, kws)
    return found
