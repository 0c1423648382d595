"""A second process that compiles kernels while a run with an empty kernel cache begins.

It compiles the kernels that the run needs last, and the run finds them in the folder of kept kernels. It ends with the
run. One such process a filter and folder is enough: the lock of the folder refuses a second one.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

from stereophd.core.numerics.compilation.kernel_cache import is_kept, place_to_keep
from stereophd.core.numerics.compilation.trusted_folders import make_folder
from stereophd.errors import InputError
from stereophd.io.outputs.locks import lock_file

# Longest wait for the process at the end of a run, s.
_PATIENCE_S = 5.0


@contextlib.contextmanager
def compiling_ahead(kind: str) -> Iterator[bool]:
    """Compile kernels of a kind of filter in a second process during the block.

    Yields whether there is such a process: not if the kernels are kept already or cannot be, or there is one core.
    """
    from stereophd.core.multi.build import last_kernel

    kernel = last_kernel(kind)
    if kernel is None or is_kept(kernel) or place_to_keep() is None or _cores() < 2:
        yield False
        return
    command = [sys.executable, "-m", "stereophd.pipeline.workers.compile_ahead", kind, str(os.getpid())]
    nothing = subprocess.DEVNULL
    try:
        process = subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing)
    except OSError:  # no more processes, or no memory for one: the run compiles alone
        yield False
        return
    try:
        yield True
    finally:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)


def _cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def main(kind: str, parent: int) -> None:
    """Compile the kernels of a filter, last ones first; end when the process `parent` is gone."""
    import signal

    from stereophd.core.multi.build import prepare
    from stereophd.pipeline.workers.worker_process import end_with

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both, and the run ends this process
    end_with(parent)
    place = place_to_keep()
    if place is None:
        return
    with contextlib.suppress(OSError, InputError):  # InputError: another process has the lock
        if make_folder(place):
            lock_file(place / f"compiling-{kind}.lock", f"kernels of {kind}", "wait")
            prepare(kind, last_first=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
