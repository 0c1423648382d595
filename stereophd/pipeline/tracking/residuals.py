"""Residuals of tracks: what is expected of them, and what those of successive detections show together.

The residuals of a filter whose assumptions hold are white, as its innovations are (R. K. Mehra, "On the identification
of variances and adaptive Kalman filtering", IEEE Trans. Automatic Control 15 (2), 1970). A detection with the residual
e, noise R and derivatives H of its pixels has the score ``s = H' R^-1 e`` of the position. That is ``H' S^-1`` times
the innovation, of covariance S. Its own covariance is ``A = H' S^-1 H = H' R^-1 (R - H P H') R^-1 H``, with the
covariance P of the position that has taken in the detection. For a successive detection of the same track, with t, B
and P, ``s' P t`` has the mean 0 and the variance ``tr(P A P B)``. If the track errs by what lasts from one to the
other, with a covariance of c P beyond what is stated, the mean is ``c tr(P A P B)``: this tells how far tracks err,
along every axis that cameras see, depth too.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.io.outputs.json_text import finite_or_none
from stereophd.pipeline.tracking.associations import Associated
from stereophd.pipeline.tracking.loop import Record

# A detection that belongs to a track more probably than not has a residual.
PROBABLE = 0.5
# Residuals computed at a time, at least, and over those that wait for a successive one.
BATCH, BATCH_OVER_WAITING = 2048, 3
# Residuals that exceed what is expected by this many times the median excess are those of wrong detections or of tracks
# that are elsewhere. They show nothing about the noise, and a few of them would outweigh all others.
OUTLIER = 8.0
# An estimate that was little more than its detection has next to no residual, which shows neither noise nor outliers:
# one is judged if at least this share of the variance of the noise is expected of it.
LEAST_EXPECTED = 0.1
# Step of the derivatives of a projection, over the standard deviation of the position.
DERIVATIVE_STEP = 0.1


class SeenTrack(NamedTuple):
    """A track and its detection."""

    camera: str
    track_id: int
    time_s: float
    state: Array  # (6,)
    covariance: Array  # (3, 3), of the position
    pixels: Array  # (2,)


def sightings_of(record: Record, estimates: Estimates, associated: Associated) -> Iterator[SeenTrack]:
    """Yield the tracks that have probably made detections of the event of a record, with their estimates then."""
    if not record.is_event or (associated.time_s, associated.camera) != (record.time_s, record.camera):
        return  # earlier claims of a track that is new
    place = {track: row for row, track in enumerate(estimates.track_ids.tolist())}
    ids = associated.track_ids.tolist()
    for row in np.flatnonzero(associated.probabilities > PROBABLE).tolist():
        if (track := place.get(ids[row])) is not None:
            state, covariance = estimates.states[track], estimates.covariances[track, :3, :3]
            yield SeenTrack(associated.camera, ids[row], associated.time_s, state, covariance, associated.pixels[row])


def residuals_px(camera: Camera, times: Array, states: Array, pixels: Array) -> Array:
    """Return detections minus reprojected states (n, 2), in distorted pixels; NaN where a state is out of view.

    Times of the frames are (n,), s; positions and velocities at these times (n, 6); pixels (n, 2) as in the log. A
    rolling shutter reads a row later: the detection shows the object at its position at that later time.
    """
    delays = camera.row_delays(pixels[:, 1])
    return np.asarray(pixels - camera.project_at(states[:, :3] + delays[:, None] * states[:, 3:], times + delays))


def are_usual(squares: Array, expected: Array, noise: float) -> Booleans:
    """Return whether each of these squares of residuals (n,) is that of none of the outliers, px^2.

    Expected are those of `TrackResiduals`; the noise is the variance of a detection, both axes together.
    """
    least = LEAST_EXPECTED * noise
    ratios, telling = squares / np.maximum(expected, least), expected >= least
    return np.asarray(ratios <= (OUTLIER**2 * np.median(ratios[telling]) if telling.any() else np.inf))


class TrackResiduals(NamedTuple):
    """Residuals of sightings of a camera, px."""

    residuals: Array  # (n, 2)
    jacobians: Array  # (n, 2, 3): Derivatives of the pixels, by steps within the covariances of the positions
    # (n,): The squares of residuals, both axes together, that noise and uncertainty lead to expect. An estimate that
    # has taken in a detection of noise R has residuals of the covariance R - H P H^T, with its own covariance P: less
    # than the noise, as the estimate has moved towards the detection.
    expected: Array
    usable: Booleans  # (n,): In view
    usual: Booleans  # (n,): And no outliers


def residuals_of(camera: Camera, sightings: Sequence[SeenTrack]) -> TrackResiduals:
    """Return the residuals of n sightings of a camera."""
    if not sightings:
        nothing = np.empty(0, dtype=np.bool_)
        return TrackResiduals(np.empty((0, 2)), np.empty((0, 2, 3)), np.empty(0), nothing, nothing)
    times, states, covariances, pixels = map(np.array, list(zip(*sightings, strict=True))[2:])
    found, variances = residuals_px(camera, times, states, pixels), np.asarray(camera.detector.sigma) ** 2
    steps = DERIVATIVE_STEP * np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2) / 3.0, 1e-24))
    moved = states[:, None, :3] + np.eye(3) * steps[:, None, None]
    there = camera.project_at(moved.reshape(-1, 3), np.repeat(times, 3)).reshape(-1, 3, 2)
    slopes = (there - camera.project_at(states[:, :3], times)[:, None]) / steps[:, None, None]
    jacobians = np.swapaxes(slopes, 1, 2)
    explained = np.einsum("nij,njk,nik->ni", jacobians, covariances, jacobians)
    expected = np.maximum(variances - explained, 0.0).sum(axis=1)
    usable = np.isfinite(found).all(axis=1) & np.isfinite(expected)
    usual = usable.copy()
    usual[usable] = are_usual((found[usable] ** 2).sum(axis=1), expected[usable], float(variances.sum()))
    return TrackResiduals(found, jacobians, expected, usable, usual)


@dataclass
class PairSums:
    """Sums over pairs of successive detections of tracks."""

    count: int = 0
    products: float = 0.0  # Of s' P t, over tr(P A P B) where that exceeds 1
    squares: float = 0.0  # Of the squares of these
    variances: float = 0.0  # Of tr(P A P B), 1 at most

    def add(self, products: Array, variances: Array) -> None:
        """Take in pairs (n,)."""
        self.count += len(products)
        self.products += float(products.sum())
        self.squares += float((products**2).sum())
        self.variances += float(variances.sum())

    def report(self) -> dict[str, Any]:
        """Return the figures for ``report.json``."""
        return {
            "pairs": self.count,
            "excess": finite_or_none(self.products / self.variances) if self.variances > 0.0 else None,
            "standard_errors": finite_or_none(self.products / self.squares**0.5) if self.squares > 0.0 else None,
        }


@dataclass
class TrackErrors:
    """What successive detections show together of the errors of tracks: of one camera, and of one after another."""

    same_camera: PairSums = field(default_factory=PairSums)
    other_camera: PairSums = field(default_factory=PairSums)
    # In order of time; the first ones are the last that the sums know of each camera and track.
    waiting: list[SeenTrack] = field(default_factory=list)
    known: int = 0

    def add(self, record: Record, cameras: Mapping[str, Camera]) -> None:
        """Take in the detections of a record's event, by estimates of the filter; none of bodies."""
        filtered = record.filtered or record
        for one in filtered.associations if filtered.estimates.extents is None else ():
            self.waiting += sightings_of(record, filtered.estimates, one)
        if len(self.waiting) - self.known >= max(BATCH, BATCH_OVER_WAITING * self.known):
            self._compute(cameras)

    def report(self, cameras: Mapping[str, Camera]) -> dict[str, Any]:
        """Return the figures for ``report.json``."""
        self._compute(cameras)
        return {"same_camera": self.same_camera.report(), "other_camera": self.other_camera.report()}

    def _compute(self, cameras: Mapping[str, Camera]) -> None:
        if not self.waiting:
            return
        names, tracks, *_, covariances, _ = map(np.array, zip(*self.waiting, strict=True))
        scores, spreads = np.full((len(names), 3), np.nan), np.full((len(names), 3, 3), np.nan)
        for name, camera in cameras.items():
            own, variances = np.flatnonzero(names == name), np.asarray(camera.detector.sigma) ** 2
            found = residuals_of(camera, [self.waiting[row] for row in own.tolist()])
            left = np.diag(variances) - found.jacobians @ covariances[own] @ found.jacobians.swapaxes(1, 2)
            kept = np.flatnonzero(found.usual & (left[:, 0, 0] > 0.0))
            kept = kept[np.linalg.det(left[kept]) > 0.0]  # else it is not linear there
            weighted = found.jacobians[kept] / variances[:, None]
            scores[own[kept]] = np.einsum("nij,ni->nj", weighted, found.residuals[kept])
            spreads[own[kept]] = weighted.swapaxes(1, 2) @ left[kept] @ weighted
        known = np.flatnonzero(np.isfinite(scores).all(axis=1))
        for sums, keys in ((self.other_camera, (tracks,)), (self.same_camera, (names, tracks))):
            order = known[np.lexsort([key[known] for key in keys])]
            first, second = order[:-1], order[1:]
            pairs = (tracks[first] == tracks[second]) & ((names[first] == names[second]) == (len(keys) == 2))
            pairs &= second >= self.known
            first, second = first[pairs], second[pairs]
            stated = covariances[second]
            products = np.einsum("ni,nij,nj->n", scores[first], stated, scores[second])
            variances = np.trace(stated @ spreads[first] @ stated @ spreads[second], axis1=1, axis2=2)
            # no few pairs of tracks that are less certain than a detection count for more than all others
            sums.add(products / np.maximum(variances, 1.0), np.minimum(variances, 1.0))
        last = {(names[row], tracks[row]): row for row in range(len(names))}
        is_alive = set(tracks[self.known :].tolist())
        self.waiting = [self.waiting[row] for row in sorted(last.values()) if self.waiting[row].track_id in is_alive]
        self.known = len(self.waiting)
