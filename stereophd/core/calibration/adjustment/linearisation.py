"""Normal equations of a bundle adjustment (`calibration.adjustment.solver`) at given cameras and knots."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import LinAlgError, cholesky_banded

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.adjustment import normal_equations
from stereophd.core.calibration.adjustment.problem import Problem, true_times
from stereophd.core.calibration.adjustment.trajectories import (
    OF_ALL,
    STATED,
    Interpolation,
    MotionNoise,
    MotionPrior,
    interpolation,
    positions,
    slopes,
)
from stereophd.core.calibration.unknowns.parameters import taken
from stereophd.core.calibration.unknowns.quantities.base import TIMES, CameraView, Projection, Quantity
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import Sights
from stereophd.core.calibration.unknowns.scale import log_scale, predicted

# Relative weight on the diagonal that keeps the factorisation of nearly singular knots from failing.
ROUNDING = 1e-13
# Knots of less information are held: far from all their detections, the weights of a robust loss underflow.
LEAST_INFORMATION = 1e-200


def factor_knots(bands: Array, damping: float = 0.0) -> Array:
    """Cholesky factor of the matrix of the knots, both lower banded (12, 6 k), its diagonal damped.

    Unknowns without any weight are held. Raises LinAlgError when the damped matrix is not positive definite.
    """
    bands = bands.copy()
    bands[0] = np.where(np.abs(bands[0]) > LEAST_INFORMATION, bands[0] * (1.0 + damping + ROUNDING), 1.0)
    return np.asarray(cholesky_banded(bands, overwrite_ab=True, lower=True, check_finite=False))


def _noise_equations(noise: MotionNoise, pulls: Array, products: Array) -> tuple[Array, Array, Array]:
    """Return coupling (6 k, 6), matrix (6, 6), vector (6,) of a noise without its prior, from `MotionPrior.pulls`."""
    coupling = np.einsum("na,jba,bc->ncj", pulls, noise.slopes, noise.whitening, optimize=True)
    matrix = np.einsum("iab,bc,jac->ij", noise.slopes, products, noise.slopes)
    return coupling.reshape(-1, len(STATED)), matrix, -noise.by_unknowns(products)


@dataclass(frozen=True)
class NormalEquations:
    """Linearisation of a problem; see the head of `stereophd.core.calibration.adjustment.solver`."""

    cost: float
    bands: Array
    coupling: Array
    matrix: Array
    state_vector: Array
    value_vector: Array
    distances: Array


class Placement(NamedTuple):
    """What values determine whatever the knots are: cameras, times, and the interpolation of what is seen at them."""

    sights: Sights  # Cameras and poses
    times: Array
    path: Interpolation  # Positions
    rates: Interpolation  # Velocities


@dataclass(frozen=True)
class Seen:
    """What cameras see of the points of detections."""

    placement: Placement
    projection: Projection
    velocities: Array  # (n, 3): Those of the points; zeros where derivatives by values are not asked for
    errors: Array  # (n, 2): Residuals
    by_value: Array  # (n, 2, q): By the unknown values of the camera; q = 0 where they are not asked for

    @property
    def visible(self) -> Booleans:
        """Which points (n,) lie before their cameras."""
        return self.projection.ahead

    @property
    def by_point(self) -> Array:
        """Derivatives (n, 2, 3) of the pixels by the points."""
        return self.projection.by_world

    @cached_property
    def bends(self) -> Array:
        """Second derivatives (n, 2, 3, 3) of the pixels by the points."""
        return self.placement.sights.bends(self.projection.points, self.visible)


@dataclass(frozen=True)
class Linearisation:
    """What of a problem does not change from step to step."""

    problem: Problem
    members: tuple[Integers, ...]  # Observations of each camera
    # `path`, `rates`: Interpolation of positions and velocities at the times of the prior mean.
    path: Interpolation
    rates: Interpolation
    motion: MotionPrior
    columns: Integers  # (c, q): Places of the unknown values of each camera, filled up with -1

    @classmethod
    def of(cls, problem: Problem) -> Self:
        """Prepare a problem."""
        observations, parameters = problem.observations, problem.parameters
        path = interpolation(problem.knots, observations.trajectories, observations.times)
        rates = slopes(problem.knots, observations.trajectories, observations.times)
        members = tuple(np.flatnonzero(observations.cameras == k) for k in range(len(parameters.cameras)))
        places = [
            np.concatenate([np.empty(0, np.int64), *(index[index >= 0] for _, index in parameters.unknown(c.name))])
            for c in parameters.cameras
        ]
        columns = np.full((len(places), max(len(index) for index in places)), -1, dtype=np.int64)
        for row, index in zip(columns, places, strict=True):
            row[: len(index)] = index
        return cls(problem, members, path, rates, MotionPrior.of(problem.knots), columns)

    def at(self, values: Array, states: Array, noise: Array | None = None, seen: Seen | None = None) -> NormalEquations:
        """Return the normal equations at values (m,), knots (k, 2, 3) and the stated noise of the motion.

        At another noise of the motion (6,) its unknowns follow the values; they have no prior here. `seen` is that of
        `residuals`, if it is known.
        """
        problem, parameters = self.problem, self.problem.parameters
        sums = self.summed(seen or self.residuals(values, states))
        coupling, matrix, value_vector = sums.coupling, sums.matrix, sums.value_vector
        # motion model, its noise in units of the scene's scale
        motion = self.noise_at(values, STATED if noise is None else noise)
        energy, pulls, products = self._add_motion(sums, states, motion)
        noise_coupling, noise_matrix, noise_vector = _noise_equations(motion, pulls, products)
        # a larger scale is a larger noise along every axis
        _, gradient = log_scale(parameters, problem.reference, values)
        scales = np.flatnonzero(gradient)
        coupling[:, scales] += np.outer(noise_coupling[:, 0], gradient[scales])
        matrix += noise_matrix[0, 0] * np.outer(gradient, gradient)
        value_vector += noise_vector[0] * gradient
        # priors
        scaled = (values - parameters.prior_mean) / parameters.prior_std
        matrix += np.diag(parameters.prior_std**-2)
        value_vector -= scaled / parameters.prior_std
        cost = sums.cost + energy + float(scaled @ scaled)
        if problem.scale is not None:
            expected, slope = predicted(parameters, problem.reference, problem.scale, values)
            residual = (problem.scale.value - expected) / problem.scale.std
            matrix += np.outer(slope, slope) / problem.scale.std**2
            value_vector += slope * residual / problem.scale.std
            cost += residual**2
        if problem.held is not None:
            held = problem.held
            coupling[:, held], value_vector[held], gradient[held] = 0.0, 0.0, 0.0
            matrix[held], matrix[:, held] = 0.0, 0.0
            matrix[held, held] = parameters.prior_std[held] ** -2
        if noise is None:
            return replace(sums, cost=cost)
        with_scale = np.outer(gradient, noise_matrix[0])
        return replace(
            sums, cost=cost, coupling=np.hstack([coupling, noise_coupling]),
            matrix=np.block([[matrix, with_scale], [with_scale.T, noise_matrix]]),
            value_vector=np.append(value_vector, noise_vector),
        )  # fmt: skip

    def summed(self, seen: Seen) -> NormalEquations:
        """Contributions of all detections; those by values are zero where the derivatives by values are empty."""
        observations, size, path = self.problem.observations, self.problem.knots.size, seen.placement.path
        count, loss = self.problem.parameters.size, self.problem.loss
        counted = np.ones(len(observations)) if observations.weights is None else observations.weights
        bands, coupling, matrix = np.zeros((12, size)), np.zeros((size, count)), np.zeros((count, count))
        state_vector, value_vector, distances = np.zeros(size), np.zeros(count), np.zeros(len(observations))
        cost = normal_equations.accumulate(
            observations.cameras, seen.errors, seen.visible, observations.precisions, counted, seen.by_point,
            seen.by_value, path.knot, path.weights, self.columns[:, : seen.by_value.shape[2]], loss.kind, loss.scale,
            bands, coupling, matrix, state_vector, value_vector, distances,
        )  # fmt: skip
        return NormalEquations(cost, bands, coupling, matrix, state_vector, value_vector, distances)

    def _add_motion(self, sums: NormalEquations, states: Array, noise: MotionNoise) -> tuple[float, Array, Array]:
        """Add the motion model to the sums of the knots; return its part of the cost, and `MotionPrior.pulls`."""
        precision, (pulls, products) = noise.precision, self.motion.pulls(states)
        self.motion.with_axes(precision, sums.bands)
        sums.state_vector[:] -= (pulls @ precision).ravel()
        return float((precision * products).sum()), pulls, products

    def noise_at(self, values: Array, noise: Array = STATED) -> MotionNoise:
        """Return the noise of the motion of values (m,) and unknowns (6,): that of the knots is stated."""
        logarithm, _ = log_scale(self.problem.parameters, self.problem.reference, values)
        return MotionNoise.of(noise + logarithm * OF_ALL, self.problem.knots.noise_std)

    def of_knots(
        self, values: Array, states: Array, noise: Array = STATED, placement: Placement | None = None
    ) -> tuple[float, Array, Array, Seen]:
        """Cost of detections and motion, matrix (12, size) and vector (size,) of the knots, as `at` has them, sooner.

        What is seen, without derivatives by values, is returned as well. A placement of the values without velocities
        (`placed`) saves what several knots at the same values share.
        """
        placement = placement or self.placed(values, by_values=False)
        seen = self.residuals(values, states, placement, by_values=False)
        sums = self.summed(seen)
        energy, _, _ = self._add_motion(sums, states, self.noise_at(values, noise))
        return sums.cost + energy, sums.bands, sums.state_vector, seen

    def placed(self, values: Array, by_values: bool = True) -> Placement:
        """Return what the values determine; without `by_values` the velocities are those of the prior mean.

        Raises LinAlgError where no camera has the values.
        """
        observations, parameters = self.problem.observations, self.problem.parameters
        try:
            cameras = parameters.build(values)
        except ValueError as error:
            raise LinAlgError(str(error)) from error
        times, path, rates = observations.times, self.path, self.rates
        if any(quantity.affects == TIMES for quantity in parameters.quantities):
            times = true_times(cameras, observations)
            path = interpolation(self.problem.knots, observations.trajectories, times)
            if by_values:
                rates = slopes(self.problem.knots, observations.trajectories, times)
        return Placement(Sights.of(cameras, observations.cameras, times), times, path, rates)

    def residuals(
        self, values: Array, states: Array, placement: Placement | None = None, by_values: bool = True
    ) -> Seen:
        """What is seen of the points at the times of the values."""
        placement = placement or self.placed(values)
        world = positions(states, *placement.path)
        projection = placement.sights.project(world)
        errors, by_value = self.problem.observations.points - projection.pixels, np.zeros((len(world), 2, 0))
        seen = Seen(placement, projection, np.zeros_like(world), errors, by_value)
        return self.with_values(seen, values, states) if by_values else seen

    def with_values(self, seen: Seen, values: Array, states: Array) -> Seen:
        """Return what is seen with its derivatives by the values, where some are not held."""
        if self.problem.held is not None and self.problem.held.all():
            return seen
        seen = replace(seen, velocities=positions(states, *seen.placement.rates))
        by_value = np.zeros((len(seen.errors), 2, self.columns.shape[1]))
        for here, view, unknown in self._views(seen, values):
            parts = [quantity.derivative(view, own)[:, :, used] for quantity, own, used in unknown]
            by_value[here, :, : sum(part.shape[2] for part in parts)] = np.concatenate(parts, axis=2)
        return replace(seen, by_value=by_value)

    def pulled(self, seen: Seen, values: Array, pixels: Array, lines: Array, later: Array) -> Array:
        """Derivatives (n, q), by the values of the camera of each detection, of what detections pull at.

        They pull at their pixels with weights (n, 2), with weights (n, 2, 3) at the derivatives of these by the points,
        and with weights (n,) at the times.
        """
        pull = seen.placement.sights.pull(seen.projection, pixels, lines, later, seen.bends)
        out = np.zeros((len(pixels), self.columns.shape[1]))
        for here, view, unknown in self._views(seen, values):
            of_camera = pull.take(here)
            parts = [quantity.pulled(view, of_camera, own)[:, used] for quantity, own, used in unknown]
            out[here, : sum(part.shape[1] for part in parts)] = np.concatenate(parts, axis=1)
        return out

    def _views(
        self, seen: Seen, values: Array
    ) -> Iterator[tuple[Integers, CameraView, list[tuple[Quantity, Array, Booleans]]]]:
        """Detections of each camera that has unknown quantities, its view, and these: their values, and which count."""
        observations, sights = self.problem.observations, seen.placement.sights
        at = seen.placement.times, observations.log_times, observations.rows
        for number, here in enumerate(self.members):
            if unknown := self.problem.parameters.unknown(sights.cameras[number].name):
                view = sights.view(number, here, seen.projection, seen.velocities, *at)
                yield here, view, [(quantity, taken(values, index), index >= 0) for quantity, index in unknown]

    def factor_of_knots(self, seen: Seen, bands: Array) -> Array:
        """Cholesky factor (12, size) of the second derivatives of the cost by the knots, where there is no loss.

        To their matrix in the normal equations, `bands`, those of the pixels are added: what one camera alone sees
        lies in valleys that the normal equations do not tell. Those are taken where the sum is not positive definite.
        """
        curved, path = bands.copy(), seen.placement.path
        normal_equations.add_points(path.knot, path.weights, -self.pulls(seen), seen.bends, curved)
        with suppress(LinAlgError):
            return factor_knots(curved)
        return factor_knots(bands)

    @cached_property
    def precisions(self) -> Array:
        """Precisions (n, 2, 2) of the detections, times what each counts."""
        precisions, weights = self.problem.observations.precisions, self.problem.observations.weights
        return precisions if weights is None else weights[:, None, None] * precisions

    def pulls(self, seen: Seen, errors: Array | None = None) -> Array:
        """Return how errors (n, 2), those of detections by default, pull at pixels by the weights of the detections."""
        errors = seen.errors if errors is None else errors
        return np.where(seen.visible[:, None], np.einsum("nij,nj->ni", self.precisions, errors), 0.0)

    def of_values(self, by_value: Array) -> Array:
        """Sums (m,) over detections of their contributions (n, q) to the values of their cameras; q may be 0."""
        out = np.zeros(self.problem.parameters.size)
        for columns, here in zip(self.columns[:, : by_value.shape[1]], self.members, strict=True):
            used = columns >= 0
            out[columns[used]] += by_value[here][:, used].sum(axis=0)
        return out

    def of_states(self, path: Interpolation, by_point: Array) -> Array:
        """Sums (6 k,) over the knots of the contributions (n, 3) of detections to their points."""
        size = self.problem.knots.size
        out = np.zeros(size + 6)  # the last knot of all has none after it
        for b in range(4):
            for axis in range(3):
                np.add.at(out, 6 * path.knot + 3 * b + axis, path.weights[:, b] * by_point[:, axis])
        return out[:size]
