"""The marginal posterior of the cameras: trajectories integrated out, the noise of their motion unknown.

The adjustment finds the joint maximum J(v) = min_x cost(v, x) of values v and knots x. Where objects manoeuvre, their
trajectories add many values that the detections constrain only weakly, and the joint maximum is biased in quantities
that stretch the scene: rotations about the vertical, focal lengths. Integrating out the knots (Laplace's method) adds
the terms of the volume,

    -2 log p(v, n | detections) = J(v, n) + log det A(v, n) + 12 l (log s(v) + u) + N log det(P V) + |n / std|^2,

but for a constant, with the matrix A of the knots in the normal equations, the number l of links between successive
knots, the scale s of the scene (`calibration.unknowns.scale`), the number N of trajectories, and the covariances P of
the positions of all knots about their mean and V of their velocities about zero.

**Noise of the motion.** It is stated in lengths, and the cost uses it in units of the scene: noise_std * s(v), s = 1 at
the size that the prior expects. A scene that is truly larger by a factor f has objects that accelerate 1 / f times as
much in those units, and the data do not show f. The noise in units of the scene is therefore known no better than the
size of the scene is. It has six unknowns n (`trajectories.MotionNoise`): the logarithm u of the noise over
noise_std * s(v), how unlike it is along the axes, and how these go together. Were it one number, objects would be known
to accelerate in depth as they do across. Where they do not, the scene would be stretched and bent until they did, and
rotations, focal lengths and principal points with it: 8 standard deviations for two cameras before one object.

**Normalisation.** The motion model is a density of the l differences between successive knots, 6 numbers each, of
standard deviations proportional to s e^u: its normalisation is 12 l (log s + u). The first position and velocity of
each trajectory have a density as wide as those of all: N log det(P V). Scaling cameras and knots together then changes
nothing, so that the data stay flat along the scale, and a scene that is stretched in depth gains nothing by its larger
volume. In units of the scene each trajectory would stretch it; in units of its noise each would pull the noise of the
motion, where that hardly shows, to nothing.

**Detections.** Which ones count is fixed while the cameras move: each has the weight that its robust loss gives it
where the search begins, in the cost and in the volume. With the loss itself, a step that leaves detections out makes
the volume smaller, which is no evidence, and the objective is not smooth. The weights at the optimum found replace
them, and the optimum is looked for again from there, until they hardly change or the search takes no step.

**Derivatives.** The residuals of the motion are proportional to e^-u / s, so that the logarithm of s enters the normal
equations as u does (`Linearisation.at`). At knots that minimise the cost the gradient of J / 2 is minus the vector of
the normal equations. That of the volume is exact (`adjustment.volume`): how the knots follow is found with the second
derivatives of the cost, as what one camera alone sees lies in a valley so flat and curved that the normal equations do
not tell it.

**Minimum.** Newton steps by the exact gradient, on the curvature of the normal equations. That lacks the curvature of
the volume, and of the noise half: a mode of the motion of unit variance that is seen with the information b is
estimated with w = b / (1 + b) of its variance, so that the normal equations find w^2 for u in the mean, while the
information of z ~ N(0, 1 + b) about u is 2 w^2. What they find for u beside the knots is therefore counted twice.
Valleys are curved: cameras that turn together leave them with the fourth power of the step. The longest step is
therefore what the valley allowed last, and grows again where it allows more. Within a few standard deviations of the
optimum the curvature is that of the optimum, and steps there correct it by how they have changed the gradient (BFGS; J.
Nocedal, "Updating quasi-Newton matrices with limited storage", 1980). Alone it is up to twice too small for cameras,
where steps then go too far by as much as they began, and up to seventeen times too large for the noise of the motion.
Farther away such differences are from other bends of the valley, and took four times as many steps.

**Covariance.** The normal equations lack second derivatives of the residuals, too. Where objects turn within the time
in which they move by some noises of their detections, other velocities compensate for a later clock: by residuals
times the change of the knots' weights with time. The normal equations believe the velocities that the noise has bent,
and state clocks up to four times too sure. `curvature_covariance` differentiates the gradient of the objective instead.
Beside the optimum the knots take one step by the second derivatives of the cost there, and the gradient removes what is
left of their pull to first order. It is then wrong by the square of an error of second order, so that steps may be so
small that a difference to one side does, and no valley is left. The bends of the posterior need longer steps, along
which the knots are minimised.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, solve_triangular

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.linearisation import Linearisation, NormalEquations, Seen, factor_knots
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import (
    KNOT_STEPS,
    KNOTS_SETTLED,
    LEAST_SHARE,
    LONGER,
    Adjustment,
    Eliminated,
    settled_knots,
    within_prior,
)
from stereophd.core.calibration.adjustment.trajectories import OF_ALL, STATED, positions
from stereophd.core.calibration.adjustment.volume import VolumeSlopes
from stereophd.core.calibration.time_limit import within
from stereophd.core.calibration.unknowns.scale import log_scale
from stereophd.core.numerics.random_streams import BENDS_SEED
from stereophd.core.numerics.threads import in_threads

# Prior standard deviations of the logarithm of the noise of the motion over what is stated, beside that of the scale,
# and of what tells its axes apart.
NOISE_STD, UNLIKE_STD = 0.5, 0.25
# Part of the variance of a scene that it has in every direction, even if all objects are in a plane or on a line.
LEAST_SPREAD = 0.01
# Length at which the steps settle, longest step, and longest step left of a search that has converged, all in posterior
# standard deviations; most steps.
SETTLED, LONGEST_STEP, LONGEST_LEFT, MOST_STEPS = 0.05, 20.0, 1.0, 200
# A search has settled as well where so many steps lower the objective by less than this together: no detection tells
# their points apart. It follows curved valleys of scenes that hold little, step by small step.
STALLED_STEPS, STALLED = 6, 0.5
# Steps that begin within this of the optimum, in posterior standard deviations, show the curvature there.
NEAR = 3.0
# Step at which a search for the noise of the motion alone has settled, in posterior standard deviations.
MOTION_SETTLED = 0.5
# A step is halved until the objective falls by this part of what the gradient says.
DECREASE = 1e-4
# Squared distance from which a detection is left out by the loss.
LEFT_OUT = 50.0
# Most times that weights of detections are taken anew. Changed at random they may move the optimum by this part of a
# step at which a search settles. Fall of the cost that knots leave in a search: its gradient misses its second order.
MOST_WEIGHTINGS, SAME_WEIGHT, KNOTS_IN_SEARCH = 4, 0.3, 1e-4
# Steps of differences of the gradient, in standard deviations: for its first derivatives, and for second ones.
DIFFERENCE, BEND_DIFFERENCE = 1e-3, 0.03
# Directions of the posterior beyond this part of the prior are loose. Draws of several, beside which the bend of the
# others is looked at; the first ones are enough where what they add to each variance is slight.
LOOSE, BENDS, FIRST_BENDS, SLIGHT = 0.1, 12, 4, 0.02


def marginal_optimum(problem: Problem, begun: Adjustment, settled: float = SETTLED) -> Adjustment:
    """Move an adjustment of the problem to the maximum of the marginal posterior of the values.

    The search begins at its noise of the motion, and ends at a step of at most `settled` posterior standard deviations;
    not `converged` where it ended by more than `LONGEST_LEFT` of these too early. Raises LinAlgError where the normal
    equations are singular.
    """
    size = problem.parameters.size
    states, weights = begun.states, problem.weights(begun.distances)
    unknowns = np.append(begun.values, begun.motion_noise[: len(STATED) if len(problem.knots.links()) else 0])
    secants = list[tuple[Array, Array]]()
    for number in range(MOST_WEIGHTINGS):
        posterior = MarginalPosterior(Linearisation.of(problem.weighted(weights)))
        begins = posterior.at(unknowns, states)
        at, step, left = _minimised(posterior, begins, settled, secants)
        unknowns, states = at.unknowns + step, at.states + at.eliminated.followed(step).reshape(at.states.shape)
        before, weights = weights, problem.weights(at.equations.distances)
        moved = np.sqrt(len(unknowns) * np.mean((weights - before) ** 2 * at.equations.distances))
        if (number and at is begins) or moved <= SAME_WEIGHT * settled:
            break
    covariance = posterior.covariance(at)[:size, :size]
    values, noise = posterior.parted(unknowns)
    cost, distances = at.equations.cost, at.equations.distances
    return Adjustment(values, states, covariance, cost, distances, left <= LONGEST_LEFT, noise)


def curvature_covariance(problem: Problem, adjustment: Adjustment, threads: int = 1) -> Array:
    """Covariance (m, m) of the values by the second derivatives of the objective at its minimum.

    They are differences of the gradient along each column of a root of the covariance by the normal equations. Raises
    LinAlgError where an end of such a difference has no normal equations that are positive definite.
    """
    posterior, at = at_answer(problem, adjustment)
    root, size, gradient = posterior.root(at), len(adjustment.values), posterior.gradient(at)
    curved = posterior.linearisation.factor_of_knots(at.seen, at.equations.bands)
    started = count(1)

    def column(step: Array) -> Array:
        within(f"column {next(started)} of {len(root)}")
        beside = posterior.beside(at, DIFFERENCE * step, curved)
        return np.asarray(root.T @ (posterior.gradient(beside) - gradient) / DIFFERENCE)

    columns: Array = np.column_stack(in_threads(column, root.T, threads))
    inverse = solve_triangular(root, np.eye(len(root)), lower=True)
    precision = inverse.T @ (columns + columns.T) @ inverse / 2.0
    covariance = within_prior(precision, posterior.prior_std)
    # beside draws of the loose directions the others move by their covariance times what is of second order
    std = posterior.prior_std
    variances, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    directions, is_loose = std[:, None] * vectors * np.sqrt(np.maximum(variances, 0.0)), variances > LOOSE**2
    loose, known = directions[:, is_loose], directions[:, ~is_loose]

    def bend(draw: Array) -> Array:
        step = BEND_DIFFERENCE * draw
        left = posterior.gradient(posterior.along(at, step)) - gradient - precision @ step
        return np.asarray(-known @ (known.T @ left)) / BEND_DIFFERENCE**2

    # a bend grows with the square of a draw: all have the length whose fourth power is that in the mean, so that one
    # is exact along one direction
    several = loose.shape[1]
    draws = np.random.default_rng(BENDS_SEED).standard_normal((BENDS if several > 1 else several, several))
    draws *= (several * (several + 2.0)) ** 0.25 / np.linalg.norm(draws, axis=1, keepdims=True)
    bends: Array = np.zeros((0, len(std)))
    for some in (draws[:FIRST_BENDS], draws[FIRST_BENDS:]):
        bends = np.vstack([bends, *in_threads(bend, some @ loose.T, threads)])
        added = bends.T @ bends / max(len(bends), 1)
        if (np.diag(added) <= SLIGHT * np.diag(covariance)).all():
            break
    return np.asarray((covariance + added)[:size, :size])


@dataclass(frozen=True)
class Point:
    """Unknowns and the knots that minimise the cost there, the normal equations, and the objective.

    The unknowns are the values and, where the motion has noise, those of it. The objective is the
    negative logarithm of the marginal posterior, without its constant.
    """

    unknowns: Array
    states: Array
    equations: NormalEquations
    factor: Array  # Of the matrix of the knots.
    objective: float
    seen: Seen

    @cached_property
    def eliminated(self) -> Eliminated:
        """The knots eliminated from the normal equations."""
        return Eliminated.of(self.equations, self.factor)


@dataclass(frozen=True)
class MarginalPosterior:
    """The marginal posterior of a problem, as the head of this module says."""

    linearisation: Linearisation

    @property
    def links(self) -> int:
        """Number of pairs of successive knots."""
        return len(self.linearisation.problem.knots.links())

    @property
    def size(self) -> int:
        """Number of unknowns: values, and those of the noise of the motion if there is any."""
        return self.linearisation.problem.parameters.size + len(STATED) * (self.links > 0)

    @property
    def prior_std(self) -> Array:
        """Prior standard deviations of the unknowns: the noise is in units of the scene, whose scale has a prior."""
        problem = self.linearisation.problem
        std = problem.parameters.prior_std
        _, gradient = log_scale(problem.parameters, problem.reference, problem.parameters.prior_mean)
        of_noise = np.full(self.size - len(std), UNLIKE_STD)
        of_noise[:1] = np.sqrt(NOISE_STD**2 + float(gradient**2 @ std**2))
        of_noise[3:] *= np.sqrt(2.0)  # for the same prior whatever the axes
        return np.append(std, of_noise)

    def equations(self, unknowns: Array, states: Array, seen: Seen) -> NormalEquations:
        """Normal equations of all unknowns and the knots (k, 2, 3), from what is seen there."""
        (values, noise), count = self.parted(unknowns), self.linearisation.problem.parameters.size
        found, std = self.linearisation.at(values, states, noise if self.links else None, seen), self.prior_std[count:]
        if not self.links:
            return found
        found.matrix[count:, count:] += np.diag(std**-2)
        found.value_vector[count:] -= noise / std**2
        return replace(found, cost=found.cost + float(((noise / std) ** 2).sum()))

    def _volume(self, unknowns: Array, factor: Array) -> float:
        problem, (values, noise) = self.linearisation.problem, self.parted(unknowns)
        scale, _ = log_scale(problem.parameters, problem.reference, values)
        return float(np.log(factor[0]).sum()) + 6.0 * self.links * (scale + float(noise[0]))

    def _first_states(self, states: Array) -> tuple[float, Array]:
        """Half of N log det(P V) at knots (k, 2, 3), and its derivatives by them; what stands still has no velocity."""
        knots, total, slopes = self.linearisation.problem.knots, 0.0, np.zeros_like(states)
        for part, middle in ((0, states[:, 0].mean(axis=0)), (1, np.zeros(3)))[: 1 + knots.motion.moves]:
            offsets = states[:, part] - middle
            spread = offsets.T @ offsets / len(states)
            spread += (LEAST_SPREAD * np.trace(spread) + np.finfo(np.float64).tiny) * np.eye(3)
            total += 0.5 * knots.count * float(np.linalg.slogdet(spread)[1])
            inverse = np.linalg.inv(spread)
            inverse += LEAST_SPREAD * np.trace(inverse) * np.eye(3)  # the least spread follows, too
            slopes[:, part] = knots.count / len(states) * offsets @ inverse
        return total, slopes.ravel()

    def at(self, unknowns: Array, states: Array, settled: float = KNOTS_SETTLED) -> Point:
        """Return the point of unknowns, its knots minimised from the given ones, to a fall of the cost of `settled`.

        Raises LinAlgError when the normal equations are not positive definite, or the cost is not finite.
        """
        values, noise = self.parted(unknowns)
        placement = self.linearisation.placed(values)
        states, _, seen, factor = settled_knots(
            self.linearisation, values, states, noise, KNOT_STEPS, settled, placement
        )
        seen = self.linearisation.with_values(seen, values, states)
        equations = self.equations(unknowns, states, seen)
        factor = factor_knots(equations.bands) if factor is None else factor
        volume = self._volume(unknowns, factor) + self._first_states(states)[0]
        return Point(unknowns, states, equations, factor, 0.5 * equations.cost + volume, seen)

    def along(self, at: Point, step: Array, settled: float = KNOTS_SETTLED) -> Point:
        """Return the point after a step (size,). The knots begin where they follow it to first order; see `at`."""
        return self.at(at.unknowns + step, at.states + at.eliminated.followed(step).reshape(at.states.shape), settled)

    def beside(self, at: Point, step: Array, curved: Array) -> Point:
        """Return the point after a small step (size,), its knots at their minimum to second order of the step.

        They take a step by their second derivatives at the other point, of the Cholesky factor `curved` (12, 6 k). It
        is for `gradient` alone: it has no objective, and of its equations nothing that detections tell of the values.
        """
        unknowns, states = at.unknowns + step, at.states + at.eliminated.followed(step).reshape(at.states.shape)
        (values, noise), linearisation = self.parted(unknowns), self.linearisation
        placement = linearisation.placed(values)
        _, _, vector, _ = linearisation.of_knots(values, states, noise, placement)
        states += cho_solve_banded((curved, True), vector, check_finite=False).reshape(states.shape)
        seen = linearisation.residuals(values, states, placement, by_values=False)
        seen = replace(seen, velocities=positions(states, *placement.rates))
        found = self.equations(unknowns, states, seen)
        return Point(unknowns, states, found, factor_knots(found.bands), np.nan, seen)

    def with_shown_motion(self, values: Array, states: Array, noise: Array) -> Point:
        """Return the point of held values (m,) at the noise of the motion that fits there, searched from one (6,)."""
        begun = self.at(np.append(values, noise[: self.size - len(values)]), states)
        return _minimised(self, begun, MOTION_SETTLED, [])[0]

    def parted(self, unknowns: Array) -> tuple[Array, Array]:
        """Return values (m,), and the unknowns (6,) of the noise of the motion."""
        count = self.linearisation.problem.parameters.size
        return unknowns[:count], unknowns[count:] if self.links else STATED

    def gradient(self, at: Point) -> Array:
        """Gradient (size,) of the objective."""
        linearisation, equations = self.linearisation, at.equations
        problem, (values, noise) = linearisation.problem, self.parted(at.unknowns)
        slopes = self.slopes(at)
        path, rates = at.seen.placement.path, at.seen.placement.rates
        by_states = linearisation.of_states(path, slopes.by_point) + self._first_states(at.states)[1]
        by_states -= equations.state_vector  # knots beside their minimum: the effect is removed to first order
        curved = linearisation.factor_of_knots(at.seen, equations.bands)
        across = cho_solve_banded((curved, True), by_states, check_finite=False).reshape(at.states.shape)
        # knots that follow move points and velocities, and with them what the errors pull at the values with
        moved, faster = (positions(across, i.knot, i.weights, np.zeros_like(at.seen.velocities)) for i in (path, rates))
        pulls = linearisation.pulls(at.seen)
        following = linearisation.pulls(at.seen, np.einsum("nra,na->nr", at.seen.by_point, moved))
        later = np.einsum("nr,nra,na->n", pulls, at.seen.by_point, faster)
        at_pixels = -following if at.seen.by_value.shape[2] else -following - pulls  # of points `beside` another
        by_value = slopes.by_value(linearisation, at_pixels, pulls[:, :, None] * moved[:, None, :], later)
        products = linearisation.motion.pulls(at.states)[0].T @ across.reshape(-1, 3)
        by_products = linearisation.noise_at(values, noise).by_unknowns(products + products.T)
        of_noise = slopes.by_noise.sum(axis=0) - by_products + 6.0 * self.links * OF_ALL
        _, by_scale = log_scale(problem.parameters, problem.reference, values)
        direct = linearisation.of_values(by_value) + float(of_noise[0]) * by_scale
        if problem.held is not None:
            direct[problem.held] = 0.0
        return np.asarray(np.append(direct, of_noise[: self.size - len(values)]) - equations.value_vector)

    def slopes(self, at: Point) -> VolumeSlopes:
        """Return how the volume changes with values and points, detection by detection."""
        values, noise = self.parted(at.unknowns)
        return VolumeSlopes.of(self.linearisation, values, noise, at.factor, at.seen)

    def covariance(self, at: Point) -> Array:
        """Covariance (size, size) of the unknowns by the normal equations of a point.

        Their information about the noise of the motion along the axes counts twice, as the head of this module derives.
        """
        covariance = within_prior(at.eliminated.schur, self.prior_std)
        if not self.links:
            return covariance
        axes = slice(self.size - len(STATED), self.size - len(STATED) + 3)
        eigenvalues, vectors = np.linalg.eigh(at.eliminated.schur[axes, axes] - np.diag(self.prior_std[axes] ** -2))
        known = (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T  # rounding may make it negative
        with_noise = covariance[:, axes]
        taken = np.linalg.solve(np.eye(3) + known @ with_noise[axes], known @ with_noise.T)
        return np.asarray(covariance - with_noise @ taken)

    def root(self, at: Point) -> Array:
        """Root D (size, size) of the covariance D D^T of the unknowns."""
        return np.asarray(np.linalg.cholesky(self.covariance(at)), dtype=np.float64)


def at_answer(problem: Problem, adjustment: Adjustment) -> tuple[MarginalPosterior, Point]:
    """Return the marginal posterior of a problem, with the weights that detections have at its optimum, and that point.

    The adjustment is the optimum, with a noise of the motion beside the stated one, which the problem has.
    """
    posterior = MarginalPosterior(Linearisation.of(problem.weighted(problem.weights(adjustment.distances))))
    unknowns = np.append(adjustment.values, adjustment.motion_noise[: posterior.size - len(adjustment.values)])
    return posterior, posterior.at(unknowns, adjustment.states)


def _minimised(
    posterior: MarginalPosterior, at: Point, settled: float, secants: list[tuple[Array, Array]]
) -> tuple[Point, Array, float]:
    """Minimise the objective from a point; also the step on which that settled, and its length, posterior deviations.

    The step is 0 where the search has ended otherwise. `secants` are steps near an optimum and the changes of the
    gradient along them, to which those of this search are added.
    """
    longest, objectives, is_near = LONGEST_STEP, [at.objective], False
    step = gradient = np.zeros(posterior.size)
    for number in range(MOST_STEPS):
        within(f"search for the optimum, step {number + 1}")
        before = gradient
        try:
            root, gradient = posterior.root(at), posterior.gradient(at)
        except LinAlgError:
            return at, np.zeros(posterior.size), np.inf
        if is_near and step @ (gradient - before) > 0.0:
            secants.append((step, gradient - before))
        is_near = bool(np.linalg.norm(root.T @ gradient) <= NEAR)
        downhill = -_bent(root @ root.T, secants if is_near else []) @ gradient
        length = float(np.sqrt(max(-float(downhill @ gradient), 0.0)))
        if length <= settled:
            return at, downhill, length
        taken = min(length, longest)
        step = taken / length * downhill
        slope = float(gradient @ step)
        tried = _tried(posterior, at, step)
        found = next(((s, p) for s, p in tried if p.objective <= at.objective + DECREASE * s * slope), None)
        if found is None:
            if not secants:
                break
            secants.clear()  # they were those of another optimum
            continue
        share, at = found
        step = share * step
        longest = min((LONGER if share == 1.0 else 1.0) * share * taken, LONGEST_STEP)
        objectives.append(at.objective)
        if len(objectives) > STALLED_STEPS and objectives[-1 - STALLED_STEPS] - at.objective < STALLED:
            break
    return at, np.zeros(posterior.size), length


def _bent(covariance: Array, secants: list[tuple[Array, Array]]) -> Array:
    """Covariance (size, size) that explains how the gradient changed along steps, the last of them exactly (BFGS)."""
    for step, change in secants:
        across = np.eye(len(step)) - np.outer(step, change) / (step @ change)
        covariance = across @ covariance @ across.T + np.outer(step, step) / (step @ change)
    return covariance


def _tried(posterior: MarginalPosterior, at: Point, step: Array) -> Iterator[tuple[float, Point]]:
    """Points after a step and shorter and shorter shares of it, where there are cameras and regular equations."""
    share = 1.0
    while share >= LEAST_SHARE:
        with suppress(LinAlgError):
            yield share, posterior.along(at, share * step, KNOTS_IN_SEARCH)
        share *= 0.5
