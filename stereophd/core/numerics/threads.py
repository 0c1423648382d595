"""Threads: of linear algebra, by the variables of the environment that it reads when it is loaded, and of our own."""

import os
from collections.abc import Callable, Iterable
from typing import TypeVar

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
    """Call a function that leaves the interpreter for most of its time for each item; return the results in order."""
    if threads == 1:
        return list(map(function, items))
    from concurrent.futures import ThreadPoolExecutor  # the command line needs this module first

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))
