"""The noise of the detections, estimated from the residuals of a fit: one factor a camera on what is stated.

The estimate of a component of variance is the weighted sum of squared residuals over the redundancy, the number of
coordinates that trajectories and cameras did not absorb (W. Förstner, "Ein Verfahren zur Schätzung von Varianz- und
Kovarianzkomponenten", 1979). The redundancy of a camera is a part of the trace of I - H, with the matrix H that maps
errors to what the fit absorbs of them; it is estimated by drawing errors e with the stated covariance: the mean of
e^T P (I - H) e (M. F. Hutchinson, 1990). The prior of a variance is worth `PRIOR_REDUNDANCY` coordinates of the stated
size.

A noise that is stated too small hides itself: trajectories follow the detections, and gates drop those that they do
not reach. What is left fits. Such a camera shows by its redundancy, and its noise is then looked for from above.
"""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.calibration.adjustment.linearisation import Linearisation
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.shared_errors import remaining_errors
from stereophd.core.calibration.adjustment.solver import Adjustment

# Coordinates that the prior of a variance is worth; errors that are drawn of all detections.
PRIOR_REDUNDANCY, DRAWS = 2.0, 4
# A factor is believed to differ from 1 beyond this part of it, and beyond so many of its standard deviations.
LEAST_CHANGE, LEAST_SIGMAS = 0.15, 3.0
# Residuals tell less noise than stated where at least this part of the coordinates is redundant.
LEAST_REDUNDANT = 0.3


@dataclass(frozen=True)
class NoiseFactors:
    """Noise of each camera's detections over what is stated, arrays (c,)."""

    factors: Array
    redundancy: Array  # Coordinates that tell.
    coordinates: Array  # All of them.

    @property
    def differs(self) -> Booleans:
        """Which cameras' noise differs from what is stated."""
        change, stds = np.abs(np.log(self.factors)), 1.0 / np.sqrt(2.0 * (self.redundancy + PRIOR_REDUNDANCY))
        tells = (self.factors > 1.0) | ~self.hides
        return np.asarray(tells & (change > np.maximum(np.log1p(LEAST_CHANGE), LEAST_SIGMAS * stds)))

    @property
    def hides(self) -> Booleans:
        """Which cameras' trajectories follow the detections too closely for residuals to tell the noise."""
        return np.asarray(self.redundancy < LEAST_REDUNDANT * self.coordinates)


def noise_factors(problem: Problem, adjustment: Adjustment, rng: np.random.Generator) -> NoiseFactors:
    """Estimate the noise of the detections of each camera over what is stated, with errors drawn from `rng`."""
    observations = problem.observations
    weights = problem.weights(adjustment.distances)
    linearisation = Linearisation.of(problem.weighted(weights))
    sigma = 1.0 / np.sqrt(observations.precisions[:, [0, 1], [0, 1]])
    redundancy = np.zeros(len(observations))
    for _ in range(DRAWS):
        errors = sigma * rng.standard_normal(sigma.shape)
        remaining = remaining_errors(linearisation, adjustment.values, adjustment.states, errors)
        redundancy += weights * (errors * remaining / sigma**2).sum(axis=1) / DRAWS
    count = len(problem.parameters.cameras)
    squares = np.bincount(observations.cameras, weights * adjustment.distances, count)
    known = np.maximum(np.bincount(observations.cameras, redundancy, count), 0.0)
    coordinates = 2.0 * np.bincount(observations.cameras, weights, count).astype(np.float64)
    return NoiseFactors(np.sqrt((PRIOR_REDUNDANCY + squares) / (PRIOR_REDUNDANCY + known)), known, coordinates)
