"""Outputs of `stereophd.commands.track`: rows of events and estimates, figures of each identity."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereophd.config.report import ReportConfig
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.estimates import Estimates
from stereophd.io.table_schemas import CONFIRMED, STD, TENTATIVE
from stereophd.io.table_writing import TableWriter
from stereophd.pipeline.tracking.figures import RunFigures
from stereophd.pipeline.tracking.loop import Record

STATE_COLUMNS = ("x", "y", "z", "vx", "vy", "vz")


@dataclass(frozen=True)
class Tables:
    """Tables of the records of a run: a row for each estimate, for each event and, if wanted, for each association."""

    tracks: TableWriter
    scans: TableWriter
    associations: TableWriter | None = None


def write_records(
    records: Iterable[Record], tables: Tables, cameras: Sequence[Camera], report: ReportConfig
) -> dict[str, Any]:
    """Write what is to be reported as it comes; return the figures of the run for ``report.json``.

    Parameters
    ----------
    records : iterable of Record
    tables : Tables
    cameras : sequence of Camera
        In order, for the figures of each camera.
    report : ReportConfig
        Which estimates are written, and which columns.
    """
    tracks, scans = tables.tracks, tables.scans
    figures = RunFigures(cameras)
    # since the last row: what happened between two reports belongs to the second
    new_detections, new_log_likelihood = 0, 0.0
    for record in records:
        figures.add(record)
        new_detections += record.n_detections
        new_log_likelihood += record.info.log_likelihood
        if tables.associations is not None:
            for sightings in record.associations:
                tables.associations.append(sightings.columns())
        if not record.reported:
            continue
        estimates = record.estimates
        if report.max_position_std is not None:
            estimates = estimates.certain(report.max_position_std)
        key = {"time_s": record.time_s, "camera": record.camera, "frame": record.frame}
        scans.append(
            {
                **key,
                "n_detections": np.array([new_detections]),
                "cardinality_mean": record.info.cardinality_mean,
                "cardinality_estimate": len(estimates.track_ids),
                "log_likelihood": new_log_likelihood,
                "n_components": record.info.n_components,
            }
        )
        new_detections, new_log_likelihood = 0, 0.0
        for level, status in ((estimates, CONFIRMED), (estimates.tentative, TENTATIVE)):
            if level is not None and len(level.track_ids):
                tracks.append({**key, **_columns(level, report.std_columns), "status": status})
        figures.add_estimates(estimates, record.time_s)
    return figures.report(scans.rows, tracks.rows)


def _columns(estimates: Estimates, std_columns: bool) -> dict[str, Any]:
    """Columns of ``tracks.parquet`` of one event."""
    std = np.sqrt(np.diagonal(estimates.covariances[:, :3, :3], axis1=1, axis2=2)) if std_columns else None
    return {
        "track_id": estimates.track_ids,
        **{name: estimates.states[:, axis] for axis, name in enumerate(STATE_COLUMNS)},
        "covariance": estimates.covariances,
        "existence": estimates.existence,
        **({} if std is None else {field.name: std[:, axis] for axis, field in enumerate(STD)}),
    }
