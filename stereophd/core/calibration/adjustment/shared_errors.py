"""Detections of one object that share an error: how much each of them is worth as a measurement.

A lens model that does not fit, or a label on one side of the object, shifts all detections alike while the image of the
object stays in one place. A thousand frames of an object that hovers then count hardly more than one measurement of the
cameras. Detections of one trajectory and camera in succession, within some pixels of the first of them, form a cell.
The residuals r of a fit are taken as

    r = shared + own,    variances b and w per coordinate, `shared` the same in a cell,

and b and w are the components of variance of each camera (one-way analysis of variance with random effects: S. R.
Searle, G. Casella and C. E. McCulloch, "Variance Components", 1992, section 3.6). Cameras and trajectories that were
fitted absorb most of what cells share: how much is found by drawing errors of unit variance of either kind, adjusting
to them by one linear step, and taking the components of what is left. The mean of n detections of a cell has the
variance b + w / n, so each of them counts as one of variance w + n b.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.linearisation import Linearisation
from stereophd.core.calibration.adjustment.problem import SQUARED, Observations
from stereophd.core.calibration.adjustment.solver import eliminate, factor_knots, within_prior
from stereophd.core.calibration.adjustment.trajectories import positions
from stereophd.core.numerics.compilation.compiled import compiled

# Cells that a camera needs, and the least part of the variance that is shared, for its errors to count as shared.
LEAST_CELLS, LEAST_PART = 12, 0.2
# Damping of the linear step, and the least response to an error of a kind that is believed.
DAMPING, LEAST_RESPONSE = 1e-9, 0.02
# Residuals count up to this many standard deviations as stated: the rest are false detections.
LARGEST_RESIDUAL = 3.0


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


def variance_components(residuals: Array, cells: Integers) -> tuple[float, float]:
    """Variances, per coordinate, of the errors of residuals (n, 2): independent ones, and those cells (n,) share."""
    _, cells, sizes = np.unique(cells, return_inverse=True, return_counts=True)
    count, total = len(sizes), len(cells)
    if count < 2 or total == count:
        return float((residuals**2).mean()), 0.0
    means = np.stack([np.bincount(cells, residuals[:, axis]) / sizes for axis in (0, 1)], axis=1)
    own = ((residuals - means[cells]) ** 2).sum() / (2.0 * (total - count))
    # about zero and not about their mean: the fit leaves none
    between = (sizes[:, None] * means**2).sum() / (2.0 * count)
    shared = max((between - own) * count / total, 0.0)
    return float(own), float(shared)


@dataclass(frozen=True)
class SharedErrors:
    """Errors of the detections of each camera, px per coordinate."""

    # `own`, `shared`: arrays (c,): Standard deviations of the independent error of each detection, and of the error
    # that detections of a cell share; NaN and 0 for cameras whose residuals show no shared error.
    own: Array
    shared: Array
    # (n,): What each detection counts, in measurements of the precision that its detector states; 1 for such cameras.
    weights: Array


def shared_errors(
    linearisation: Linearisation, values: Array, states: Array, radius: float, rng: np.random.Generator
) -> SharedErrors:
    """Find the errors that detections share within cells of a radius in px, from the residuals of a fit.

    The fit has the values (m,) and states of the knots (k, 2, 3); errors are drawn from `rng`.
    """
    observations = linearisation.problem.observations
    residuals = linearisation.residuals(values, states)[1]
    cells = cells_of(observations, radius)
    count = len(linearisation.members)
    own, shared, weights = np.full(count, np.nan), np.zeros(count), np.ones(len(observations))
    precision = observations.precisions[:, [0, 1], [0, 1]].mean(axis=1)
    usable = np.abs(residuals).max(axis=1) * np.sqrt(precision) < LARGEST_RESIDUAL
    chosen = [here[usable[here]] for here in linearisation.members]
    tried = [k for k, here in enumerate(chosen) if len(np.unique(cells[here])) >= LEAST_CELLS]
    found = {k: np.array(variance_components(residuals[chosen[k]], cells[chosen[k]])) for k in tried}
    if not any(components[1] > 0.0 for components in found.values()):
        return SharedErrors(own, shared, weights)
    normal = rng.standard_normal((len(cells), 2)), rng.standard_normal((int(cells.max()) + 1, 2))[cells]
    left = [remaining_errors(linearisation, values, states, errors) for errors in normal]
    for k, components in found.items():
        here = linearisation.members[k]
        responses = np.array([variance_components(one[here], cells[here]) for one in left]).T
        if np.linalg.det(responses) <= LEAST_RESPONSE**2 or responses[1, 1] < LEAST_RESPONSE:
            continue
        of_one, of_cell = np.maximum(np.linalg.solve(responses, components), 0.0)
        if of_cell < LEAST_PART * (of_one + of_cell):
            continue
        own[k], shared[k] = np.sqrt(of_one), np.sqrt(of_cell)
        sizes = np.bincount(cells[here])[cells[here]]
        weights[here] = 1.0 / ((of_one + sizes * of_cell) * precision[here])
    return SharedErrors(own, shared, weights)


def remaining_errors(linearisation: Linearisation, values: Array, states: Array, errors: Array) -> Array:
    """Return what one linear step of cameras and trajectories leaves of errors (n, 2) of the detections."""
    equations = linearisation.at(values, states)
    path, _, visible, by_point, by_value = linearisation.residuals(values, states)
    sums = linearisation.summed(path, errors, visible, by_point, by_value, SQUARED)
    factor = factor_knots(equations.bands, DAMPING)
    eliminated, schur = eliminate(replace(equations, state_vector=sums.state_vector), factor)
    right = sums.value_vector - equations.coupling.T @ eliminated[:, -1]
    value_step = within_prior(schur, linearisation.problem.parameters.prior_std) @ right
    state_step = eliminated[:, -1] - eliminated[:, :-1] @ value_step
    moved = positions(state_step.reshape(states.shape), path.knot, path.weights, np.zeros((len(errors), 3)))
    left = errors - np.einsum("nij,nj->ni", by_point, moved)
    for columns, here in zip(linearisation.columns, linearisation.members, strict=True):
        used = columns >= 0
        left[here] -= by_value[here][:, :, used] @ value_step[columns[used]]
    return np.asarray(left)
