"""What is stated as known, tested by the data: evidence for freeing it, and how far the answer would move.

All values are free in the enlarged set of `calibration.unknowns.held`; what the calibration holds lies at its stated
value there, where the gradient g of the objective (minus the logarithm of the posterior) need not vanish. With the
precision H of all values, the trajectories integrated out, freeing the group G beside the free values F changes the
logarithm of the marginal evidence by (Laplace's method)

    1/2 g_FG^T H_FG^-1 g_FG - 1/2 g_F^T H_F^-1 g_F - 1/2 (log det H_FG - log det H_F) - sum log std_G,

and G moves to its part of -H_FG^-1 g_FG. A group that the data do not see changes it by nothing. This is the score test
(C. R. Rao, 1948) with the volume of the prior. The free values move with G by D = -H_F^-1 H_FG. With the probability p
that the statement is wrong (prior odds and evidence, one statement at most), G is uncertain by p (S_G + h h^T), h the
value that fits and S_G its covariance. The answer is uncertain by the same through D (J. A. Hoeting et al., "Bayesian
model averaging", 1999): evidence that is too weak to contradict a statement still widens what rests on it. What this
moves is also measured on the tracks (a principal point and a rotation make up for each other): where tracks move by
more than the stated covariance H_F^-1 of the free values moves them, the statement matters.
"""

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.marginal import at_answer
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import Adjustment
from stereophd.core.calibration.adjustment.track_moves import TrackMoves
from stereophd.core.calibration.unknowns.held import EnlargedSet, HeldGroup
from stereophd.core.calibration.unknowns.quantities.base import IMAGES
from stereophd.core.numerics.covariance_factors import covariance_factor

# Logarithm of the odds, after the data, from which a statement is contradicted; images that nobody measured are as
# stated from the same odds on, of even ones before.
LOG_ODDS = float(np.log(100.0))
# Least move of tracks that is compared with, in parts of their distance.
LEAST_STATED = 1e-4


@dataclass(frozen=True)
class Suspicion:
    """A configured value, and the evidence of the data against it."""

    group: HeldGroup
    # `values`, `stds`: arrays (k,): Offsets from what is stated that fit, and their posterior standard deviations.
    values: Array
    stds: Array
    log_evidence: float  # For freeing the group.
    gain: float  # Part of it that residuals have: it falls with their square where errors are larger.
    # How far tracks move for one standard deviation of the group, and by all that it leaves uncertain, over how far
    # they move for one of the answer as stated.
    moves: float
    expected_move: float
    spread: Array  # (m, k): Root of the covariance that it adds to that of all values of the answer.

    @property
    def is_contradicted(self) -> bool:
        """Whether the data contradict the statement."""
        return self.is_contradicted_at(1.0)

    @property
    def is_unknown(self) -> bool:
        """Whether it is contradicted or, of images that nobody measured, not shown to be right."""
        return self.is_contradicted or (self.group.quantity == IMAGES and self.log_evidence > -LOG_ODDS)

    def is_contradicted_at(self, widening: float) -> bool:
        """Whether they do where the errors that stretches of a log have in common are so many times as large."""
        evidence = self.log_evidence - self.gain * (1.0 - widening**-2) + len(self.values) * np.log(widening)
        return bool(evidence + np.log(self.group.odds) > LOG_ODDS)


@dataclass(frozen=True)
class QuadraticPosterior:
    """Gradient (m,) and precision (m, m) of minus the logarithm of a posterior of values, and the moves of tracks."""

    gradient: Array
    precision: Array
    tracks: TrackMoves


