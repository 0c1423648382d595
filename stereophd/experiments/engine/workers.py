"""Where chunks are done: in this process, on the cores of this machine, on a Dask cluster.

All three yield results in any order; what they hold does not depend on where they were made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool

from stereophd.errors import InputError
from stereophd.experiments.engine.work import Chunk, ChunkResult, run_chunk
from stereophd.pipeline.processes import on_processes

# Does chunks, and yields results until all are done or workers are lost.
Workers = Callable[[Sequence[Chunk]], Iterator[ChunkResult]]

# How long a scheduler may take to answer, s.
CONNECT_S = 10


class WorkersLostError(Exception):
    """Worker processes died; the chunks without a result are to be done again."""


def in_this_process(chunks: Sequence[Chunk]) -> Iterator[ChunkResult]:
    """Do chunks one after the other."""
    return map(run_chunk, chunks)


def on_cores(jobs: int) -> Workers:
    """Return workers on `jobs` processes of this machine."""

    def work(chunks: Sequence[Chunk]) -> Iterator[ChunkResult]:
        try:
            yield from on_processes(run_chunk, chunks, jobs, ordered=False)
        except BrokenProcessPool as error:
            raise WorkersLostError(str(error).split("\n")[0]) from error

    return work


class DaskWorkers:
    """Workers of a Dask cluster.

    Parameters
    ----------
    address : str
        Of its scheduler, such as ``tcp://host:8786``.

    Raises
    ------
    InputError
        Dask is not installed, or no scheduler answers there.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise InputError("`dask` needs Dask, which is not installed: pip install 'stereophd[dask]'") from None
        try:
            self._client = Client(address, timeout=CONNECT_S)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"`dask` {address}: expected the address of a Dask scheduler, found no answer") from error

    @property
    def count(self) -> int:
        """Number of threads of the workers that are there now, at least 1."""
        return max(1, sum(int(threads) for threads in self._client.nthreads().values()))

    def __call__(self, chunks: Sequence[Chunk]) -> Iterator[ChunkResult]:
        """Do chunks; those of a worker that dies are done by others."""
        from distributed import CancelledError, KilledWorker, as_completed

        futures = self._client.map(run_chunk, chunks, pure=False)
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
