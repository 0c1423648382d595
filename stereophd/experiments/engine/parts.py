"""Finished runs on the disk, so that an interrupted experiment continues where it stopped.

Every chunk is a file in ``DIR/partial-HASH`` (`stereophd.pipeline.runs.unfinished`); the hash covers everything that
the values of a run depend on (not the number of runs, nor the selection of results). Runs of another configuration are
therefore never used.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

import stereophd
from stereophd.config.loading import LoadedConfig
from stereophd.core.numerics.random_streams import run_number
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.work import BOUND_RUN, Chunk, RunOutcome
from stereophd.io.outputs.disk import for_arrow
from stereophd.io.outputs.provenance import sha256_of
from stereophd.io.tables.reading import damaged_is_input_error
from stereophd.pipeline.runs.unfinished import UnfinishedRun

# Characters of the name of a chunk.
NAME_LENGTH = 24

# Keys of the experiment that do not change a run.
NOT_IN_HASH = ("runs", "windows", "table", "figure")


@dataclass(frozen=True)
class RunResult:
    """A finished run; its seed is that of the table, 0 of bounds and of a run that gave nothing."""

    method: str
    case: str
    run: int
    seed: int
    series: tuple[Series, ...]
    cpu_s: float


def experiment_hash(loaded: LoadedConfig) -> str:
    """Return the hash of what decides about the values of a run, version of the package included."""
    values: dict[str, Any] = dict(loaded.resolved)
    values["experiment"] = {k: v for k, v in values["experiment"].items() if k not in NOT_IN_HASH}
    return sha256_of([stereophd.__version__, values])


@dataclass(frozen=True)
class FinishedChunk:
    """Runs of one method in one case, as they are kept."""

    method: str
    case: str
    runs: list[FinishedRun]


@dataclass(frozen=True)
class FinishedRun:
    """One of them; a run without series (no bound is known) is a finished run too."""

    run: int
    seed: int
    series: tuple[Series, ...]
    cpu_s: float


class PartStore:
    """The finished runs of one experiment, in its output folder."""

    def __init__(self, out: Path, loaded: LoadedConfig) -> None:
        self.unfinished = UnfinishedRun(out, experiment_hash(loaded))

    def add(self, chunk: Chunk, outcomes: Sequence[RunOutcome]) -> None:
        """Store the outcomes of a chunk that came without an error."""
        method, case, seed = chunk.part.method, chunk.part.case, chunk.part.config.config.seed
        runs = [
            FinishedRun(run.run, 0 if run.run == BOUND_RUN else run_number(seed, run.run), run.series, run.cpu_s)
            for run in outcomes
        ]
        key = json.dumps([method, case, [run.run for run in outcomes]])
        name = hashlib.sha256(key.encode()).hexdigest()[:NAME_LENGTH]
        self.unfinished.write(name, FinishedChunk(method, case, runs))

    def read(self) -> list[RunResult]:
        """Return all finished runs, or raise InputError when a file is damaged."""
        chunks = [self.unfinished.read(name, FinishedChunk) for name in self.unfinished.names()]
        return [
            RunResult(chunk.method, chunk.case, run.run, run.seed if run.series else 0, run.series, run.cpu_s)
            for chunk in chunks
            for run in chunk.runs
        ]


def parquet_metadata(path: Path) -> dict[bytes, bytes]:
    """Return the key-value metadata of a Parquet file, empty if it has none."""
    with damaged_is_input_error(path):
        return dict(pq.read_schema(for_arrow(path)).metadata or {})
