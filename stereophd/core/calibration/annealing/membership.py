"""Which detections belong to fitted trajectories: those that the fit without them predicts.

A detection that the fit knows with the weight w, of noise R, leaves the residual r; the fit predicts its pixel with the
covariance H, trajectories and cameras unknown. Without it the residual is K^-1 r, K = I - w H R^-1, and has the
covariance R + K^-1 H (R. D. Cook, 1977). A gate of the noise alone keeps what agrees with cameras that are a little
wrong, and rejects what would correct them: they stay wrong, and are sure of it. The density of the prediction is
compared with that of clutter: along a wide prediction a detection that fits tells nothing.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.linearisation import Linearisation, factor_knots
from stereophd.core.calibration.adjustment.problem import Observations, Problem
from stereophd.core.calibration.adjustment.recording import Scans
from stereophd.core.calibration.adjustment.solver import Adjustment, Eliminated, within_prior
from stereophd.core.calibration.adjustment.trajectories import straying
from stereophd.core.calibration.adjustment.volume import inverse_in_band, summed_covariances

# Squared distance from its prediction within which a detection belongs to a trajectory: 0.1 % of a normal distribution
# in the plane lies beyond. Squared distance in its noise alone within which it is looked at.
GATE, WIDE_GATE = 13.8, 1e4
# Of a detection that the fit follows whatever it is, this part of the residual is taken to be left.
LEAST_LEFT = 1e-6


@dataclass(frozen=True)
class Predictions:
    """The uncertainty of a fit: of its knots at given values, and of the values."""

    problem: Problem  # Weighted as the fit is
    adjustment: Adjustment
    inverse: Array  # (12, 6 k): Covariance of the knots within the band
    following: Array  # (6 k, m): How the knots follow the values
    covariance: Array  # (m, m): Of the values, all of them free, whatever the fit has held

    @classmethod
    def of(cls, problem: Problem, adjustment: Adjustment) -> Self:
        """Prepare a fit, the solution of a problem."""
        weighted = problem.weighted(problem.weights(adjustment.distances))
        equations = Linearisation.of(weighted).at(adjustment.values, adjustment.states)
        factor = factor_knots(equations.bands)
        inverse = np.zeros_like(factor)
        inverse_in_band(factor, inverse)
        eliminated = Eliminated.of(equations, factor)
        covariance = within_prior(eliminated.schur, problem.parameters.prior_std)
        return cls(weighted, adjustment, inverse, eliminated.following(), covariance)

    def judged(self, seen: Observations, weights: Array) -> tuple[Array, Array]:
        """Squared distances (n,) of detections from their predictions without them, and the log of the densities there.

        `weights` (n,) are those that the fit gives them as members of the trajectories that they are given to; 0 where
        they are none.
        """
        knots = self.problem.knots
        linearisation = Linearisation.of(replace(self.problem, observations=seen))
        now = linearisation.residuals(self.adjustment.values, self.adjustment.states)
        path = now.placement.path
        spread = np.zeros((len(seen), 3, 3))
        summed_covariances(self.inverse, path.knot, path.weights[:, :, None] * path.weights[:, None, :], spread)
        noise = linearisation.noise_at(self.adjustment.values).std
        astray = straying(knots, seen.trajectories, seen.times)[:, None, None] * np.diag(noise**2)
        total = np.zeros((len(seen), 2, len(self.adjustment.values)))
        for place in range(12):
            rows = np.minimum(6 * path.knot + place, len(self.following) - 1)
            part = path.weights[:, place // 3, None] * now.by_point[:, :, place % 3]
            total += part[:, :, None] * self.following[rows][:, None, :]
        for columns, here in zip(linearisation.columns, linearisation.members, strict=True):
            used = columns >= 0
            total[np.ix_(here, np.arange(2), columns[used])] += now.by_value[here][:, :, used]
        predicted = now.by_point @ spread @ now.by_point.swapaxes(1, 2)
        predicted += total @ self.covariance @ total.swapaxes(1, 2)
        left = (1.0 + LEAST_LEFT) * np.eye(2) - weights[:, None, None] * (predicted @ seen.precisions)
        covariance = np.linalg.inv(seen.precisions) + np.linalg.solve(left, predicted)
        covariance += now.by_point @ astray @ now.by_point.swapaxes(1, 2)
        # rounding makes what is far too uncertain in one direction singular: it is taken to be so in both
        singular = np.linalg.det(covariance) == 0.0
        covariance[singular] = np.trace(covariance[singular], axis1=1, axis2=2)[:, None, None] * np.eye(2)
        residual = np.linalg.solve(left, now.errors[:, :, None])
        distance = (residual * np.linalg.solve(covariance, residual)).sum(axis=(1, 2))
        distance = np.where(now.visible & (distance >= 0.0), distance, np.inf)
        determinant = np.maximum(np.linalg.det(2.0 * np.pi * covariance), 1e-300)
        return distance, -0.5 * (distance + np.log(determinant))


def chosen_detections(
    problem: Problem, adjustment: Adjustment, members: Integers, scans: Scans, padding: float
) -> tuple[Integers, Integers]:
    """Give the trajectories of a fit their detections, those with the most so far first.

    A piece of a track that another trajectory explains better is thus left without detections. `members` are the
    detections of the recording that the fit knows; a trajectory goes on for the time `padding`, s, before its first and
    after its last one. Returns trajectories (n,) and detections (n,) of the scans, sorted by trajectory and time.
    """
    recording, cameras = scans.recording, problem.parameters.build(adjustment.values)
    predictions, known = Predictions.of(problem, adjustment), problem.observations.trajectories
    clutter = [c.detector.expected_clutter / (c.width * c.height * c.detector.p_detect) for c in cameras]
    weights, least = problem.weights(adjustment.distances), np.log(clutter)
    owner = np.full(len(scans.points), -1)
    for j in np.argsort(-np.bincount(known, minlength=problem.knots.count), kind="stable"):
        start, end = problem.knots.spans[j]
        times = scans.detection_times
        near = np.flatnonzero((owner < 0) & (times >= start - padding) & (times <= end + padding))
        seen = recording.observations(cameras, np.full(len(near), j), scans.source[near])
        now = Linearisation.of(replace(problem, observations=seen)).residuals(
            adjustment.values, adjustment.states, by_values=False
        )
        distance = np.einsum("ni,nij,nj->n", now.errors, seen.precisions, now.errors)
        looked_at = np.flatnonzero(now.visible & (distance < WIDE_GATE))
        near, seen = near[looked_at], seen.take(looked_at)
        weight = np.zeros(len(recording.pixels))
        weight[members[known == j]] = weights[known == j]
        distance, density = predictions.judged(seen, weight[scans.source[near]])
        chosen = np.flatnonzero((distance < GATE) & (density > least[seen.cameras]))
        # the nearest of each event
        chosen = chosen[np.lexsort((distance[chosen], scans.event_of[near[chosen]]))]
        _, nearest = np.unique(scans.event_of[near[chosen]], return_index=True)
        owner[near[chosen[nearest]]] = j
    detections = np.flatnonzero(owner >= 0)
    order = np.lexsort((detections, owner[detections]))
    return owner[detections[order]], detections[order]
