"""The unit of work: some runs of one method in one case, done by one process."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import stereophd
from stereophd.config.loading import LoadedConfig
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Series, find_kind, method_seconds
from stereophd.pipeline.arithmetic import within_arithmetic

# Number of the "run" that computes the bounds of a case, and the name of its "method".
BOUND_RUN = -1
BOUND_METHOD = ""


@dataclass(frozen=True)
class Part:
    """One method in one case, as a configuration; the bounds of a case are a part without a method."""

    method: str
    case: str
    kind: str
    config: LoadedConfig


@dataclass(frozen=True)
class Chunk:
    """Runs of one part."""

    part: Part
    runs: tuple[int, ...]


@dataclass(frozen=True)
class RunOutcome:
    """The outcome of one run: its series, or the error that ended it."""

    run: int
    series: tuple[Series, ...]
    error: str | None
    users: bool  # Whether the error is one of the configuration: the run would fail again
    cpu_s: float  # Processor time of the method, s


@dataclass(frozen=True)
class ChunkResult:
    """Outcomes of a chunk, and the version of the package that made them."""

    chunk: Chunk
    outcomes: tuple[RunOutcome, ...]
    version: str


def run_chunk(chunk: Chunk) -> ChunkResult:
    """Do the runs of a chunk; an error of one run leaves the others."""
    return ChunkResult(chunk, tuple(_run(chunk.part, run) for run in chunk.runs), stereophd.__version__)


def _run(part: Part, run: int) -> RunOutcome:
    start = time.thread_time()
    seconds: list[float] = []
    series: Sequence[Series] = ()
    error, users = None, False
    try:
        kind = find_kind(part.kind)
        with method_seconds() as seconds, within_arithmetic(str(part.config.path)):
            series = kind.bounds(part.config) if run == BOUND_RUN else kind.run(part.config, run)
    except Exception as failure:  # any failure is reported, and the run tried again
        error, users = f"{type(failure).__name__}: {failure}", isinstance(failure, InputError)
        if users:
            error = str(failure)
    whole = time.thread_time() - start
    return RunOutcome(run, tuple(series), error, users, sum(seconds) if seconds else whole)
