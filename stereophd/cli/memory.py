"""A limit on the address space (``ulimit -v``): too little of it is an error at once, and no hang.

OpenBLAS asks the system for its buffer again and again, without end, where there is no memory left for it. Its buffers
are therefore allocated before the work begins, and a limit below which they, and the libraries, do not fit is refused.
"""

from stereophd.errors import InputError

# Upper bound on the memory of the libraries, the compiler of the kernels and the BLAS buffers of a few threads, bytes.
LEAST_ADDRESS_SPACE = 3 << 29


def prepare() -> None:
    """Check the limit on the address space, if there is one, and allocate the buffers of the linear algebra.

    Raises InputError if the limit is too low to begin.
    """
    try:
        import resource
    except ImportError:  # not a POSIX system
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return
    if limit < LEAST_ADDRESS_SPACE:
        raise InputError(
            f"not enough memory: expected an address space of at least {LEAST_ADDRESS_SPACE >> 20} MiB, found a limit "
            f"of {limit >> 20} MiB (ulimit -v)"
        )
    import numpy as np
    from scipy.linalg.blas import dgemm

    square = np.ones((256, 256))
    square @ square
    dgemm(1.0, square, square)
