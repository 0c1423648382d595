"""Association problems that the tests share, and their exact solution by enumeration."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from stereophd.core.multi.association.belief import propagate_beliefs

Array = np.ndarray


@dataclass(frozen=True)
class Marginals:
    """Solution of an association problem, the pairs as a matrix (n_tracks, n_detections)."""

    pair: Array
    missed: Array
    unclaimed: Array
    log_evidence: float


def enumerate_associations(odds: Array) -> Marginals:
    """Sum over all associations of the products of their odds, a matrix with 0 for "no pair"."""
    n_tracks, n_detections = odds.shape
    pair, missed, unclaimed, evidence = np.zeros_like(odds), np.zeros(n_tracks), np.zeros(n_detections), 0.0
    choices = [[None, *np.flatnonzero(row)] for row in odds]
    for choice in product(*choices):
        claimed = [j for j in choice if j is not None]
        if len(set(claimed)) < len(claimed):
            continue
        weight = float(np.prod([odds[i, j] for i, j in enumerate(choice) if j is not None]))
        evidence += weight
        for i, j in enumerate(choice):
            if j is None:
                missed[i] += weight
            else:
                pair[i, j] += weight
        for j in set(range(n_detections)) - set(claimed):
            unclaimed[j] += weight
    return Marginals(pair / evidence, missed / evidence, unclaimed / evidence, float(np.log(evidence)))


def propagate(odds: Array) -> Marginals:
    """The package's answer, from a matrix with 0 for "no pair"."""
    tracks, detections = np.array(np.nonzero(odds))
    pair, missed, unclaimed, log_evidence = propagate_beliefs(tracks, detections, odds[tracks, detections], *odds.shape)
    dense = np.zeros_like(odds)
    dense[tracks, detections] = pair
    return Marginals(dense, missed, unclaimed, log_evidence)


def worst(found: Marginals, expected: Marginals) -> float:
    """Largest absolute difference of any marginal."""
    return max(
        float(np.abs(getattr(found, name) - getattr(expected, name)).max(initial=0.0))
        for name in ("pair", "missed", "unclaimed")
    )


def random_tree(rng: np.random.Generator, n_tracks: int, n_detections: int, low: float, high: float) -> Array:
    """Odds (powers of ten between low and high) of pairs that form no loop."""
    odds = np.zeros((n_tracks, n_detections))
    group = list(range(n_tracks + n_detections))
    for index in rng.permutation(n_tracks * n_detections):
        i, j = divmod(int(index), n_detections)
        a, b = group[i], group[n_tracks + j]
        if a != b and rng.random() < 0.8:
            group = [a if g == b else g for g in group]
            odds[i, j] = 10.0 ** rng.uniform(low, high)
    return odds
