"""Series and summaries as rows of ``runs.parquet`` and ``summary.parquet``, and back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.summary import Summary
from stereophd.io.tables.reading import read_table
from stereophd.io.tables.schemas import FLOAT, INTEGER, STRING

STATISTICS = ("mean", "std", "ci_low", "ci_high", "bound")


def columns_of(experiment: str, method: str, case: str, run: int, seed: int, series: Series) -> dict[str, Any]:
    """Return rows of ``runs.parquet``."""
    times: Any = [None] * len(series.values) if series.times_s is None else series.times_s
    return {
        "experiment": experiment,
        "method": method,
        "case": case,
        "run": run,
        "seed": seed,
        "time_s": times,
        "quantity": series.quantity,
        "unit": series.unit,
        "value": series.values,
    }


def columns_of_summary(experiment: str, method: str, case: str, summary: Summary) -> dict[str, Any]:
    """Return rows of ``summary.parquet``; what is not defined is null."""
    times: Any = [None] * len(summary.mean) if summary.times_s is None else summary.times_s
    return {
        "experiment": experiment,
        "method": method,
        "case": case,
        "time_s": times,
        "quantity": summary.quantity,
        "unit": summary.unit,
        "runs": summary.runs,
        **{name: np.ma.masked_invalid(getattr(summary, name)) for name in STATISTICS},
    }


def read_summaries(path: Path) -> Iterator[tuple[str, str, Summary]]:
    """Yield method, case and summary of every quantity of a ``summary.parquet``; errors as of `read_table`."""
    texts = ("method", "case", "quantity", "unit")
    numbers = ("time_s", *STATISTICS)
    required = {**dict.fromkeys(texts, STRING), "runs": INTEGER}
    table = read_table(path, required, dict.fromkeys(numbers, FLOAT), what="summary of an experiment")
    text = {name: table.column(name).to_pylist() for name in texts}
    number = {name: table.column(name).to_numpy(zero_copy_only=False) for name in numbers}
    runs = table.column("runs").to_numpy()
    keys = list(zip(*text.values(), strict=True))
    for piece in pieces(keys, number["time_s"]):
        method, case, quantity, unit = keys[piece.start]
        times_s = None if np.isnan(number["time_s"][piece.start]) else number["time_s"][piece]
        values = {name: number[name][piece] for name in STATISTICS}
        yield method, case, Summary(quantity, unit, times_s, runs[piece], **values)


def pieces(keys: Sequence[Any], times_s: Array) -> Iterator[slice]:
    """Yield the rows of each series: those with one key and times (NaN: no time, one row)."""
    whole = np.isnan(times_s)
    starts = [i for i in range(len(keys)) if i == 0 or keys[i] != keys[i - 1] or bool(whole[i]) or bool(whole[i - 1])]
    for start, end in zip(starts, [*starts, len(keys)][1:], strict=False):
        yield slice(start, end)
