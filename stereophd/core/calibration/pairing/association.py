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
# Pairs of a track and a detection that are compared at once.
MOST_PAIRS = 500_000
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
    names, positions, variances = [np.empty(0, dtype=np.int64)], [np.empty((0, 6))], [np.empty(0)]
    counts = np.zeros(len(scans.times), dtype=np.int64)  # of tracks
    for number, event in enumerate(scans.events):
        if number % REPORTED_EVERY == 0:
            within(f"objects are followed, {percent(number / len(counts))} of the frames")
        state, info, estimates = multi_filter.step(state, inflated(event, inflation))
        total += info.log_likelihood
        sure = estimates.existence >= LEAST_EXISTENCE
        counts[number] = np.count_nonzero(sure)
        names.append(estimates.track_ids[sure])
        positions.append(estimates.states[sure])
        variances.append(np.trace(estimates.covariances[sure, :3, :3], axis1=1, axis2=2))
    states, events = np.concatenate(positions), np.repeat(np.arange(len(counts)), counts)
    batch = np.cumsum(counts * np.diff(scans.first))[events] // MOST_PAIRS
    batches = np.split(np.arange(len(events)), np.flatnonzero(np.diff(batch)) + 1)
    pairs = [matched(multi_filter.rig.cameras, events[some], states[some], scans, inflation) for some in batches]
    rows = np.concatenate([some[row] for some, (row, _) in zip(batches, pairs, strict=True)])
    detections = np.concatenate([seen for _, seen in pairs])
    _, tracks = np.unique(np.concatenate(names)[rows], return_inverse=True)
    order = np.lexsort((detections, tracks))
    rows, detections, tracks = rows[order], detections[order], tracks[order]
    return TrackedDetections(tracks, detections, states[rows, :3], np.concatenate(variances)[rows], total)


def matched(
    cameras: Sequence[Camera], events: Integers, states: Array, scans: Scans, inflation: float
) -> tuple[Integers, Integers]:
    """Assign states (k, 6) after events (k,), in order, to the detections of these; return rows of both.

    One to one, at the least sum of squared Mahalanobis distances within `TRACK_GATE`.
    """
    counts = np.diff(scans.first)[events]
    rows = np.repeat(np.arange(len(events)), counts)
    seen = np.arange(len(rows)) + np.repeat(scans.first[events] - np.cumsum(counts) + counts, counts)
    times, of_camera, errors = scans.times[events[rows]], scans.cameras[events[rows]], -scans.points[seen]
    delays, travels = np.nan_to_num(scans.delays[seen]), np.nan_to_num(scans.travels[seen])
    for number, camera in enumerate(cameras):
        own = np.flatnonzero(of_camera == number)
        errors[own] += detected_pixels(camera, states[rows[own]], times[own], delays[own], travels[own])
    distances = np.einsum("ni,nij,nj->n", errors, scans.precisions[seen], errors) / inflation**2
    near = distances < TRACK_GATE
    rows, seen, distances = rows[near], seen[near], distances[near]
    contested = np.flatnonzero((np.bincount(rows)[rows] > 1) | (np.bincount(seen)[seen] > 1))
    taken = np.ones(len(rows), dtype=np.bool_)
    taken[contested] = False
    for some in np.split(contested, np.flatnonzero(np.diff(events[rows[contested]])) + 1):
        (firsts, row), (seconds, column) = (np.unique(each[some], return_inverse=True) for each in (rows, seen))
        gain = np.zeros((len(firsts), len(seconds)))
        gain[row, column] = TRACK_GATE - distances[some]
        chosen = np.zeros_like(gain, dtype=np.bool_)
        chosen[linear_sum_assignment(gain, maximize=True)] = True
        taken[some] = chosen[row, column]
    return rows[taken], seen[taken]


def detected_pixels(camera: Camera, states: Array, times: Array, delays: Array, travels: Array) -> Array:
    """Undistorted pixels (n, 2) of objects, positions and velocities (n, 6), as detections after events (n,) show them.

    With a rolling shutter a detection is later than its event by the delay (n,) of its row. The pixels are those of the
    camera at the event; that it travels (n, 3) until then is as if the objects moved the other way.
    """
    moved = states[:, :3] + delays[:, None] * states[:, 3:] - travels
    return replace(camera, lens=Lens()).project_at(moved, times)


def shared(trajectories: Integers, cameras: Integers, least: int) -> Booleans:
    """Whether each detection (n,) is of a trajectory that has at least so many in each of two cameras."""
    counts = np.zeros((int(trajectories.max(initial=0)) + 1, int(cameras.max(initial=0)) + 1), dtype=np.int64)
    np.add.at(counts, (trajectories, cameras), 1)
    return np.asarray((counts >= least).sum(axis=1)[trajectories] >= 2)
