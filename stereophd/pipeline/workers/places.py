"""Where independent work is done: in this process, on the cores of this machine, on a Dask cluster.

All three call a function of a module for each of some arguments and yield the results in any order; what these hold
does not depend on where they were made. `complete` continues when workers die.

Processes of this machine end with the process that started them. They leave Ctrl-C to it, and watch it: when it is
gone, killed or not, they end within a second. Each has two pipes to it. There is nothing with a name that could outlive
them, such as shared memory or a semaphore: whoever is killed, and at whatever moment, nothing is left.
"""

import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, contextmanager
from functools import partial
from queue import SimpleQueue
from typing import Any, TypeVar

import stereophd
from stereophd.errors import InputError
from stereophd.pipeline.workers.worker_process import WorkerProcess, WorkersLostError
from stereophd.wording import LOGGER

Argument = TypeVar("Argument")
Result = TypeVar("Result")

# How long a scheduler may take to answer, s.
CONNECT_S = 10

# How often in a row workers may be lost without a result.
ATTEMPTS = 3


class ThisMachine:
    """A number of processes of this machine; one is this process itself."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.remote = count != 1  # whether the calls are made in other processes

    def __call__(self, function: Callable[[Argument], Result], arguments: Sequence[Argument]) -> Iterator[Result]:
        """Do the calls; yield the results in any order, until all are done or workers are lost."""
        return on_processes(function, arguments, self.count, ordered=False)


def processes(jobs: int) -> int:
    """Return the number of processes that `jobs` asks for (-1: as many as cores); InputError for 0."""
    from joblib import effective_n_jobs

    if jobs == 0:
        raise InputError("`jobs`: expected a number of processes (-1: all cores), found 0")
    return int(effective_n_jobs(jobs))


def on_processes(
    function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int, ordered: bool = True,
    tell: Callable[[str], None] | None = None,
) -> Generator[Result]:  # fmt: skip
    """Call a function of a module for each argument, on several processes (-1: as many as cores); yield the results.

    One is this process, which does a call when its result is asked for. Results come in the order of the arguments, or
    as they are ready. A thread for each process waits for its calls: what is not needed any more, when the iterator is
    closed, is not begun. The progress of the calls goes to `tell`. Raises WorkersLostError when a process died.
    """
    if jobs == 1:
        yield from map(function, arguments)
    elif calls := list(arguments):
        with worker_processes(min(processes(jobs), len(calls)), tell) as results_of:
            yield from results_of(function, calls, ordered)


@contextmanager
def worker_processes(count: int, tell: Callable[[str], None] | None = None) -> Iterator[Callable[..., Iterator[Any]]]:
    """Begin processes that end with the block; yield what calls a function for arguments on them (`on_processes`)."""
    from joblib import cpu_count

    workers: list[WorkerProcess] = []
    idle: SimpleQueue[WorkerProcess] = SimpleQueue()

    def call(function: Callable[[Argument], Result], argument: Argument) -> Any:
        worker = idle.get()
        try:
            return worker.call(function, argument, tell)
        finally:
            idle.put(worker)

    def results_of(function: Callable[[Argument], Result], arguments: Iterable[Argument], ordered: bool = True) -> Any:
        results = [pool.submit(call, function, argument) for argument in arguments]
        return (result.result() for result in (results if ordered else as_completed(results)))

    pool = ThreadPoolExecutor(count)
    try:
        with _without_interrupts():
            workers.extend(WorkerProcess(max(cpu_count() // count, 1)) for _ in range(count))
        for worker in workers:
            idle.put(worker)
        yield results_of
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.kill()
        pool.shutdown()
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


class DaskWorkers:
    """Dask workers, by their scheduler's address (such as ``tcp://host:8786``); InputError without Dask or answer."""

    remote = True

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise InputError("`dask` needs Dask, which is not installed: pip install dask distributed") from None
        try:
            self._client = Client(address, timeout=CONNECT_S)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"`dask` {address}: expected the address of a Dask scheduler, found no answer") from error

    @property
    def count(self) -> int:
        """Number of threads of the workers that are there now, at least 1."""
        return max(1, sum(int(threads) for threads in self._client.nthreads().values()))

    def __call__(self, function: Callable[[Argument], Result], arguments: Sequence[Argument]) -> Iterator[Result]:
        """Do the calls; those of a worker that dies are done by others."""
        from distributed import CancelledError, KilledWorker, as_completed

        futures = self._client.map(function, arguments, pure=False)
        try:
            for future in as_completed(futures):
                yield future.result()
                future.release()
        except (KilledWorker, CancelledError) as error:
            raise WorkersLostError(f"{type(error).__name__}: {error}") from error
        finally:
            self._client.cancel(futures)

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close()


Workers = ThisMachine | DaskWorkers


@contextmanager
def open_workers(jobs: int, dask: str | None) -> Iterator[Workers]:
    """Open the workers that the options state, and close them at the end: processes of this machine, or Dask's.

    Errors are those of `DaskWorkers`.
    """
    if dask is None:
        yield ThisMachine(jobs)
        return
    with closing(DaskWorkers(dask)) as cluster:
        yield cluster


def complete(
    workers: Workers, function: Callable[[Argument], Result], arguments: Sequence[Argument]
) -> Iterator[tuple[int, Result | None]]:
    """Call a function of a module (or `functools.partial` of one) for each argument, again where a worker dies.

    Raises InputError if workers have another version of the package.

    Yields the number of an argument and its result, in any order. The result is None where the worker died in each of
    several attempts, the last of which had nothing else to do.
    """
    left = dict(enumerate(arguments))
    fruitless = 0
    while left and fruitless < ATTEMPTS:
        before = len(left)
        try:
            for number, result in _calls(workers, function, list(left.items())):
                del left[number]
                yield number, result
        except WorkersLostError as error:
            fruitless = 0 if len(left) < before else fruitless + 1
            LOGGER.warning("a worker died; what is left (%d of %d) starts again (%s)", len(left), before, error)
    for number, argument in left.items():
        try:
            yield from _calls(workers, function, [(number, argument)])
        except WorkersLostError:
            yield number, None


def _calls(
    workers: Workers, function: Callable[[Argument], Result], numbered: Sequence[tuple[int, Argument]]
) -> Iterator[tuple[int, Result]]:
    for version, number, result in workers(partial(_numbered, function), numbered):
        if version != stereophd.__version__:
            raise InputError(f"workers: expected stereophd {stereophd.__version__}, found {version}")
        yield number, result


def _numbered(function: Callable[[Any], Result], numbered: tuple[int, Any]) -> tuple[str, int, Result]:
    number, argument = numbered
    return stereophd.__version__, number, function(argument)
