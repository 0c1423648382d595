"""The variables of the environment that libraries of linear algebra read their number of threads from, when loaded."""

import os

OF_LINEAR_ALGEBRA = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
OF_ALL = "OMP_NUM_THREADS"


def use_one_thread() -> None:
    """Let linear algebra work on one thread, unless the environment says otherwise; call it before NumPy is imported.

    Matrices are small here: two threads wait for each other longer than they work, and sum in another order.
    """
    if OF_ALL not in os.environ:
        for name in OF_LINEAR_ALGEBRA:
            os.environ.setdefault(name, "1")
