"""Whether the stretches of a log agree with one another as well as their noise allows, and how uncertain they leave it.

The gradient of the posterior is a sum over detections and links of trajectories, which a right model makes independent:
with the trajectories following the values, the scores s_b of the stretches b of a log then have the covariance H of the
information that the log holds, and the answer moves by C s_b with a stretch. A model that is wrong (a lens, a clock, a
motion, a noise, an association) leaves residuals that stay alike within a stretch and differ between stretches. The
covariance of the answer is then C (sum s_b s_b^T) C, whatever the model says (P. J. Huber, 1967; H. White, "Maximum
likelihood estimation of misspecified models", 1982). A fitted trajectory pulls at the two stretches that it passes in
opposite directions: the products s_b s_b+1^T of neighbours are added, which takes that off (W. K. Newey and K. D. West,
1987). The sum is known from few stretches: in units of C, its eigenvalues spread up to (1 + sqrt(d / B))^2 with d
directions that the data determine and B stretches (V. A. Marchenko and L. A. Pastur, 1967), three products for each
stretch as if they were a third as many. Only directions beyond that are widened. Errors may stay alike for longer than
a stretch, so that stretches are joined and looked at again.
"""

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.marginal import MarginalPosterior, Point, at_answer
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import Adjustment
from stereophd.core.calibration.adjustment.trajectories import OF_ALL
from stereophd.core.calibration.unknowns.scale import log_scale
from stereophd.core.numerics.covariance_factors import covariance_factor

# Stretches of a log; how many of them are joined, one after the other; part of the largest eigenvalue of chance from
# which a direction is widened.
STRETCHES, JOINED, BEYOND_CHANCE = 64, (1, 2, 4), 1.5


def disagreement_of_stretches(problem: Problem, adjustment: Adjustment) -> tuple[Array, float, float]:
    """Return the covariance (m, m) that disagreeing stretches add to that of a fit, and by how much they widen most.

    These are two factors of standard deviations, 1 where stretches agree: along any direction of all unknowns, with the
    noise of the motion, and along any direction of the values alone.
    """
    size, (posterior, point) = problem.parameters.size, at_answer(problem, adjustment)
    covariance, prior_std = posterior.covariance(point), posterior.prior_std
    scores = _scores(posterior, point)
    determined = max(float((1.0 - np.diag(covariance) / prior_std**2).sum()), 1.0)
    # detections do not show the scale: the score of a stretch along it depends only on how its knots are counted
    _, by_scale = log_scale(problem.parameters, problem.reference, adjustment.values)
    with_scale = covariance[:, :size] @ by_scale
    of_scale = max(float(by_scale @ with_scale[:size]), 1e-300)
    root = covariance_factor(covariance - np.outer(with_scale, with_scale) / of_scale)
    widened = widening((scores - scores.mean(axis=0)) @ root, determined)
    more = root @ (widened @ widened.T - np.eye(len(root))) @ root.T
    of_all, of_values = (float(np.linalg.norm(rows, 2)) for rows in (widened, widened[:size]))  # the root is triangular
    return np.asarray((more + more.T)[:size, :size] / 2.0, dtype=np.float64), of_all, of_values


def widening(scores: Array, determined: float) -> Array:
    """Return the root (m, m) of the covariance of an answer of unit covariance, whose stretches have scores (b, m)."""
    root = np.eye(scores.shape[1])
    for joined in JOINED:
        count = len(scores) // joined
        sums = scores[: count * joined].reshape(count, joined, -1).sum(axis=1)
        beside = sums[1:].T @ sums[:-1]
        eigenvalues, vectors = np.linalg.eigh((sums.T @ sums + beside + beside.T) * count / (count - 1.0))
        chance = (1.0 + np.sqrt(3.0 * determined / count)) ** 2
        stds = np.sqrt(np.where(eigenvalues > BEYOND_CHANCE * chance, eigenvalues, 1.0))
        root = root + root @ (vectors * (stds - 1.0)) @ vectors.T
        scores = scores + scores @ (vectors * (1.0 / stds - 1.0)) @ vectors.T
    return root


def _scores(posterior: MarginalPosterior, point: Point) -> Array:
    """Scores (b, u) of the stretches of a log, each of as many detections, by all unknowns."""
    linearisation, volume = posterior.linearisation, posterior.slopes(point)
    problem, observations = linearisation.problem, linearisation.problem.observations
    unknowns, states = len(point.unknowns), point.states
    values, noise = posterior.parted(point.unknowns)
    following = point.eliminated.following().reshape(len(states), 2, 3, unknowns)
    path, seen, pulls = point.seen.placement.path, point.seen, linearisation.pulls(point.seen)
    direct = -volume.by_value(linearisation, -pulls)
    of_point = np.einsum("nra,nr->na", seen.by_point, pulls) - volume.by_point
    ends = np.quantile(observations.times, np.linspace(0.0, 1.0, STRETCHES + 1))[1:-1]
    scores, after = np.zeros((STRETCHES, unknowns)), np.minimum(path.knot + 1, len(states) - 1)
    rows_of = np.searchsorted(ends, observations.times)
    for stretch in range(STRETCHES):
        rows = np.flatnonzero(rows_of == stretch)
        for place, (knot, moved) in enumerate((k, j) for k in (path.knot, after) for j in (0, 1)):
            pull = path.weights[rows, place, None] * of_point[rows]
            scores[stretch] += np.einsum("na,nau->u", pull, following[knot[rows], moved])
    for columns, here in zip(linearisation.columns, linearisation.members, strict=True):
        used = columns >= 0
        np.add.at(scores, (rows_of[here][:, None], columns[used]), direct[here][:, used])
    links, knots = linearisation.motion.links, problem.knots
    if not len(links.knot):
        return scores
    motion = linearisation.noise_at(values, noise)
    both = np.concatenate([states[links.knot], states[links.knot + 1]], axis=1)
    moved = links.precisions @ both
    forces = -(moved - links.pull) @ motion.precision
    across = np.swapaxes(both, 1, 2) @ (moved - links.pull)
    products = across - np.swapaxes(links.pull, 1, 2) @ both + links.energy
    by_noise = -motion.by_unknowns(products) - volume.by_noise - 6.0 * OF_ALL
    # one that passes several stretches belongs to each for the part of its time
    begin, end = knots.times[links.knot], knots.times[links.knot + 1]
    edges = np.concatenate([[-np.inf], ends, [np.inf]])[:, None]
    passed = np.maximum(np.minimum(end, edges[1:]) - np.maximum(begin, edges[:-1]), 0.0) / (end - begin)
    _, by_scale = log_scale(problem.parameters, problem.reference, values)
    for stretch, parts in enumerate(passed):
        rows = np.flatnonzero(parts)
        total, forced = parts[rows] @ by_noise[rows], parts[rows, None, None] * forces[rows]
        pulled = np.concatenate([following[links.knot[rows]], following[links.knot[rows] + 1]], axis=1)
        scores[stretch] += np.einsum("lja,ljau->u", forced, pulled) + np.append(total[0] * by_scale, total)
    return scores
