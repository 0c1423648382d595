"""Do all runs that are wanted and not there yet; a failed run is reported and tried again.

Finished runs are kept on the disk, so that an interrupted experiment continues where it stopped: every chunk is a file
in ``DIR/partial-HASH`` (`stereophd.pipeline.runs.unfinished`). The hash covers everything that the values of a run
depend on (not the number of runs, nor the selection of results), so runs of another configuration are never used.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import stereophd
from stereophd.config.loading import LoadedConfig
from stereophd.errors import InputError, StereophdError
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.work import Chunk, Part, RunResult, run_chunk
from stereophd.io.outputs.provenance import sha256_of
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.workers.places import ATTEMPTS, complete, open_workers
from stereophd.wording import LOGGER

# Called with method, case and series of a run.
See = Callable[[str, str, Sequence[Series]], None]

# Runs of a chunk: enough chunks that workers share the work evenly and little is lost at an interruption, but few
# enough that storing them takes less time than the runs.
CHUNKS_PER_WORKER = 40
MOST_RUNS_IN_CHUNK = 200

# Characters of the name of a chunk.
NAME_LENGTH = 24

# Keys of the experiment that do not change a run.
NOT_IN_HASH = ("runs", "windows", "table", "figure")


def unfinished_experiment(loaded: LoadedConfig, out: Path) -> UnfinishedRun:
    """Return the place of the finished runs of an experiment in its output folder."""
    values: dict[str, Any] = dict(loaded.resolved)
    values["experiment"] = {k: v for k, v in values["experiment"].items() if k not in NOT_IN_HASH}
    return UnfinishedRun(out, sha256_of([stereophd.__version__, values]))


def read_runs(store: UnfinishedRun) -> list[RunResult]:
    """Return all finished runs, or raise InputError when a file is damaged."""
    return [run for name in store.names() for run in store.read(name, list[RunResult])]


def execute(
    wanted: Sequence[tuple[Part, range]],
    store: UnfinishedRun,
    jobs: int,
    dask: str | None,
    progress: Progress,
    see: See,
) -> None:
    """Do the wanted runs (numbers of runs of every part) that the store does not hold, and store them.

    They run on `jobs` processes of this machine, or on the Dask scheduler at an address. `see` is called with what each
    run gave, finished earlier or now; an error that it raises ends the experiment. Raises InputError when a run reports
    that the configuration is at fault, or workers have another version of the package; StereophdError when a run failed
    `ATTEMPTS` times, or workers die without finishing a run.
    """
    done = set()
    for result in read_runs(store):
        see(result.method, result.case, result.series)
        done.add((result.method, result.case, result.run))
    missing = [(part, [run for run in runs if (part.method, part.case, run) not in done]) for part, runs in wanted]
    total, left = sum(len(runs) for _, runs in wanted), sum(len(runs) for _, runs in missing)
    if left == 0:
        return
    if left < total:
        LOGGER.info("resuming: %d of %d runs are there", total - left, total)
    kept = f"finished runs are in {store.folder}, `resume=True` continues"
    with open_workers(jobs, dask) as workers:
        chunks = _chunks(missing, workers.count)
        for attempt in range(1, ATTEMPTS + 1):
            again = []
            for number, outcomes in complete(workers, run_chunk, chunks):
                if outcomes is None:
                    raise StereophdError(f"workers died {ATTEMPTS} times without finishing a run; {kept}")
                good = [result for result in outcomes if result.error is None]
                if good:
                    key = json.dumps([good[0].method, good[0].case, [result.run for result in good]])
                    store.write(hashlib.sha256(key.encode()).hexdigest()[:NAME_LENGTH], good)
                failed = [result for result in outcomes if result.error is not None]
                _report(failed, attempt, kept)
                for result in good:
                    see(result.method, result.case, result.series)
                left -= len(good)
                progress(total - left, total)
                if failed:
                    again.append(Chunk(chunks[number].part, tuple(result.run for result in failed)))
            chunks = again


def _chunks(missing: Sequence[tuple[Part, list[int]]], workers: int) -> list[Chunk]:
    """Return the missing runs in chunks: the same run of all parts early, so that the work is even."""
    left = sum(len(runs) for _, runs in missing)
    size = min(max(left // (CHUNKS_PER_WORKER * workers), 1), MOST_RUNS_IN_CHUNK)
    pieces = [
        (start, order, Chunk(part, tuple(runs[start : start + size])))
        for order, (part, runs) in enumerate(missing)
        for start in range(0, len(runs), size)
    ]
    return [chunk for _, _, chunk in sorted(pieces, key=lambda piece: piece[:2])]


def _report(failed: Sequence[RunResult], attempt: int, kept: str) -> None:
    """Report what failed; raise an error where it is the user's, or there is no further attempt."""
    for result in failed:
        name = f"{result.method or 'bounds'}, {result.case}, run {result.run}"
        if result.users:
            raise InputError(f"{name}: {result.error}")
        if attempt == ATTEMPTS:
            raise StereophdError(f"{name}: failed {ATTEMPTS} times: {result.error}; {kept}")
        LOGGER.warning("%s: failed, will be tried again: %s", name, result.error)
