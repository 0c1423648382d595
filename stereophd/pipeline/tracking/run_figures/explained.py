"""How well tracks explain the detections of each camera: the share that belongs to tracks, and the residuals."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.io.outputs.json_text import finite_or_none
from stereophd.pipeline.tracking.associations import Associated
from stereophd.pipeline.tracking.loop import Record

# A detection that belongs to a track more probably than not has a residual.
PROBABLE = 0.5
# Residuals computed at a time.
BATCH = 2048
# Residuals above this many times the median are those of wrong detections, and say nothing about the noise.
OUTLIER = 8.0
# Step of the derivatives of a projection, over the standard deviation of the position.
DERIVATIVE_STEP = 0.1


def residuals_px(camera: Camera, times: Array, states: Array, pixels: Array) -> Array:
    """Return detections minus reprojected states (n, 2), in distorted pixels; NaN where a state is out of view.

    Times of the frames are (n,), s; positions and velocities at these times (n, 6); pixels (n, 2) as in the log. A
    rolling shutter reads a row later: the detection shows the object at its position at that later time.
    """
    delays = camera.row_delays(pixels[:, 1])
    if delays is None:
        return np.asarray(pixels - camera.project_at(states[:, :3], times))
    return np.asarray(pixels - camera.project_at(states[:, :3] + delays[:, None] * states[:, 3:], times + delays))


def expected_squares(camera: Camera, times: Array, states: Array, covariances: Array) -> Array:
    """Return the squares (n,) of residuals, both axes together, that noise and uncertainty lead to expect, px^2.

    An estimate that has taken in a detection of noise R has residuals of the covariance R - H P H^T, with its own
    covariance P: less than the noise, as the estimate has moved towards the detection. Times and states are those of
    `residuals_px`; the covariances (n, 3, 3) are those of the positions.
    """
    steps = DERIVATIVE_STEP * np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2) / 3.0, 1e-24))
    moved = states[:, None, :3] + np.eye(3) * steps[:, None, None]
    there = camera.project_at(moved.reshape(-1, 3), np.repeat(times, 3)).reshape(-1, 3, 2)
    jacobian = np.swapaxes((there - camera.project_at(states[:, :3], times)[:, None]) / steps[:, None, None], 1, 2)
    explained = np.einsum("nij,njk,nik->ni", jacobian, covariances, jacobian)
    return np.asarray(np.maximum(np.asarray(camera.detector.sigma) ** 2 - explained, 0.0).sum(axis=1))


@dataclass
class CameraSums:
    """Sums over what one camera reported, and the states and detections whose residuals are still to be computed."""

    frames: int = 0
    detections: int = 0
    outside: int = 0  # Those that see nothing of the region, or are of tracks beside it
    explained: float = 0.0
    residuals: int = 0
    total: Array = field(default_factory=lambda: np.zeros(2))
    squares: float = 0.0
    # Squares of the residuals without outliers, and those that are expected. They are compared for points alone: the
    # middle of a box is not the image of the middle of a body, and its noise is a part of its size.
    usual: float = 0.0
    expected: float = 0.0
    of_points: bool = True
    times: list[float] = field(default_factory=list)
    states: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    pixels: list[Array] = field(default_factory=list)

    def add(self, record: Record, sightings: Associated, camera: Camera) -> None:
        """Take in detections of this camera that tracks claim; those of the record's event have residuals."""
        self.explained += float(sightings.probabilities.sum())
        if sightings.time_s != record.time_s or not record.is_event or sightings.camera != record.camera:
            return
        self.of_points = record.estimates.extents is None
        place = {track: row for row, track in enumerate(record.estimates.track_ids.tolist())}
        ids = sightings.track_ids.tolist()
        for row in np.flatnonzero(sightings.probabilities > PROBABLE).tolist():
            if ids[row] in place:
                self.times.append(record.time_s)
                self.states.append(record.estimates.states[place[ids[row]]])
                self.covariances.append(record.estimates.covariances[place[ids[row]], :3, :3])
                self.pixels.append(sightings.pixels[row])
        if len(self.times) >= BATCH:
            self._compute(camera)

    def _compute(self, camera: Camera) -> None:
        """Compute the residuals that wait."""
        if not self.times:
            return
        times, states = np.array(self.times), np.array(self.states)
        found = residuals_px(camera, times, states, np.array(self.pixels))
        expected = expected_squares(camera, times, states, np.array(self.covariances))
        usable = np.isfinite(found).all(axis=1) & np.isfinite(expected)
        found = found[usable]
        squares = (found**2).sum(axis=1)
        usual = squares <= OUTLIER**2 * np.median(squares) if len(squares) else squares > 0.0
        self.expected += float(expected[usable][usual].sum())
        self.usual += float(squares[usual].sum())
        self.residuals += len(found)
        self.total = self.total + found.sum(axis=0)
        self.squares += float(squares.sum())
        self.times, self.states, self.covariances, self.pixels = [], [], [], []

    def report(self, camera: Camera) -> dict[str, Any]:
        """Return the figures for ``report.json``."""
        self._compute(camera)
        count, compared = self.residuals, self.of_points and self.expected > 0.0
        return {
            "frames": self.frames,
            "detections": self.detections,
            "outside_region": self.outside,
            "explained_detections": self.explained,
            "explained_share": finite_or_none(self.explained / self.detections) if self.detections else None,
            "residuals": count,
            # Root mean square of one axis.
            "residual_rms_px": float(np.sqrt(self.squares / (2 * count))) if count else None,
            # Over what the stated noise leads to expect of an estimate that has taken in the detection.
            "residual_ratio": float(np.sqrt(self.usual / self.expected)) if compared else None,
            "residual_mean_px": (self.total / count).tolist() if count else None,
        }
