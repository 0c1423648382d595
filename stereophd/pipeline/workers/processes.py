"""Work on several processes of this machine, which end with the process that started them.

Workers leave Ctrl-C to that process, and watch it: when it is gone, killed or not, they end within a second. Each has
two pipes to it. There is nothing with a name that could outlive them, such as shared memory or a semaphore: whoever is
killed, and at whatever moment, nothing is left.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

from stereophd.pipeline.workers.worker_process import WorkerProcess

Argument = TypeVar("Argument")
Result = TypeVar("Result")


def on_processes(
    function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int, ordered: bool = True
) -> Generator[Result]:
    """Call a function of a module for each argument, on several processes (-1: as many as cores); yield the results.

    They come in the order of the arguments, or as they are ready. No more calls are begun ahead than there are
    processes: what is not needed any more, when the iterator is closed, is not begun. Raises BrokenProcessPool when a
    process died.
    """
    from joblib import cpu_count, effective_n_jobs

    calls = _Calls(function, arguments)
    first = calls.first(effective_n_jobs(jobs))
    workers: list[WorkerProcess] = []
    threads: list[threading.Thread] = []
    try:
        with _without_interrupts():
            workers.extend(WorkerProcess(max(cpu_count() // len(first), 1)) for _ in first)
        for worker, call in zip(workers, first, strict=True):
            threads.append(threading.Thread(target=calls.feed, args=(worker, call), daemon=True))
            threads[-1].start()
        results = calls.results(len(workers))
        yield from _in_order(results) if ordered else (result for _, result in results)
    finally:
        calls.stop()
        for worker in workers:
            worker.kill()
        for thread in threads:
            thread.join()
        for worker in workers:
            worker.close()


class _Calls(Generic[Argument, Result]):
    """The calls that are left, and the results that have come from all workers."""

    def __init__(self, function: Callable[[Argument], Result], arguments: Iterable[Argument]) -> None:
        self._function = function
        self._left = iter(enumerate(arguments))
        self._next = threading.Lock()
        self._stopped = False
        # number of a call, its result, and the error of a worker or None; None alone: a worker has nothing left to do
        self._come: SimpleQueue[tuple[int, Any, BaseException | None] | None] = SimpleQueue()

    def first(self, count: int) -> list[tuple[int, Argument]]:
        """Take up to that many calls."""
        return list(islice(self._left, count))

    def feed(self, worker: WorkerProcess, call: tuple[int, Argument] | None) -> None:
        """Let a worker do one call after the other until none is left. Each worker has a thread for this."""
        try:
            while call is not None:
                number, argument = call
                self._come.put((number, worker.call(self._function, argument), None))
                with self._next:
                    call = None if self._stopped else next(self._left, None)
        except BaseException as error:  # raised where the results are taken
            self._come.put((-1, None, error))
        else:
            self._come.put(None)

    def results(self, workers: int) -> Iterator[tuple[int, Result]]:
        """Yield numbers of calls and their results, until that many workers have nothing left to do."""
        while workers:
            come = self._come.get()
            if come is None:
                workers -= 1
                continue
            number, result, error = come
            if error is not None:
                raise error
            yield number, result

    def stop(self) -> None:
        """Begin no more calls."""
        with self._next:
            self._stopped = True


def _in_order(results: Iterator[tuple[int, Result]]) -> Iterator[Result]:
    waiting: dict[int, Result] = {}
    following = 0
    for number, result in results:
        waiting[number] = result
        while following in waiting:
            yield waiting.pop(following)
            following += 1


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
