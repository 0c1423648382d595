"""Finished runs on the disk, so that an interrupted experiment continues where it stopped.

Every chunk is a small Parquet file in ``DIR/partial-HASH``; the hash covers everything that the values of a run depend
on (not the number of runs, nor the selection of results). Runs of another configuration are therefore never used.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq

import stereophd
from stereophd.core.arrays import Array
from stereophd.core.numerics.random_streams import run_number
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.tables import columns_of, pieces
from stereophd.experiments.engine.work import BOUND_RUN, Chunk, RunOutcome
from stereophd.io.outputs.atomic import TEMPORARY_PREFIX, atomic_write
from stereophd.io.outputs.commit import files_below
from stereophd.io.outputs.disk import for_arrow
from stereophd.io.outputs.provenance import sha256_of
from stereophd.io.tables.reading import damaged_is_input_error, open_parquet
from stereophd.io.tables.schemas import RUNS
from stereophd.io.tables.writing import TableWriter

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig

PREFIX = "partial-"
PATTERN = f"{PREFIX}*/*.parquet"
HASH_LENGTH = 16
_FOLDER_NAME = re.compile(rf"{PREFIX}[0-9a-f]{{{HASH_LENGTH}}}")

# Keys of the experiment that do not change a run.
NOT_IN_HASH = ("runs", "windows", "table", "figure")

ABOUT_KEY = b"about"


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


class PartStore:
    """The folder of finished runs of one experiment.

    Parameters
    ----------
    out : Path
        Output folder.
    loaded : LoadedConfig
        The experiment.
    """

    def __init__(self, out: Path, loaded: LoadedConfig) -> None:
        self.folder = out / f"{PREFIX}{experiment_hash(loaded)[:HASH_LENGTH]}"

    def others(self) -> list[Path]:
        """Return the folders of other configurations beside this one."""
        return sorted(p for p in self.folder.parent.glob(f"{PREFIX}*") if p.is_dir() and p != self.folder)

    def remove(self, others_only: bool) -> None:
        """Remove finished runs: those of other configurations, and this one's unless `others_only`.

        Raises
        ------
        InputError
            A folder has the name of ours, and does not hold finished runs: nothing is removed.
        """
        folders = [*self.others(), *([] if others_only or not self.folder.exists() else [self.folder])]
        for folder in folders:
            foreign = [path for path in files_below(folder) if not (_is_leftover(path) or is_part(folder / path))]
            if foreign or not _FOLDER_NAME.fullmatch(folder.name):
                raise InputError(
                    f"output folder {self.folder.parent} holds {Path(folder.name, *foreign[:1])}, which is not a part "
                    "of an experiment; move it away, or choose another folder"
                )
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)

    def exists(self) -> bool:
        """Whether there are finished runs."""
        return any(self.folder.glob("*.parquet"))

    def add(self, chunk: Chunk, outcomes: Sequence[RunOutcome]) -> None:
        """Store the outcomes of a chunk that came without an error."""
        method, case = chunk.part.method, chunk.part.case
        key = json.dumps([method, case, [outcome.run for outcome in outcomes]])
        self.folder.mkdir(parents=True, exist_ok=True)
        name = f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.parquet"
        # a run without rows (no bound is known) is a finished run too
        cpu_s = [[outcome.run, outcome.cpu_s] for outcome in outcomes]
        about = json.dumps({"method": method, "case": case, "cpu_s": cpu_s})
        with (
            atomic_write(self.folder / name) as path,
            TableWriter(path, RUNS, {ABOUT_KEY: about.encode()}) as table,
        ):
            for outcome in outcomes:
                bound = outcome.run == BOUND_RUN
                seed = 0 if bound else run_number(chunk.part.config.config.seed, outcome.run)
                for series in outcome.series:
                    table.append(columns_of("", method, case, outcome.run, seed, series))

    def read(self) -> list[RunResult]:
        """Return all finished runs.

        Raises
        ------
        InputError
            A file is damaged.
        """
        return [result for path in sorted(self.folder.glob("*.parquet")) for result in _read(path)]


def _read(path: Path) -> Iterable[RunResult]:
    with open_parquet(path, "part of an experiment") as parquet:
        schema = parquet.schema_arrow
        if schema.names != RUNS.names or ABOUT_KEY not in (schema.metadata or {}):
            raise InputError(f"{path}: expected a part of an experiment, found another table; remove it")
        with damaged_is_input_error(path):
            table = parquet.read()
    about = json.loads(schema.metadata[ABOUT_KEY])
    quantities, units = table.column("quantity").to_pylist(), table.column("unit").to_pylist()
    runs = table.column("run").to_numpy()
    seeds, values = table.column("seed").to_numpy(), table.column("value").to_numpy()
    times = table.column("time_s").to_numpy(zero_copy_only=False)  # null becomes NaN
    for run, cpu_s in about["cpu_s"]:
        start, end = np.searchsorted(runs, [run, run + 1]).tolist()
        series = _series(quantities[start:end], units[start:end], times[start:end], values[start:end])
        seed = int(seeds[start]) if end > start else 0
        yield RunResult(about["method"], about["case"], run, seed, tuple(series), cpu_s)


def _series(quantities: list[str], units: list[str], times_s: Array, values: Array) -> Iterable[Series]:
    for piece in pieces(quantities, times_s):
        own = None if np.isnan(times_s[piece.start]) else times_s[piece]
        yield Series(quantities[piece.start], units[piece.start], values[piece], own)


def _is_leftover(path: Path) -> bool:
    """Whether a file is one that a killed process was writing."""
    return path.name.startswith(TEMPORARY_PREFIX)


def is_part(path: Path) -> bool:
    """Whether a file carries the mark of a part of an experiment."""
    try:
        return ABOUT_KEY in (pq.read_schema(for_arrow(path)).metadata or {})
    except (OSError, ValueError):  # ValueError: damaged, or another kind of file
        return False


def parquet_metadata(path: Path) -> dict[bytes, bytes]:
    """Return the key-value metadata of a Parquet file, empty if it has none."""
    with damaged_is_input_error(path):
        return dict(pq.read_schema(for_arrow(path)).metadata or {})
