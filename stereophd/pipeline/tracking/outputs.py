"""Outputs of `stereophd.commands.track`: rows of events and estimates, figures of each identity."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from stereophd.config.report import ReportConfig
from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.considered import CameraUncertainty, CommonPart
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.io.tables.schemas import CAMERAS_PART, CONFIRMED, EXTENTS, STD, TENTATIVE
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.run_figures.figures import RunFigures

STATE_COLUMNS = ("x", "y", "z", "vx", "vy", "vz")


@dataclass(frozen=True)
class Tables:
    """Tables of the records of a run: a row for each estimate, for each event and, if wanted, for each association."""

    tracks: TableWriter
    scans: TableWriter
    associations: TableWriter | None = None


class RecordWriter:
    """Writes what is to be reported as it comes, and counts the figures of the run.

    The cameras are in order, for the figures of each. `report` says which estimates are written, and which columns;
    `figures` are where the run begins, and are kept up to date.
    """

    def __init__(
        self, tables: Tables, cameras: Sequence[Camera], report: ReportConfig, figures: RunFigures | None = None,
        uncertainty: CameraUncertainty | None = None,
    ) -> None:  # fmt: skip
        self._tables, self._report, self._uncertainty = tables, report, uncertainty
        self._cameras = {camera.name: camera for camera in cameras}
        self._figures = RunFigures() if figures is None else figures

    def add(self, record: Record) -> None:
        """Write a record."""
        tables, report, figures = self._tables, self._report, self._figures
        figures.add(record, self._cameras)
        if tables.associations is not None:
            for sightings in record.associations:
                tables.associations.append(sightings.columns())
        if not record.reported:
            return
        estimates = record.estimates
        if report.max_position_std is not None:
            estimates = estimates.certain(report.max_position_std)
        key = {"time_s": record.time_s, "camera": record.camera, "frame": record.frame}
        tables.scans.append(
            {
                **key,
                "n_detections": np.array([figures.new_detections]),
                "cardinality_mean": record.info.cardinality_mean,
                "cardinality_estimate": len(estimates.track_ids),
                "log_likelihood": figures.new_log_likelihood,
                "n_components": record.info.n_components,
            }
        )
        figures.new_detections, figures.new_log_likelihood = 0, 0.0
        for level, status in ((estimates, CONFIRMED), (estimates.tentative, TENTATIVE)):
            if level is not None and len(level.track_ids):
                tables.tracks.append({**key, **self._columns(level, record.time_s), "status": status})
        figures.add_estimates(estimates, record.time_s)

    def summary(self) -> dict[str, Any]:
        """Return the figures of the run for ``report.json``."""
        return self._figures.report(self._cameras, self._tables.scans.rows, self._tables.tracks.rows)

    def _columns(self, estimates: Estimates, time_s: float) -> dict[str, Any]:
        """Columns of ``tracks.parquet`` of one event; covariances with the part of uncertain cameras, if any."""
        if self._uncertainty is None:
            return _columns(estimates, self._report.std_columns)
        moves = self._uncertainty.moves(np.full(len(estimates.states), time_s), estimates.states, estimates.covariances)
        sums = CommonPart.of(estimates.states[:, :3], moves @ self._uncertainty.root)
        before = self._figures.cameras_part
        self._figures.cameras_part = sums if before is None else before.joined(sums)
        added = self._uncertainty.added(moves)
        whole = replace(estimates, covariances=estimates.covariances + added)
        return {**_columns(whole, self._report.std_columns), CAMERAS_PART.name: added}


def _columns(estimates: Estimates, std_columns: bool) -> dict[str, Any]:
    """Columns of ``tracks.parquet`` of one event."""
    std = np.sqrt(np.diagonal(estimates.covariances[:, :3, :3], axis1=1, axis2=2)) if std_columns else None
    return {
        "track_id": estimates.track_ids,
        **{name: estimates.states[:, axis] for axis, name in enumerate(STATE_COLUMNS)},
        "covariance": estimates.covariances,
        "existence": estimates.existence,
        **({} if estimates.extents is None else _named(EXTENTS, estimates.extents)),
        **({} if std is None else _named(STD, std)),
    }


def _named(fields: Sequence[pa.Field], values: Array) -> dict[str, Any]:
    """Return the columns of an array (n, c) by the names of their fields."""
    return {field.name: values[:, number] for number, field in enumerate(fields)}
