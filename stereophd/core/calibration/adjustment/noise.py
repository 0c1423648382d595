"""The noise of the detections of each camera, and how much of it detections share, from the residuals of a fit.

A lens model that does not fit, or a label on one side of the object, shifts all detections alike while the image of the
object stays in one place. A thousand frames of an object that hovers then count hardly more than one measurement of the
cameras. Detections of one trajectory and camera in succession, within some pixels of the first of them, form a cell.
Residuals are taken as

    r = shared + own,    variances b and w per coordinate, `shared` the same in a cell,

and b and w are the components of variance of each camera (one-way analysis of variance with random effects: S. R.
Searle, G. Casella and C. E. McCulloch, "Variance Components", 1992, section 3.6). Cameras and trajectories that were
fitted absorb most of what cells share: how much is found by drawing errors of unit variance of either kind, adjusting
to them by one linear step, and taking the components of what is left. The noise is b + w, and the mean of n detections
of a cell has the variance b + w / n, so that each of them counts as one of variance w + n b. Residuals also hold the
motion that trajectories miss. If the fit leaves (I - H) e of errors e of covariance R, it leaves motion of the
covariance H R (I - H)^T by the model, which the same draws show.

**At full weights.** The residuals are those of trajectories that follow every detection at the weight of its noise
alone. Trajectories of detections that count less keep to the motion model instead, and what it does wrong looks like an
error that detections share: they would count less and less.

**Without shared errors** b is 0, and w is the weighted sum of squared residuals over the redundancy, the number of
coordinates that trajectories and cameras did not absorb (W. Förstner, "Ein Verfahren zur Schätzung von Varianz- und
Kovarianzkomponenten", 1979). The redundancy of a camera is a part of the trace of I - H, with the matrix H that maps
errors to what the fit absorbs of them: the mean of e^T P (I - H) e over the errors e (M. F. Hutchinson, 1990). The
prior of a variance is worth `PRIOR_REDUNDANCY` coordinates of the stated size, or of a lesser one that was believed.

A noise that is stated too small hides itself: trajectories follow the detections, and gates drop those that they do
not reach. What is left fits. Such a camera shows by its redundancy, and its noise is then looked for from above. Where
that search begins is no statement: the noise falls with its estimate, however few coordinates tell, until it stays.
"""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.adjustment.linearisation import Linearisation, factor_knots
from stereophd.core.calibration.adjustment.problem import Observations, Problem
from stereophd.core.calibration.adjustment.solver import Adjustment, Eliminated, within_prior
from stereophd.core.calibration.adjustment.trajectories import positions
from stereophd.core.numerics.compilation.compiled import compiled

# Coordinates that the prior of a variance is worth; errors that are drawn of all detections, of each kind.
PRIOR_REDUNDANCY, DRAWS = 2.0, 8
# A noise is believed to differ from what is stated beyond this part of it and so many of its standard deviations.
LEAST_CHANGE, LEAST_SIGMAS = 0.15, 3.0
# Residuals tell less noise than stated where at least this part of the coordinates is redundant.
LEAST_REDUNDANT = 0.3
# Cells that a camera needs, and the least part of the variance that is shared, for its errors to count as shared.
LEAST_CELLS, LEAST_PART = 12, 0.2
# Damping of the linear step, and the least response to an error of a kind that is believed.
DAMPING, LEAST_RESPONSE = 1e-9, 0.02
# Weight by its loss from which a detection tells what is shared: the others are rather false ones.
LEAST_WEIGHT = 0.5


@compiled
def _cells(trajectories: Integers, cameras: Integers, points: Array, radius: float, cells: Integers) -> int:
    """Number the cells of detections in order of time; return their count."""
    count = 0
    trajectory_count, camera_count = trajectories.max() + 1, cameras.max() + 1
    current = np.full((trajectory_count, camera_count), -1)
    first = np.zeros((trajectory_count, camera_count, 2))
    for n in range(len(trajectories)):
        j, c = trajectories[n], cameras[n]
        u, v = points[n, 0] - first[j, c, 0], points[n, 1] - first[j, c, 1]
        if current[j, c] < 0 or u * u + v * v > radius * radius:
            current[j, c] = count
            first[j, c] = points[n]
            count += 1
        cells[n] = current[j, c]
    return count


