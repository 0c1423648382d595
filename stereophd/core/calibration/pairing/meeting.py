"""Where the rays of paired tracks meet, and pairs whose rays meet behind a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.pairing.choice import Pairing
from stereophd.core.calibration.pairing.track_pairs import TrackPairs
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.two_views.meeting import nearest_depths
from stereophd.core.two_views.track_rays import ray_poses

# Sine of the angle between rays below which they are nearly parallel.
PARALLEL = 0.01


@dataclass(frozen=True)
class _Meeting:
    """Where the two rays of rows come nearest."""

    rays: Array  # (r, 2, 3), world
    centers: Array  # (r, 2, 3)
    depths: Array  # (r, 2)
    sines: Array  # (r,) of the angle between the rays
    times: Array  # (r,), s
    seen: Booleans  # (r,)


def _meeting(parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers) -> _Meeting:
    cameras = parameters.build(values)
    rays = pairs.rays_of(cameras, rows)
    turns, centers = ray_poses(cameras, rays)
    directions = np.einsum("nkij,nki->nkj", turns, rays.rays)
    depth_a, depth_b, sines = nearest_depths(directions[:, 0], directions[:, 1], centers[:, 1] - centers[:, 0])
    return _Meeting(directions, centers, np.stack([depth_a, depth_b], axis=1), sines, rays.times, rays.seen)


def behind(parameters: ParameterSet, pairs: TrackPairs, values: Array) -> Booleans:
    """Pairs (p,) of which most rays meet behind a camera. Rays that are nearly parallel may meet anywhere."""
    met = _meeting(parameters, pairs, values, np.arange(len(pairs.pair)))
    wrong = met.seen & (met.depths.min(axis=1) < 0.0) & (met.sines > PARALLEL)
    count = np.bincount(pairs.pair, weights=met.seen, minlength=len(pairs.cameras))
    return np.asarray(2.0 * np.bincount(pairs.pair, weights=wrong, minlength=len(pairs.cameras)) > count)


def meeting_points(parameters: ParameterSet, pairs: TrackPairs, pairing: Pairing) -> tuple[Integers, Array, Array]:
    """Rows of the chosen pairs, their times (r,) and the points (r, 3) where their rays come nearest.

    Depths are kept positive: rays that meet behind a camera are taken where they are far apart from it instead.
    """
    rows = pairs.rows_of(pairing.chosen)
    met = _meeting(parameters, pairs, pairing.values, rows)
    distance = np.linalg.norm(met.centers[:, 1] - met.centers[:, 0], axis=1)[:, None]
    depths = np.clip(met.depths, 0.5 * distance, 100.0 * distance)
    points = met.centers + depths[:, :, None] * met.rays
    return rows[met.seen], met.times[met.seen], np.asarray(points.mean(axis=1))[met.seen]
