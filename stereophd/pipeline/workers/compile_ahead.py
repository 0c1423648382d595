"""A second process that compiles kernels while a run with an empty kernel cache begins.

It compiles the kernels that the run needs last, and the run finds them in the folder of kept kernels. It ends with the
run. One such process a filter and folder is enough: the lock of the folder refuses a second one.
"""

import contextlib
from collections.abc import Iterator

from stereophd.core.numerics.compilation.kernel_cache import is_kept, place_to_keep
from stereophd.core.numerics.compilation.trusted_folders import make_folder
from stereophd.io.outputs.locks import lock_file
from stereophd.pipeline.workers.aside import Aside
from stereophd.pipeline.workers.places import processes


@contextlib.contextmanager
def compiling_ahead(kind: str) -> Iterator[bool]:
    """Compile kernels of a kind of filter in a second process during the block.

    Yields whether such a process is begun: not if the kernels are kept already or cannot be, or there is one core.
    """
    from stereophd.core.multi.build import last_kernel

    kernel = last_kernel(kind)
    is_begun = kernel is not None and not is_kept(kernel) and place_to_keep() is not None and processes(-1) > 1
    second = Aside(nicer=0)
    if is_begun:
        second.start(lambda worker: worker.call(compile_from_the_end, kind))
    try:
        yield is_begun
    finally:
        second.stop()


def compile_from_the_end(kind: str) -> None:
    """Compile the kernels of a filter, last ones first; an InputError or OSError where another process does it."""
    from stereophd.core.multi.build import prepare

    place = place_to_keep()
    if place is not None and make_folder(place):
        lock_file(place / f"compiling-{kind}.lock", f"kernels of {kind}", "wait")
        prepare(kind, last_first=True)
