"""Cameras moved to where paired tracks meet: pairing and linear fits in turns, with a tolerance that falls.

A fit is a Gauss-Newton step over all unknowns of the paired cameras, with the prior and Cauchy weights, of the epipolar
distances of the chosen pairs (`stereophd.core.two_views.epipolar`), linearised about the present cameras. No unknown is
held: what a lens of its prior does to the rays is more than the last tolerance, and poses that take it up agree between
two cameras, but not between all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.pairing.choice import Pairing, choose_pairs, pair_gains
from stereophd.core.calibration.pairing.track_pairs import TrackPairs
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import MOVES
from stereophd.core.two_views.epipolar import nearest_depths, ray_distances
from stereophd.core.two_views.track_rays import ray_poses

# Tolerances in units of the noise of the distance, step by step.
TOLERANCES = (20.0, 10.0, 5.0, 2.5)
# Step of the numerical derivative, in prior standard deviations.
DERIVATIVE_STEP = 1e-4
# Reweighted steps of a linear fit, and choices of pairs, each with a fit, at every tolerance.
STEPS, CHOICES = 3, 2
# Two starts that come so near each other, in prior standard deviations, end at the same cameras.
MERGED = 0.05


def slopes_of(
    parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers, columns: Integers
) -> tuple[Array, Array]:
    """Distances (r,) of rows at values (m,), and their derivatives (r, c) in prior standard deviations of some values.

    Numerical derivatives; where a value only moves a camera, the rays in its axes are kept.
    """
    std, cameras = parameters.prior_std, parameters.build(values)
    rays, sigma = pairs.rays_of(cameras, rows), pairs.sigma[rows]
    distances = ray_distances(cameras, rays, sigma)
    jacobian = np.zeros((len(rows), len(columns)))
    names = np.array([camera.name for camera in cameras])[rays.cameras]
    for column, k in enumerate(columns.tolist()):
        shifted, parameter = values.copy(), parameters.parameters[k]
        shifted[k] += DERIVATIVE_STEP * std[k]
        affected = np.flatnonzero(np.isin(names, parameter.cameras).any(axis=1))
        moved = parameters.rebuilt(cameras, shifted, k)
        is_same = parameter.quantity.affects == MOVES
        moved_rays = rays.take(affected) if is_same else pairs.rays_of(moved, rows[affected])
        changed = ray_distances(moved, moved_rays, sigma[affected])
        if np.isfinite(changed).any():  # the step of a clock of an endless prior leaves the log
            jacobian[affected, column] = (changed - distances[affected]) / DERIVATIVE_STEP
    return distances, jacobian


@dataclass(frozen=True)
class Linear:
    """Distances of rows of the pairs, linear in the values of the paired cameras about the values of a start."""

    parameters: ParameterSet
    pairs: TrackPairs
    columns: Integers  # (c,) of int: the values of cameras that have pairs
    offsets: Array  # (c,): where it was linearised, in prior standard deviations from the prior mean
    rows: Integers  # (r,) of int
    distances: Array  # (r,): zero where missing
    jacobian: Array  # (r, c): zero where missing
    missing: Booleans  # (r,)

    @staticmethod
    def at(parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers | None = None) -> "Linear":
        """Linearise the distances of some rows, by default all, about values (m,)."""
        rows = np.arange(len(pairs.pair)) if rows is None else rows
        names = {parameters.cameras[number].name for number in np.unique(pairs.cameras).tolist()}
        columns = np.flatnonzero([not names.isdisjoint(parameter.cameras) for parameter in parameters.parameters])
        distances, jacobian = slopes_of(parameters, pairs, values, rows, columns)
        missing = ~(np.isfinite(distances) & np.isfinite(jacobian).all(axis=1))
        distances, jacobian = np.where(missing, 0.0, distances), np.where(missing[:, None], 0.0, jacobian)
        offsets = ((values - parameters.prior_mean) / parameters.prior_std)[columns]
        return Linear(parameters, pairs, columns, offsets, rows, distances, jacobian, missing)

    def take(self, places: Integers) -> "Linear":
        """Return some of the rows."""
        return Linear(
            self.parameters, self.pairs, self.columns, self.offsets, self.rows[places],
            self.distances[places], self.jacobian[places], self.missing[places],
        )  # fmt: skip

    def distances_at(self, offsets: Array) -> Array:
        """Distances (r,) at offsets (c,); NaN where missing."""
        return np.where(self.missing, np.nan, self.distances + self.jacobian @ (offsets - self.offsets))

    def fitted(self, tolerance: float, offsets: Array) -> Array:
        """Offsets at which the rows meet, with the prior and Cauchy weights, from those of a start."""
        jacobian = self.jacobian / tolerance
        for _ in range(STEPS):
            distances = self.distances / tolerance + jacobian @ (offsets - self.offsets)
            weights = 1.0 / (1.0 + distances**2)
            matrix = jacobian.T @ (weights[:, None] * jacobian) + np.eye(len(offsets))
            offsets = offsets - np.linalg.solve(matrix, jacobian.T @ (weights * distances) + offsets)
        return offsets

    def values_of(self, offsets: Array) -> Array:
        """Values (m,) of offsets (c,); cameras without pairs are those of the prior mean."""
        values = self.parameters.prior_mean.copy()
        values[self.columns] += offsets * self.parameters.prior_std[self.columns]
        return values


def gains_at(parameters: ParameterSet, pairs: TrackPairs, values: Array, tolerance: float) -> Array:
    """Gain (p,) of every pair by the cameras of values (m,)."""
    cameras = parameters.build(values)
    rays = pairs.rays if pairs.is_fixed else pairs.rays_of(cameras, np.arange(len(pairs.pair)))
    return pair_gains(pairs, ray_distances(cameras, rays, pairs.sigma), tolerance)


def settled(
    parameters: ParameterSet, pairs: TrackPairs, starts: Sequence[Array], tolerances: Sequence[float]
) -> list[Array]:
    """Pair and fit in turns from each of several values (m,), with a tolerance that falls.

    A start under which nothing pairs ends, and so does one that comes near another.
    """
    for tolerance in tolerances:
        passed: list[Array] = []
        for values in starts:
            fitted = _at_tolerance(parameters, pairs, values, tolerance)
            if fitted is not None and not any(
                float((np.abs(fitted - other) / parameters.prior_std).max()) < MERGED for other in passed
            ):
                passed.append(fitted)
        starts = passed
    return list(starts)


def _at_tolerance(parameters: ParameterSet, pairs: TrackPairs, values: Array, tolerance: float) -> Array | None:
    """Values after choices of pairs and fits at one tolerance; None where nothing pairs."""
    for _ in range(CHOICES):
        chosen, _ = choose_pairs(pairs, gains_at(parameters, pairs, values, tolerance))
        if not len(chosen):
            return None
        linear = Linear.at(parameters, pairs, values, pairs.rows_of(chosen))
        values = linear.values_of(linear.fitted(tolerance, linear.offsets))
    return values


def judged(parameters: ParameterSet, pairs: TrackPairs, values: Array, tolerance: float) -> Pairing:
    """Pair at values (m,), without pairs whose rays meet behind a camera."""
    gains = np.where(behind(parameters, pairs, values), 0.0, gains_at(parameters, pairs, values, tolerance))
    chosen, total = choose_pairs(pairs, gains)
    return Pairing(values, chosen, less_prior(parameters, values, total))


def less_prior(parameters: ParameterSet, values: Array, total: float) -> float:
    """Gain less the squared distance of values (m,) from the prior mean, in its standard deviations."""
    offset = (values - parameters.prior_mean) / parameters.prior_std
    return total - float(offset @ offset)


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
    """Pairs (p,) most of whose rays meet behind a camera. Rays that are nearly parallel may meet anywhere."""
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