def quadratic_posterior(problem: Problem, enlarged: EnlargedSet, adjustment: Adjustment) -> QuadraticPosterior:
    """Return the posterior of everything about a fit, in units of the prior standard deviations."""
    parameters = enlarged.parameters
    values = np.append(adjustment.values, np.zeros(parameters.size - len(adjustment.values)))
    of_all = replace(problem, parameters=parameters)
    posterior, point = at_answer(of_all, replace(adjustment, values=values))
    precision = np.asarray(np.linalg.inv(posterior.covariance(point)), dtype=np.float64)
    std = posterior.prior_std
    tracks = TrackMoves.of(problem, adjustment.values, adjustment.states, point.equations)
    tracks = replace(tracks, slopes=tracks.slopes * std, scale=tracks.scale * std)
    return QuadraticPosterior(
        posterior.gradient(point) * std, (precision + precision.T) / 2.0 * np.outer(std, std), tracks
    )


def suspect(quadratic: QuadraticPosterior, enlarged: EnlargedSet, free: Integers) -> list[Suspicion]:
    """Test every group; those of the greatest evidence first.

    The posterior is that of all values, and after them of what else is unknown (the noise of the motion); `free` has
    the places of the values that the fit had free.
    """
    size, std = enlarged.parameters.size, enlarged.parameters.prior_std
    free = np.concatenate([free, np.arange(size, len(quadratic.gradient))])
    gain, volume, _ = _optimum(quadratic, free)
    precision = quadratic.precision
    stated = quadratic.tracks.relative_std(_spread(precision, free, np.empty(0, np.int64), np.empty((0, 0))))
    tested = [_optimum(quadratic, np.append(free, group.places)) for group in enlarged.groups]
    evidences = [gain_of_both - gain - (both - volume) for gain_of_both, both, _ in tested]
    log_odds = np.array([e + np.log(group.odds) for e, group in zip(evidences, enlarged.groups, strict=True)])
    probabilities = np.exp(log_odds - np.logaddexp.reduce(np.append(log_odds, 0.0)))
    suspicions = []
    for group, log_evidence, (of_both, _, step), probability in zip(
        enlarged.groups, evidences, tested, probabilities.tolist(), strict=True
    ):
        both = np.append(free, group.places)
        inverse = np.asarray(np.linalg.inv(precision[np.ix_(both, both)]), dtype=np.float64)
        covariance, values = inverse[len(free) :, len(free) :], step[len(free) :]
        # where other statements are far more doubtful the probability is too small for a covariance of its own
        spreads = [
            part * _spread(precision, free, group.places, spread)
            for part, spread in ((1.0, covariance), (np.sqrt(probability), covariance + np.outer(values, values)))
        ]
        moves = [quadratic.tracks.relative_std(spread) / max(stated, LEAST_STATED) for spread in spreads]
        added = spreads[1][:size] * std[:, None]
        suspicions.append(
            Suspicion(
                group, values * std[group.places], np.sqrt(np.diag(covariance)) * std[group.places], log_evidence,
                of_both - gain, moves[0], moves[1], added,
            )
        )  # fmt: skip
    return sorted(suspicions, key=lambda suspicion: -suspicion.log_evidence)


def _spread(precision: Array, free: Integers, places: Integers, covariance: Array) -> Array:
    """Root (m, j) of the covariance of all values: of the free ones themselves, or as they follow those at `places`."""
    if not len(places):
        root = np.zeros((len(precision), len(free)))
        root[free] = covariance_factor(np.asarray(np.linalg.inv(precision[np.ix_(free, free)]), dtype=np.float64))
        return root
    root = np.zeros((len(precision), len(places)))
    root[places] = covariance_factor(covariance)
    root[free] = -np.linalg.solve(precision[np.ix_(free, free)], precision[np.ix_(free, places)]) @ root[places]
    return root


def _optimum(quadratic: QuadraticPosterior, places: Integers) -> tuple[float, float, Array]:
    """Gain of the exponent, half the log-determinant of the precision, and the step, with only some values free."""
    precision, gradient = quadratic.precision[np.ix_(places, places)], quadratic.gradient[places]
    step = np.asarray(-np.linalg.solve(precision, gradient), dtype=np.float64)
    return -0.5 * float(gradient @ step), 0.5 * float(np.linalg.slogdet(precision)[1]), step
