"""The report of `stereophd.commands.evaluate`: ``report.json``, ``per_scan.parquet``, and limits on its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from stereophd.core.metrics.scans import PointSets
from stereophd.errors import GateError, InputError
from stereophd.io.json_text import plain
from stereophd.io.tables import FLOAT, INTEGER, TableWriter
from stereophd.pipeline.evaluation.options import Options

if TYPE_CHECKING:
    from numpy.typing import NDArray

REPORT_VERSION = 1
INTEGER_COLUMNS = frozenset({"n_truth", "n_estimates", "n_matched", "identity_switches"})


@dataclass(frozen=True)
class Scored:
    """What was scored, and how it came out.

    Attributes
    ----------
    figures : dict
        Figures of the run, nested.
    scans : dict
        How many scans were scored, and why others were not.
    columns : dict
        Columns of ``per_scan.parquet``.
    estimates : PointSets
        The estimates of the scored scans.
    """

    figures: dict[str, Any]
    scans: dict[str, int]
    columns: dict[str, NDArray[Any]]
    estimates: PointSets


class LimitExceededError(GateError):
    """A figure is above the limit that the user set; `report` is the whole report."""

    def __init__(self, message: str, report: dict[str, Any]) -> None:
        super().__init__(message)
        self.report = report


def build_report(
    scored: Scored, options: Options, max_gap_s: float, unit: str | None, record: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the report: figures, what they mean, where they come from (`record`); NaN as None."""
    parameters = {"order": options.order, "cutoff": options.cutoff, "base": options.base}
    result = dict(scored.figures)
    result["ospa"] = {**result["ospa"], **parameters}
    result["ospa2"] = {**result["ospa2"], "window_scans": options.ospa2_window}
    result["gospa"] = {**result["gospa"], "alpha": 2.0}
    visible = None
    if options.seen_by is not None:
        visible = {"cameras": options.seen_by, "within_s": options.within_s}
    report: dict[str, Any] = plain(
        {
            "report_version": REPORT_VERSION,
            "command": "evaluate",
            "length_unit": unit,
            **result,
            "scans": scored.scans,
            "window": {"from_s": options.from_s, "to_s": options.to_s, "at": options.at},
            "max_gap_s": max_gap_s,
            "seen_by": visible,
            "provenance": record,
        }
    )
    return report


def write_per_scan(path: Path, columns: Mapping[str, NDArray[Any]], metadata: Mapping[bytes, bytes]) -> None:
    """Write the metrics of each scan; a metric that a scan does not have is null."""
    schema = pa.schema([pa.field(name, INTEGER if name in INTEGER_COLUMNS else FLOAT) for name in columns])
    with TableWriter(path, schema, metadata) as table:
        table.append({name: np.ma.masked_invalid(values) for name, values in columns.items()})


def check_limits(limits: Mapping[str, float], scored: Scored) -> None:
    """Raise InputError for a limit that is not a number or of something that is not a figure of the run."""
    known = _figures_by_key(scored.figures, scored.scans)
    for key, limit in limits.items():
        if key not in known:
            near = get_close_matches(key, known, n=1, cutoff=0.0)[0]
            raise InputError(f"`fail_above`: {key}: no such figure in the report; did you mean {near}?")
        if math.isnan(limit):
            raise InputError(f"`fail_above`: {key}: expected a number, found {limit}")


def raise_if_above(limits: Mapping[str, float], report: Mapping[str, Any]) -> None:
    """Raise LimitExceededError naming every figure above its limit; a null one counts as above."""
    failed = []
    for key, limit in limits.items():
        value = _figures_by_key(report, report["scans"])[key]
        if value is None or value > limit:
            failed.append(f"{key} is {'null' if value is None else format(value, '.6g')}, limit {limit:g}")
    if failed:
        raise LimitExceededError("above the limit: " + "; ".join(failed), dict(report))


def _figures_by_key(figures: Mapping[str, Any], scans: Mapping[str, int]) -> dict[str, float | None]:
    """Return the numbers of nested figures by dotted key, such as ``ospa.mean``."""
    flat: dict[str, float | None] = {}
    for group, values in {**figures, "scans": scans}.items():
        named = values.items() if isinstance(values, Mapping) else [("", values)]
        for name, value in named:
            if value is None or isinstance(value, int | float):
                flat[f"{group}.{name}".rstrip(".")] = value
    return flat
