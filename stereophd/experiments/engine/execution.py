"""Do all runs that are wanted and not there yet; a failed run is reported and tried again."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import stereophd
from stereophd.errors import InputError, StereophdError
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.parts import PartStore
from stereophd.experiments.engine.work import Chunk, ChunkResult, Part, run_chunk
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.workers.places import ATTEMPTS, Workers, WorkersLostError, open_workers
from stereophd.wording import LOGGER

# Called with method, case and series of a run.
See = Callable[[str, str, Sequence[Series]], None]

# Runs of a chunk: enough chunks that workers share the work evenly and little is lost at an interruption, but few
# enough that storing them takes less time than the runs.
CHUNKS_PER_WORKER = 40
MOST_RUNS_IN_CHUNK = 200


@dataclass
class _Ledger:
    """Finished and missing runs, and how often each run failed."""

    parts: Mapping[tuple[str, str], Part]
    missing: dict[tuple[str, str], list[int]]
    total: int
    failures: dict[tuple[str, str, int], int] = field(default_factory=dict)

    @property
    def left(self) -> int:
        """Number of runs that are missing."""
        return sum(map(len, self.missing.values()))

    def chunks(self, workers: int) -> list[Chunk]:
        """Return the missing runs in chunks: the same run of all parts early, so that the work is even."""
        size = min(max(self.left // (CHUNKS_PER_WORKER * workers), 1), MOST_RUNS_IN_CHUNK)
        pieces = [
            (start, order, Chunk(self.parts[key], tuple(runs[start : start + size])))
            for order, (key, runs) in enumerate(self.missing.items())
            for start in range(0, len(runs), size)
        ]
        return [chunk for _, _, chunk in sorted(pieces, key=lambda piece: piece[:2])]


def execute(
    wanted: Sequence[tuple[Part, range]],
    store: PartStore,
    jobs: int,
    dask: str | None,
    progress: Progress | None,
    see: See,
) -> None:
    """Do the wanted runs (numbers of runs of every part) that the store does not hold, and store them.

    They run on `jobs` processes of this machine, or on the Dask scheduler at an address. `see` is called with what each
    run gave, finished earlier or now; an error that it raises ends the experiment. Raises InputError when a run reports
    that the configuration is at fault, or workers have another version of the package; StereophdError when a run failed
    `ATTEMPTS` times, or workers die without finishing a run.
    """
    done = set()
    for result in store.read():
        see(result.method, result.case, result.series)
        done.add((result.method, result.case, result.run))
    parts = {(part.method, part.case): part for part, _ in wanted}
    missing = {
        (part.method, part.case): [run for run in runs if (part.method, part.case, run) not in done]
        for part, runs in wanted
    }
    ledger = _Ledger(parts, missing, sum(len(runs) for _, runs in wanted))
    if ledger.left == 0:
        return
    if ledger.left < ledger.total:
        LOGGER.info("resuming: %d of %d runs are there", ledger.total - ledger.left, ledger.total)
    with open_workers(jobs, dask) as workers:
        _work(ledger, store, workers, progress, see)


def _work(ledger: _Ledger, store: PartStore, workers: Workers, progress: Progress | None, see: See) -> None:
    fruitless = 0
    while ledger.left:
        before = ledger.left
        try:
            for result in workers(run_chunk, ledger.chunks(workers.count)):
                _take(ledger, store, result)
                for outcome in result.outcomes:
                    if outcome.error is None:
                        see(outcome.result.method, outcome.result.case, outcome.result.series)
                if progress is not None:
                    progress(ledger.total - ledger.left, ledger.total)
        except WorkersLostError as error:
            fruitless = 0 if ledger.left < before else fruitless + 1
            if fruitless == ATTEMPTS:
                raise StereophdError(
                    f"workers died {ATTEMPTS} times without finishing a run: {error}; finished runs are in "
                    f"{store.unfinished.folder}, `resume=True` continues"
                ) from error
            LOGGER.warning("a worker died; the %d runs that are left go to new ones (%s)", ledger.left, error)


def _take(ledger: _Ledger, store: PartStore, result: ChunkResult) -> None:
    """Store the results of a chunk, report what failed, and do not repeat what fails again and again."""
    if result.version != stereophd.__version__:
        raise InputError(f"workers: expected stereophd {stereophd.__version__}, found {result.version}")
    good = [outcome.result for outcome in result.outcomes if outcome.error is None]
    if good:
        store.add(good)
        missing = ledger.missing[good[0].method, good[0].case]
        missing[:] = sorted(set(missing) - {run.run for run in good})
    for outcome in result.outcomes:
        if outcome.error is None:
            continue
        method, case, run = key = outcome.result.method, outcome.result.case, outcome.result.run
        name = f"{method or 'bounds'}, {case}, run {run}"
        if outcome.users:
            raise InputError(f"{name}: {outcome.error}")
        count = ledger.failures[key] = ledger.failures.get(key, 0) + 1
        if count == ATTEMPTS:
            raise StereophdError(
                f"{name}: failed {ATTEMPTS} times: {outcome.error}; finished runs are in {store.unfinished.folder}, "
                "`resume=True` continues"
            )
        LOGGER.warning("%s: failed, will be tried again: %s", name, outcome.error)
