"""Finished runs on the disk, so that an interrupted experiment continues where it stopped.

Every chunk is a file in ``DIR/partial-HASH`` (`stereophd.pipeline.runs.unfinished`); the hash covers everything that
the values of a run depend on (not the number of runs, nor the selection of results). Runs of another configuration are
therefore never used.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

import stereophd
from stereophd.config.loading import LoadedConfig
from stereophd.experiments.engine.work import RunResult
from stereophd.io.outputs.disk import for_arrow
from stereophd.io.outputs.provenance import sha256_of
from stereophd.io.tables.reading import damaged_is_input_error
from stereophd.pipeline.runs.unfinished import UnfinishedRun

# Characters of the name of a chunk.
NAME_LENGTH = 24

# Keys of the experiment that do not change a run.
NOT_IN_HASH = ("runs", "windows", "table", "figure")


def experiment_hash(loaded: LoadedConfig) -> str:
    """Return the hash of what decides about the values of a run, version of the package included."""
    values: dict[str, Any] = dict(loaded.resolved)
    values["experiment"] = {k: v for k, v in values["experiment"].items() if k not in NOT_IN_HASH}
    return sha256_of([stereophd.__version__, values])


class PartStore:
    """The finished runs of one experiment, in its output folder."""

    def __init__(self, out: Path, loaded: LoadedConfig) -> None:
        self.unfinished = UnfinishedRun(out, experiment_hash(loaded))

    def add(self, runs: Sequence[RunResult]) -> None:
        """Store the runs of a chunk that came without an error."""
        key = json.dumps([runs[0].method, runs[0].case, [run.run for run in runs]])
        name = hashlib.sha256(key.encode()).hexdigest()[:NAME_LENGTH]
        self.unfinished.write(name, runs)

    def read(self) -> list[RunResult]:
        """Return all finished runs, or raise InputError when a file is damaged."""
        return [run for name in self.unfinished.names() for run in self.unfinished.read(name, list[RunResult])]


def parquet_metadata(path: Path) -> dict[bytes, bytes]:
    """Return the key-value metadata of a Parquet file, empty if it has none."""
    with damaged_is_input_error(path):
        return dict(pq.read_schema(for_arrow(path)).metadata or {})
