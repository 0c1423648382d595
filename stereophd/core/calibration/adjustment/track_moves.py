"""How far tracks move with the values of a calibration, relative to their distance, the scale apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.linearisation import Linearisation, NormalEquations
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import Adjustment, eliminate

# Points of the tracks that are looked at.
MOST_POINTS = 2000


@dataclass(frozen=True)
class TrackMoves:
    """Derivatives of points of the fitted tracks by the values of a calibration."""

    points: Array  # (k, 3): from the reference camera, length
    slopes: Array  # (k, 3, m)

    @staticmethod
    def of(problem: Problem, states: Array, equations: NormalEquations) -> TrackMoves:
        """Return the moves of the knots (k, 2, 3) of a fit, which follow the values to first order."""
        eliminated, _ = eliminate(equations, 0.0)
        origin = problem.parameters.cameras[problem.reference].pose.center
        slopes = -eliminated[:, :-1].reshape(len(states), 2, 3, -1)[:, 0]
        chosen = np.arange(0, len(slopes), -(-len(slopes) // MOST_POINTS))
        return TrackMoves(states[chosen, 0] - origin, slopes[chosen])

    def relative_move(self, step: Array) -> float:
        """Median distance by which a step of the values (m,) moves the points, over their distance from the reference.

        What a common factor on the scene explains is left out: it is the scale, which has its own statement.
        """
        moves = self.slopes @ step
        square = float((self.points**2).sum())
        if square == 0.0:
            return 0.0
        moves = moves - float((moves * self.points).sum()) / square * self.points
        distances = np.linalg.norm(self.points, axis=1)
        return float(np.median(np.linalg.norm(moves, axis=1) / np.maximum(distances, 1e-300)))

    def relative_std(self, root: Array) -> float:
        """Root of the sum of the squared moves by the columns of a root (m, j) of a covariance of the values."""
        return float(np.linalg.norm([self.relative_move(step) for step in root.T]))


def track_moves(problem: Problem, adjustment: Adjustment) -> TrackMoves:
    """Return the moves of the tracks of a fit."""
    equations = Linearisation.of(problem).at(adjustment.values, adjustment.states)
    return TrackMoves.of(problem, adjustment.states, equations)
