"""The report of `stereophd.commands.evaluate`: ``report.json``, and ``per_scan.parquet``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from stereophd.io.outputs.json_text import REPORT_VERSION, plain
from stereophd.io.tables.schemas import FLOAT, INTEGER
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.evaluation.options import ScoreOptions
from stereophd.pipeline.evaluation.scoring import Scored, registration_report

INTEGER_COLUMNS = frozenset({"n_truth", "n_estimates", "n_matched", "identity_switches"})


def build_report(
    scored: Scored, options: ScoreOptions, max_gap_s: float, unit: str | None, record: Mapping[str, Any],
    judged: list[dict[str, Any]],
) -> dict[str, Any]:  # fmt: skip
    """Return the report: figures, what they mean, their gates `judged`, their origin (`record`); NaN as None."""
    parameters = {"order": options.order, "cutoff": options.known_cutoff, "base": options.base}
    result = dict(scored.figures)
    result["ospa"] = {**result["ospa"], **parameters}
    result["ospa2"] = {**result["ospa2"], "window_scans": options.ospa2_window}
    result["gospa"] = {**result["gospa"], "alpha": 2.0}
    visible = None if options.seen_by is None else {"cameras": options.seen_by, "within_s": options.within_s}
    report: dict[str, Any] = plain(
        {
            "report_version": REPORT_VERSION,
            "command": "evaluate",
            "length_unit": unit,
            **result,
            "scans": scored.scans,
            "window": {"from_s": options.from_s, "to_s": options.to_s, "at": options.at},
            "match_distance": options.known_cutoff if options.match_distance is None else options.match_distance,
            "max_gap_s": max_gap_s,
            "plane": options.plane,
            "region": options.region,
            "seen_by": visible,
            "tentative": options.tentative,
            "alignment": {
                "frame": options.align,
                "clock": options.align_clock,
                "found": registration_report(scored.registration),
            },
            "gates": judged,
            "provenance": record,
        }
    )
    return report


def write_per_scan(path: Path, columns: Mapping[str, NDArray[Any]], metadata: Mapping[bytes, bytes]) -> None:
    """Write the metrics of each scan; a metric that a scan does not have is null."""
    schema = pa.schema([pa.field(name, INTEGER if name in INTEGER_COLUMNS else FLOAT) for name in columns])
    with TableWriter(path, schema, metadata) as table:
        table.append({name: np.ma.masked_invalid(values) for name, values in columns.items()})