def cells_of(observations: Observations, radius: float) -> Integers:
    """Cell (n,) of each detection: `radius` pixels about the first detection of it."""
    cells = np.empty(len(observations), dtype=np.int64)
    if not len(observations):
        return cells
    order = np.lexsort((observations.times, observations.trajectories))
    arguments = (observations.trajectories[order], observations.cameras[order], observations.points[order])
    found = np.empty(len(order), dtype=np.int64)
    _cells(*arguments, float(radius), found)
    cells[order] = found
    return cells


def weights_of(observations: Observations, shared: Array, radius: float) -> Array:
    """Weights (n,) of detections of which cameras share a part (c,) of the variance, in cells of a radius in px."""
    cells = cells_of(observations, radius)
    part = shared[observations.cameras]
    return np.asarray(1.0 / (1.0 - part + np.bincount(cells)[cells] * part))


def variance_components(residuals: Array, cells: Integers) -> tuple[float, float]:
    """Variances, per coordinate, of the errors of residuals (n, 2): independent ones, and those cells (n,) share."""
    _, cells, sizes = np.unique(cells, return_inverse=True, return_counts=True)
    count, total = len(sizes), len(cells)
    means = np.stack([np.bincount(cells, residuals[:, axis]) / sizes for axis in (0, 1)], axis=1)
    own = ((residuals - means[cells]) ** 2).sum() / (2.0 * (total - count))
    # about zero and not about their mean: the fit leaves none
    between = (sizes[:, None] * means**2).sum() / (2.0 * count)
    return float(own), float((between - own) * count / total)


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of each camera's detections, arrays (c,)."""

    factors: Array  # Over that of the problem.
    shared: Array  # Part of its variance that the detections of a cell share.
    redundancy: Array  # Coordinates that tell.
    coordinates: Array  # All of them.
    sizes: Array  # Detections in the cell of a detection, in the mean.

    def differs(self, shared: Array, from_above: Booleans) -> Booleans:
        """Which cameras' noise differs from that of the fit, of whose variance the part `shared` (c,) is shared.

        The noise of a detection differs, or that of a cell. One that is looked for `from_above` (c,) is no statement.
        """
        of_cells = (1.0 + (self.sizes - 1.0) * self.shared) / (1.0 + (self.sizes - 1.0) * shared)
        change = np.log(self.factors)
        largest = np.maximum(np.abs(change), np.abs(change + 0.5 * np.log(of_cells)))
        tells = np.where((self.shared > 0.0) | (shared > 0.0), self.coordinates / self.sizes, self.redundancy)
        least = np.where(from_above, 0.0, LEAST_SIGMAS / np.sqrt(2.0 * (tells + PRIOR_REDUNDANCY)))
        is_told = (change > 0.0) | from_above | ~self.hides
        return np.asarray((largest > np.maximum(np.log1p(LEAST_CHANGE), least)) & is_told)

    @property
    def hides(self) -> Booleans:
        """Which cameras' trajectories follow the detections too closely for residuals to tell the noise."""
        return np.asarray(self.redundancy < LEAST_REDUNDANT * self.coordinates)


