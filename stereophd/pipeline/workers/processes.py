"""Work on several processes of this machine, which end with the process that started them.

Workers leave Ctrl-C to that process, and watch it: when it is gone, killed or not, they end within a second. Each has
two pipes to it. There is nothing with a name that could outlive them, such as shared memory or a semaphore: whoever is
killed, and at whatever moment, nothing is left.
"""

import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from queue import SimpleQueue
from typing import Any, TypeVar

from stereophd.pipeline.workers.worker_process import WorkerProcess

Argument = TypeVar("Argument")
Result = TypeVar("Result")


def on_processes(
    function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int, ordered: bool = True
) -> Generator[Result]:
    """Call a function of a module for each argument, on several processes (-1: as many as cores); yield the results.

    They come in the order of the arguments, or as they are ready. A thread for each process waits for its call, and
    only as many calls are taken ahead: what is not needed any more, when the iterator is closed, is not begun. Raises
    BrokenProcessPool when a process died.
    """
    from joblib import cpu_count, effective_n_jobs

    numbered = enumerate(arguments)
    first = list(islice(numbered, effective_n_jobs(jobs)))
    if not first:
        return
    workers: list[WorkerProcess] = []
    idle: SimpleQueue[WorkerProcess] = SimpleQueue()

    def call(argument: Argument) -> Any:
        worker = idle.get()
        try:
            return worker.call(function, argument)
        finally:
            idle.put(worker)

    pool = ThreadPoolExecutor(len(first))
    try:
        with _without_interrupts():
            workers.extend(WorkerProcess(max(cpu_count() // len(first), 1)) for _ in first)
        for worker in workers:
            idle.put(worker)
        # one call more for each worker waits for it
        pending = {pool.submit(call, one): number for number, one in [*first, *islice(numbered, len(first))]}
        ready: dict[int, Result] = {}
        following = 0
        while pending:
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                ready[pending.pop(future)] = future.result()
                pending |= {pool.submit(call, one): number for number, one in islice(numbered, 1)}
            while ready and (following in ready or not ordered):
                yield ready.pop(following if ordered else next(iter(ready)))
                following += 1
    finally:
        for worker in workers:
            worker.kill()
        pool.shutdown(cancel_futures=True)
        for worker in workers:
            worker.close()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Ignore SIGINT for a while; the processes that are started meanwhile ignore it until they end.

    A terminal sends Ctrl-C to all processes of a command. Workers are ended by the one that started them; one that
    is interrupted by itself prints where it was.
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
