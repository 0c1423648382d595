"""Work on several processes of this machine, which end with the process that started them.

Workers leave Ctrl-C to that process, and watch it: when it is gone, killed or not, they end within a second. Arguments
and results go through pipes: a file in shared memory would outlive a process that is killed at a wrong moment.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import TypeVar

Argument = TypeVar("Argument")
Result = TypeVar("Result")

# How often a worker looks for the process that started it, s.
WATCH_EVERY_S = 0.5


def on_processes(
    function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int, ordered: bool = True
) -> Iterator[Result]:
    """Call a function for each argument, on several processes.

    No more calls are begun ahead than there are processes: what is not needed any more, when the iterator is closed, is
    not begun.

    Parameters
    ----------
    function
        A function of a module (it is sent to the processes by name).
    arguments
        One for each call.
    jobs
        Number of processes; -1: as many as there are cores.
    ordered
        Whether the results come in the order of the arguments, or as they are ready.

    Yields
    ------
    Result
        The result of each call.

    Raises
    ------
    concurrent.futures.process.BrokenProcessPool
        A process died.
    """
    import tempfile
    import warnings

    from joblib import Parallel, delayed

    # Work is given up on purpose when the iterator is closed.
    warnings.filterwarnings("ignore", message=".*tasks which were still being processed", category=UserWarning)
    with _without_interrupts():
        pool = Parallel(
            n_jobs=jobs,
            return_as="generator" if ordered else "generator_unordered",
            batch_size=1,
            pre_dispatch="n_jobs",
            initializer=partial(end_with, os.getpid()),
            # Without a stated folder joblib makes one in shared memory before it tells its cleaner: a kill in between
            # leaves it. With both arguments it makes none, because no array is shared.
            max_nbytes=None,
            temp_folder=tempfile.gettempdir(),
        )
        results = pool(delayed(function)(argument) for argument in arguments)
    with closing(results):
        yield from results


def end_with(parent: int) -> None:
    """Watch the process `parent` that started this one, and end when it is gone."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_EVERY_S)
        os._exit(1)

    threading.Thread(target=watch, name="watch the parent", daemon=True).start()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Ignore SIGINT for a while; the processes that are started meanwhile ignore it until they end.

    A terminal sends Ctrl-C to all processes of a command. Workers are ended by the one that started them; one that
    is interrupted by itself prints where it was. (A blocked signal would not do: joblib unblocks it.)
    """
    handler = signal.getsignal(signal.SIGINT)
    if handler is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