def estimate_noise(
    problem: Problem, adjustment: Adjustment, noise: Array, shared: Array, radius: float, rng: np.random.Generator
) -> NoiseEstimate:
    """Estimate the noise of the detections of each camera over that of the problem, with errors drawn from `rng`.

    The adjustment gives detections the weight of their noise alone, `noise` (c,) times what is stated. `shared` (c,) is
    what is known of errors that detections share in cells of a radius in px; 0: they share none.
    """
    observations, count = problem.observations, len(problem.parameters.cameras)
    weights = problem.weights(adjustment.distances)
    linearisation = Linearisation.of(problem.weighted(weights))
    values, states = adjustment.values, adjustment.states
    sigma = 1.0 / np.sqrt(observations.precisions[:, [0, 1], [0, 1]])
    residuals = linearisation.residuals(values, states).errors / sigma
    cells = cells_of(observations, radius)
    own = rng.standard_normal((DRAWS, len(cells), 2))
    # of cells of one detection no error is shared
    of_cells = rng.standard_normal((DRAWS if radius > 0.0 else 0, len(cells), 2))[:, cells]
    counted = linearisation
    if shared.any():
        counted = Linearisation.of(problem.weighted(weights * weights_of(observations, shared, radius)))
    left = remaining_errors(linearisation, counted, values, states, sigma * np.concatenate([own, of_cells])) / sigma
    squares = np.bincount(observations.cameras, weights * adjustment.distances, count)
    left_of_own = weights * (own * left[:DRAWS]).sum(axis=2).mean(axis=0)
    redundancy = np.maximum(np.bincount(observations.cameras, left_of_own, count), 0.0)
    coordinates = 2.0 * np.bincount(observations.cameras, weights, count).astype(np.float64)
    variances = (PRIOR_REDUNDANCY / np.maximum(noise, 1.0) ** 2 + squares) / (PRIOR_REDUNDANCY + redundancy)
    parts, sizes = np.zeros(count), np.ones(count)
    for camera, here in enumerate(linearisation.members):
        here = here[weights[here] > LEAST_WEIGHT]
        in_cell = np.unique(cells[here], return_counts=True)[1]
        if radius == 0.0 or not LEAST_CELLS <= len(in_cell) < len(here):
            continue
        sizes[camera] = (in_cell**2).sum() / len(here)
        drawn, absorbed, all_of_own = (
            np.array([variance_components(errors[here], cells[here]) for errors in kind])
            for kind in (left, own - left[:DRAWS], own)
        )
        responses = drawn.reshape(2, DRAWS, 2).mean(axis=1).T
        if np.linalg.det(responses) <= LEAST_RESPONSE**2 or responses[1, 1] < LEAST_RESPONSE:
            continue
        of_motion = (all_of_own - absorbed - drawn[:DRAWS]).mean(axis=0) / 2.0
        components = np.array(variance_components(residuals[here], cells[here]))
        of_one, of_cell = np.linalg.solve(responses, components - of_motion)
        # errors of their own make cells differ by chance, too
        chance = LEAST_SIGMAS * of_one * drawn[:DRAWS, 1].std() / responses[1, 1]
        least = max(chance, LEAST_PART * (of_one + of_cell)) if shared[camera] == 0.0 else 0.0
        if of_one > 0.0 and of_cell > least:
            variances[camera], parts[camera] = of_one + of_cell, of_cell / (of_one + of_cell)
    return NoiseEstimate(np.sqrt(variances), parts, redundancy, coordinates, sizes)


def remaining_errors(
    linearisation: Linearisation, counted: Linearisation, values: Array, states: Array, errors: Array
) -> Array:
    """Return what one linear step of cameras and trajectories leaves of errors (d, n, 2) of the detections.

    The cameras take the step of a problem in which detections that share errors count less, and the trajectories
    follow all detections.
    """
    seen = linearisation.residuals(values, states)
    path = seen.placement.path
    value_steps, steps = np.empty((0, 0)), np.empty((0, 0))
    for problem in (counted,) if counted is linearisation else (counted, linearisation):
        equations = problem.at(values, states)
        eliminated = Eliminated.of(equations, factor_knots(equations.bands, DAMPING))
        pulls = [problem.pulls(seen, one)[:, :, None] for one in errors]
        of_states = [problem.of_states(path, (seen.by_point * each).sum(axis=1)) for each in pulls]
        steps = eliminated.of_knots(np.stack(of_states, axis=1))
        if problem is counted:
            of_values = [problem.of_values((seen.by_value * each).sum(axis=1)) for each in pulls]
            right = np.stack(of_values, axis=1) - equations.coupling.T @ steps
            value_steps = within_prior(eliminated.schur, problem.problem.parameters.prior_std) @ right
        steps = steps + eliminated.followed(value_steps)
    left, still = errors.copy(), np.zeros((len(errors[0]), 3))
    for out, step, value_step in zip(left, steps.T, value_steps.T, strict=True):
        moved = positions(step.reshape(states.shape), path.knot, path.weights, still)
        out -= np.einsum("nij,nj->ni", seen.by_point, moved)
        for columns, here in zip(linearisation.columns, linearisation.members, strict=True):
            used = columns >= 0
            out[here] -= seen.by_value[here][:, :, used] @ value_step[columns[used]]
    return left
