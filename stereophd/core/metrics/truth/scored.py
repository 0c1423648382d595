"""What is scored: objects that enough cameras have seen lately, on a plane, and within a region."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.region import are_inside
from stereophd.core.metrics.distances.ospa import score_scans
from stereophd.core.metrics.scans import PointSets
from stereophd.core.numerics.times import SAME_TIME_S


@dataclass(frozen=True)
class Sightings:
    """Detections as far as visibility needs them."""

    time_s: Array  # (n,) array: True time of each detection, in any order
    camera: Integers  # (n,) array: Index of its camera
    # (n,) array or None: The true object of each detection; None if the log has no such column: every detection then
    # counts for every object.
    object_id: Integers | None = None


def cameras_that_saw(sightings: Sightings, time_s: Array, object_id: Integers, within_s: float) -> Integers:
    """Count the distinct cameras that detected each object in the closed interval ``[time_s - within_s, time_s]``.

    The times and objects asked about are (n,), and so is the result.
    """
    asked, detected = object_id, sightings.object_id
    if detected is None:
        asked, detected = np.zeros_like(object_id), np.zeros(len(sightings.time_s), dtype=np.int64)
    count = np.zeros(len(time_s), dtype=np.int64)
    order = np.lexsort((sightings.time_s, detected, sightings.camera))
    seen_at, names = sightings.time_s[order], np.stack([sightings.camera, detected], axis=1)[order]
    ends = np.append(np.flatnonzero((names[1:] != names[:-1]).any(axis=1)) + 1, len(names))
    for start, end in pairwise([0, *ends]) if len(names) else ():
        times, rows = seen_at[start:end], np.flatnonzero(asked == names[start, 1])
        latest = np.append(-np.inf, times)[np.searchsorted(times, time_s[rows] + SAME_TIME_S, side="right")]
        count[rows] += time_s[rows] - latest <= within_s + SAME_TIME_S
    return count


def leave_out_unseen(
    estimates: PointSets, truth: PointSets, seen: Booleans, order: float, cutoff: float, *, mahalanobis: bool
) -> tuple[PointSets, PointSets, Booleans]:
    """Leave out the true points that are not `seen` (n,) and the estimates assigned to them.

    An estimate belongs to an unseen object when the optimal assignment of all points (order, cutoff and distance as for
    `score_scans`) pairs them nearer than the cutoff. Returns the remaining estimates and true points of each scan, and
    the scans (k,) that lost points and have none left.
    """
    pairs = score_scans(estimates, truth, order, cutoff, mahalanobis=mahalanobis).pairs
    keep = np.ones(len(estimates.label), dtype=bool)
    keep[pairs.estimate[~seen[pairs.truth]]] = False
    fewer_estimates, fewer_truth = estimates.keep_points(keep), truth.keep_points(seen)
    remaining = fewer_estimates.counts + fewer_truth.counts
    emptied = (remaining == 0) & (truth.counts > 0)
    return fewer_estimates, fewer_truth, emptied


def on_plane(points: PointSets, normal: Array) -> PointSets:
    """Return points moved onto the plane through the origin with a normal (3,), without their covariances."""
    unit = normal / np.linalg.norm(normal)
    across = np.eye(3) - np.outer(unit, unit)
    return replace(points, position=points.position @ across, velocity=points.velocity @ across, covariance=None)


def leave_out_outside(
    estimates: PointSets, truth: PointSets, region: Array, order: float, cutoff: float
) -> tuple[PointSets, PointSets, Booleans]:
    """Leave out what is outside a region: objects with the estimates assigned to them, and estimates of no object.

    An estimate outside stays where the optimal assignment pairs it with an object inside. The region is half-spaces
    (h, 4) (`stereophd.core.geometry.region`); order and cutoff are those of `score_scans`. Returns the remaining
    estimates and true points of each scan, and the scans (k,) that lost points and have none left.
    """
    had = estimates.counts + truth.counts > 0
    estimates, truth, _ = leave_out_unseen(
        estimates, truth, are_inside(truth.position, region), order, cutoff, mahalanobis=False
    )
    kept = are_inside(estimates.position, region)
    kept[score_scans(estimates, truth, order, cutoff).pairs.estimate] = True
    estimates = estimates.keep_points(kept)
    return estimates, truth, had & (estimates.counts + truth.counts == 0)
