"""How far tracks move with the values of a calibration, relative to their distance, the scale apart."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.linearisation import Linearisation, NormalEquations, factor_knots
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import Adjustment, Eliminated
from stereophd.core.calibration.unknowns.scale import log_scale

# Points of the tracks that are looked at.
MOST_POINTS = 2000


@dataclass(frozen=True)
class TrackMoves:
    """Derivatives of points of the fitted tracks by the values of a calibration."""

    points: Array  # (k, 3): from the reference camera, length
    slopes: Array  # (k, 3, m)
    scale: Array  # (m,): Derivative of the logarithm of the cameras' scale; zero where it is known

    @classmethod
    def of(cls, problem: Problem, values: Array, states: Array, equations: NormalEquations) -> Self:
        """Return the moves of the knots (k, 2, 3) of a fit, which follow the values (m,) to first order."""
        following = Eliminated.of(equations, factor_knots(equations.bands)).following()
        origin = problem.parameters.cameras[problem.reference].pose.center
        slopes = following.reshape(len(states), 2, 3, -1)[:, 0]
        chosen = np.arange(0, len(slopes), -(-len(slopes) // MOST_POINTS))
        scale = np.zeros(slopes.shape[-1])
        scale[: len(values)] = log_scale(problem.parameters, problem.reference, values)[1]
        return cls(states[chosen, 0] - origin, slopes[chosen], scale)

    def relative_move(self, step: Array) -> float:
        """Median distance by which a step of the values (m,) moves the points, over their distance from the reference.

        The factor by which the cameras grow apart is left out: it is the scale, which has its own statement.
        """
        moves = self.slopes @ step - float(self.scale @ step) * self.points
        distances = np.linalg.norm(self.points, axis=1)
        return float(np.median(np.linalg.norm(moves, axis=1) / np.maximum(distances, 1e-300)))

    def relative_std(self, root: Array) -> float:
        """Root of the sum of the squared moves by the columns of a root (m, j) of a covariance of the values."""
        return float(np.linalg.norm([self.relative_move(step) for step in root.T]))


def track_moves(problem: Problem, adjustment: Adjustment) -> TrackMoves:
    """Return the moves of the tracks of a fit."""
    equations = Linearisation.of(problem).at(adjustment.values, adjustment.states)
    return TrackMoves.of(problem, adjustment.values, adjustment.states, equations)
