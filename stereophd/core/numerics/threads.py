"""Threads: of linear algebra, by the variables of the environment that it reads when it is loaded, and of our own."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from functools import cache
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import Executor

Item = TypeVar("Item")
Result = TypeVar("Result")
OF_LINEAR_ALGEBRA = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
OF_ALL = "OMP_NUM_THREADS"


def use_one_thread() -> None:
    """Let linear algebra work on one thread, unless the environment says otherwise; call it before NumPy is imported.

    Matrices are small here: two threads wait for each other longer than they work, and sum in another order.
    """
    if OF_ALL not in os.environ:
        for name in OF_LINEAR_ALGEBRA:
            os.environ.setdefault(name, "1")


def in_threads(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> list[Result]:
    """Call a function that leaves the interpreter for most of its time for each item; return the results in order.

    The threads are shared by all callers: a function that calls this itself may wait for ever.
    """
    if threads == 1:
        return list(map(function, items))
    return list(_pool(threads).map(function, items))


@cache
def _pool(threads: int) -> Executor:
    """Return threads that wait for calls: to start them takes as long as a small event of a filter."""
    from concurrent.futures import ThreadPoolExecutor  # the command line needs this module first

    return ThreadPoolExecutor(threads)
