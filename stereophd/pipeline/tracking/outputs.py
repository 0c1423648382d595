"""Outputs of `stereophd.commands.track`: rows of events and estimates, figures of each identity."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereophd.config.report import ReportConfig
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.estimates import Estimates
from stereophd.io.table_schemas import CONFIRMED, STD, TENTATIVE
from stereophd.io.table_writing import TableWriter
from stereophd.pipeline.tracking.explained import Explained
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.losses import Losses

STATE_COLUMNS = ("x", "y", "z", "vx", "vy", "vz")


@dataclass
class _Identity:
    """Running figures of one track."""

    first_s: float
    last_s: float
    n_estimates: int = 0
    existence: float = 0.0
    speed: float = 0.0
    position_std: float = 0.0


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
    explained = Explained(cameras)
    identities: dict[int, _Identity] = {}
    detections: dict[int, Counter[str]] = {}
    events, confirmed, log_likelihood = 0, 0, 0.0
    first_s, last_s = math.nan, math.nan
    # since the last row: what happened between two reports belongs to the second
    new_detections, new_log_likelihood = 0, 0.0
    losses = Losses()
    for record in records:
        losses.add(record)
        if record.is_event:
            events += 1
            first_s, last_s = (record.time_s if events == 1 else first_s), record.time_s
        log_likelihood += record.info.log_likelihood
        new_detections += record.n_detections
        new_log_likelihood += record.info.log_likelihood
        for track_id, counts in record.attributed.items():
            detections.setdefault(track_id, Counter()).update(counts)
        explained.add(record)
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
        confirmed += len(estimates.track_ids)
        _summarise(identities, estimates, record.time_s)
    return {
        "events": events,
        "duration_s": last_s - first_s,
        "reports": scans.rows,
        "estimates": confirmed,
        "tentative_estimates": tracks.rows - confirmed,
        "log_likelihood": log_likelihood,
        "left_out": losses.report(),
        "cameras": explained.report(),
        "tracks": [
            {
                "track_id": track_id,
                "first_s": identity.first_s,
                "last_s": identity.last_s,
                "n_estimates": identity.n_estimates,
                "n_detections": {camera.name: detections.get(track_id, Counter())[camera.name] for camera in cameras},
                "mean_existence": identity.existence / identity.n_estimates,
                "mean_speed": identity.speed / identity.n_estimates,
                "mean_position_std": identity.position_std / identity.n_estimates,
            }
            for track_id, identity in sorted(identities.items())
        ],
    }


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


def _summarise(identities: dict[int, _Identity], estimates: Estimates, time_s: float) -> None:
    if not len(estimates.track_ids):
        return
    speeds = np.sqrt(np.einsum("ni,ni->n", estimates.states[:, 3:], estimates.states[:, 3:]))
    stds = np.sqrt(np.trace(estimates.covariances[:, :3, :3], axis1=1, axis2=2))
    columns = (estimates.track_ids, estimates.existence, speeds, stds)
    for track_id, existence, speed, std in zip(*(column.tolist() for column in columns), strict=True):
        identity = identities.setdefault(track_id, _Identity(time_s, time_s))
        identity.last_s = time_s
        identity.n_estimates += 1
        identity.existence += existence
        identity.speed += speed
        identity.position_std += std
