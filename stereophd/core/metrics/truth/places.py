"""Where objects are scored: on a plane, and within a region."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry.region import are_inside
from stereophd.core.metrics.matching.near_pairs import near_pairs
from stereophd.core.metrics.scans import PointSets
from stereophd.core.metrics.truth.visibility import leave_out_unseen


def on_plane(points: PointSets, normal: Array) -> PointSets:
    """Return points moved onto the plane through the origin with a normal (3,), without their covariances."""
    unit = normal / np.linalg.norm(normal)
    across = np.eye(3) - np.outer(unit, unit)
    return replace(points, position=points.position @ across, velocity=points.velocity @ across, covariance=None)


def leave_out_outside(
    estimates: PointSets, truth: PointSets, region: Array, order: float, cutoff: float
) -> tuple[PointSets, PointSets, Booleans]:
    """Leave out what is outside a region: objects with the estimates assigned to them, and estimates near no other.

    An estimate outside that is nearer than the cutoff to an object inside stays: it may be the estimate of that object.
    The region is half-spaces (h, 4) (`stereophd.core.geometry.region`); order and cutoff are those of `score_scans`.
    Returns the remaining estimates and true points of each scan, and the scans (k,) that lost points and have none
    left.
    """
    had = estimates.counts + truth.counts > 0
    estimates, truth, _ = leave_out_unseen(
        estimates, truth, are_inside(truth.position, region), order, cutoff, mahalanobis=False
    )
    kept = are_inside(estimates.position, region)
    kept[near_pairs(estimates, truth, cutoff).estimate] = True
    estimates = estimates.keep_points(kept)
    return estimates, truth, had & (estimates.counts + truth.counts == 0)
