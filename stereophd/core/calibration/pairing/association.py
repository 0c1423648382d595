"""Which detections belong to which object: from the tracks of a filter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.adjustment.recording import Scans
from stereophd.core.calibration.time_limit import within
from stereophd.core.disparity.events import Event, make_rig
from stereophd.core.disparity.prior import DEPTH_RANGE_SIGMAS
from stereophd.core.disparity.trips import disparity_scale
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.multi.pmb.filter import PmbFilter
from stereophd.wording import percent

# A detection belongs to a track within this squared Mahalanobis distance in its (inflated) noise.
TRACK_GATE = 9.0
# Frames after which progress is reported.
REPORTED_EVERY = 50
# Tracks of a smaller existence are not asked.
LEAST_EXISTENCE = 0.6


@dataclass(frozen=True)
class TrackedDetections:
    """Detections of the objects that a filter followed, sorted by track and time."""

    tracks: Integers  # (n,) of int: 0 to the number of tracks less one
    detections: Integers  # (n,) of int: Index among all detections
    positions: Array  # (n, 3): Estimates of the filter, world
    variances: Array  # (n,): Trace of their covariance
    log_likelihood: float  # Evidence of the run: sum over all events

    def __len__(self) -> int:
        return len(self.tracks)


def with_cameras(template: PmbFilter, cameras: Sequence[Camera]) -> PmbFilter:
    """Return the filter with other cameras."""
    rig = template.rig
    return replace(template, rig=make_rig(cameras, rig.baseline, rig.rectification, rig.region))


def with_depths(template: PmbFilter, camera: int) -> PmbFilter:
    """Return the filter with objects at the depths at which they appear before a camera, unless it has a region."""
    if template.rig.region is not None:
        return template
    space = template.rig.packed[camera]
    mean, std = template.settings.birth.disparity_moments(space)
    nearest, farthest = mean + DEPTH_RANGE_SIGMAS * std, mean - DEPTH_RANGE_SIGMAS * std
    scale = disparity_scale(space)
    region = np.array([scale / nearest, scale / farthest if farthest > 0.0 else np.inf])
    return replace(template, rig=replace(template.rig, region=region))


def inflated(event: Event, factor: float) -> Event:
    """Return an event whose detections are this many times as noisy."""
    return event if factor == 1.0 else replace(event, covariances=factor**2 * event.covariances)


def track_detections(multi_filter: PmbFilter, scans: Scans, inflation: float) -> TrackedDetections:
    """Run a filter with the cameras to be tried over events, and give each track the detections nearest to it.

    The scans have the detector's noise, and `inflation` is a factor on it.
    """
    state = multi_filter.init()
    total = 0.0
    found: list[tuple[Integers, Integers, Array, Array]] = []
    for number, event in enumerate(scans.events):
        if number % REPORTED_EVERY == 0:
            within(f"objects are followed, {percent(number / len(scans.events))} of the frames")
        wide = inflated(event, inflation)
        state, info, estimates = multi_filter.step(state, wide)
        total += info.log_likelihood
        sure = np.flatnonzero(estimates.existence >= LEAST_EXISTENCE)
        if not len(sure) or not len(event.points):
            continue
        camera, states = multi_filter.rig.cameras[event.camera].at(event.time_s), estimates.states[sure]
        rows, columns = match(detected_pixels(camera, states, wide), wide, TRACK_GATE)
        points = states[:, :3]
        variances = np.trace(estimates.covariances[sure[rows], :3, :3], axis1=1, axis2=2)
        found.append((estimates.track_ids[sure[rows]], scans.first[number] + columns, points[rows], variances))
    if not found:
        none = np.empty(0, dtype=np.int64)
        return TrackedDetections(none, none, np.empty((0, 3)), np.empty(0), total)
    names, detections, estimated, variances = (np.concatenate(part) for part in zip(*found, strict=True))
    _, tracks = np.unique(names, return_inverse=True)
    order = np.lexsort((detections, tracks))
    return TrackedDetections(tracks[order], detections[order], estimated[order], variances[order], total)


def detected_pixels(camera: Camera, states: Array, event: Event) -> Array:
    """Undistorted pixels (n, m or 1, 2) of objects, positions and velocities (n, 6), at the times of m detections.

    With a rolling shutter a detection is later than its event by the delay of its row. The pixels are those of the
    camera at the event; that the camera moves on until then is as if the objects moved the other way.
    """
    pinhole = replace(camera, lens=Lens())
    if event.delays is None:
        return np.asarray(pinhole.project(states[:, :3])[:, None, :])
    moved = states[:, None, :3] + event.delays[None, :, None] * states[:, None, 3:]
    if event.travels is not None:
        moved = moved - event.travels
    return pinhole.project(moved.reshape(-1, 3)).reshape(len(states), len(event.points), 2)


def match(pixels: Array, event: Event, gate: float) -> tuple[Integers, Integers]:
    """Assign pixels (n, m or 1, 2) to an event's m detections one to one, at the least sum of squared distances.

    They are Mahalanobis distances, within the gate; NaN is beyond it.
    """
    difference = pixels - event.points
    cost = np.fmin(np.einsum("nmi,mij,nmj->nm", difference, np.linalg.inv(event.covariances), difference), gate)
    rows, columns = linear_sum_assignment(cost)
    kept = cost[rows, columns] < gate
    return rows[kept].astype(np.int64), columns[kept].astype(np.int64)


def shared(trajectories: Integers, cameras: Integers, least: int) -> Booleans:
    """Whether each detection (n,) is of a trajectory that has at least so many in each of two cameras."""
    counts = np.zeros((int(trajectories.max(initial=0)) + 1, int(cameras.max(initial=0)) + 1), dtype=np.int64)
    np.add.at(counts, (trajectories, cameras), 1)
    return np.asarray((counts >= least).sum(axis=1)[trajectories] >= 2)
