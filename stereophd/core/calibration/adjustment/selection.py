"""Which unknowns to free: sets of them compared by how well they predict stretches of the log that they did not see.

Freeing what is known well enough costs accuracy: lens coefficients take up what clocks or labels do wrong, residuals
fall, and the trajectories get worse. Residuals of the detections that were fitted fall with every unknown that is
freed, so they do not choose. Here the log is cut into stretches. Cameras are adjusted to every other stretch, for each
set of unknowns, the values outside of it at the prior mean; then they are held, the trajectories of the remaining
stretches are fitted under them, and the loss of the detections there is the score of the set (M. Stone, "Cross-
validatory choice and assessment of statistical predictions", 1974). The other half of the stretches does the same.

If the model and the priors are right, freeing everything under its prior is best. A smaller set is therefore chosen
only if its prediction is better by more than the standard error of the difference over the stretches.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import adjust
from stereophd.core.calibration.unknowns.unknown_sets import UnknownSet

# Stretches of the log; iterations of an adjustment to half of them and of the trajectories of the others, and the
# relative change of the cost at which they end.
STRETCHES, TRAINED_ITERATIONS, HELD_ITERATIONS, TOLERANCE = 12, 10, 4, 1e-4
# Detections of a stretch that are needed for a comparison, and of the whole log at most: of a longer one every n-th
# counts n times.
LEAST_DETECTIONS, MOST_DETECTIONS = 8, 6000


@dataclass(frozen=True)
class Comparison:
    """How well sets of unknowns predict."""

    sets: tuple[UnknownSet, ...]  # The smallest first, all unknowns last
    losses: Array  # (s, b): Loss of the detections of each stretch under cameras that did not see it, by set
    chosen: int  # Which set is taken

    @property
    def free(self) -> Booleans:
        """Values (m,) of the set that is taken."""
        return self.sets[self.chosen].free

    @property
    def totals(self) -> Array:
        """Loss (s,) of all stretches."""
        return np.asarray(self.losses.sum(axis=1))

    @property
    def errors(self) -> Array:
        """Standard error (s,) of the difference of each set's loss from that of all unknowns."""
        difference = self.losses - self.losses[-1]
        return np.asarray(difference.std(axis=1, ddof=1) * np.sqrt(difference.shape[1]))


def stretches_of(times: Array) -> Integers:
    """Stretch (n,) of each detection: as many detections in each."""
    order = np.argsort(times, kind="stable")
    stretches = np.empty(len(times), dtype=np.int64)
    stretches[order] = np.arange(len(times)) * STRETCHES // max(len(times), 1)
    return stretches


def compare(problem: Problem, values: Array, states: Array, sets: Sequence[UnknownSet]) -> Comparison | None:
    """Compare sets of unknowns, the smallest first and all unknowns last, from a fit and its association.

    The values of the fit are (m,), its knots (k, 2, 3). None where there is one set only, or the log is too short.
    """
    observations = problem.observations
    if len(sets) < 2 or len(observations) < STRETCHES * LEAST_DETECTIONS:
        return None
    stretches = stretches_of(observations.times)
    weights = np.ones(len(observations)) if observations.weights is None else observations.weights
    problem, stretches, weights = _thinned(problem, stretches, weights)
    observations = problem.observations
    losses = np.zeros((len(sets), STRETCHES))
    for row, one in enumerate(sets):
        begin = np.where(one.free, values, problem.parameters.prior_mean)
        for parity in (0, 1):
            seen = stretches % 2 == parity
            train = replace(problem, observations=replace(observations, weights=weights * seen), held=~one.free)
            trained = adjust(train, begin, states, TRAINED_ITERATIONS, TOLERANCE)
            test = replace(
                problem, observations=replace(observations, weights=weights * ~seen),
                held=np.ones(len(values), dtype=np.bool_),
            )  # fmt: skip
            predicted = adjust(test, trained.values, states, HELD_ITERATIONS, TOLERANCE)
            loss = -2.0 * np.log(np.exp(-0.5 * predicted.distances) + problem.loss.scale)
            losses[row] += np.bincount(stretches[~seen], (weights * loss)[~seen], minlength=STRETCHES)
    return Comparison(tuple(sets), losses, choice(losses))


def _thinned(problem: Problem, stretches: Integers, weights: Array) -> tuple[Problem, Integers, Array]:
    """Problem, stretches (n,) and weights (n,) with every n-th detection of each trajectory and camera."""
    observations = problem.observations
    every = -(-len(observations) // MOST_DETECTIONS)
    if every == 1:
        return problem, stretches, weights
    order = np.lexsort((observations.times, observations.cameras, observations.trajectories))
    kept = np.sort(order[::every])
    return replace(problem, observations=observations.take(kept)), stretches[kept], every * weights[kept]


def choice(losses: Array) -> int:
    """Index of the set of the least loss if it beats the last by more than the standard error, else the last.

    Losses are (s, b), by set and stretch.
    """
    last = len(losses) - 1
    best = int(losses.sum(axis=1).argmin())
    difference = losses[last] - losses[best]
    sure = difference.sum() > difference.std(ddof=1) * np.sqrt(len(difference))
    return best if best != last and sure else last
