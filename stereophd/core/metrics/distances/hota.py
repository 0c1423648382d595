"""HOTA: detection and association in one number, the mean over thresholds of similarity.

The similarity of an estimate and a true point is 1 - distance / cutoff, and 0 from the cutoff on.

References
----------
J. Luiten, A. Osep, P. Dendorfer, P. Torr, A. Geiger, L. Leal-Taixe, B. Leibe, "HOTA: A higher order metric for
evaluating multi-object tracking", International Journal of Computer Vision 129, 2021 (sections 5 and 6; the matching
prefers pairs of tracks that agree over the whole run).
"""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.metrics.matching.near_pairs import NearPairs, couples, least_cost
from stereophd.core.metrics.scans import PointSets

THRESHOLDS = np.arange(1, 20) / 20.0
ROUNDING = float(np.finfo(np.float64).eps)


class Hota(NamedTuple):
    """HOTA and its parts at each of `THRESHOLDS`, (19,), between 0 and 1."""

    hota: Array  # (19,) array: Geometric mean of detection and association
    detection: Array  # (19,) array: Pairs over pairs, missed and false points together (DetA)
    # (19,) array: Mean over pairs of the share of scans at which their track and object are paired, of those at which
    # either exists (AssA).
    association: Array
    localisation: Array  # (19,) array: Mean similarity of the pairs (LocA); 1 without pairs


def hota(estimates: PointSets, truth: PointSets, near: NearPairs) -> Hota:
    """Return HOTA from all pairs of the same scans nearer than the cutoff.

    An estimate without an identity is a track of its own.
    """
    pairs = couples(estimates, truth, near)
    object_scans, track_scans = np.bincount(pairs.object_of), np.bincount(pairs.track_of)
    similarity, number, count = 1.0 - near.ratio, pairs.number, len(pairs.objects)
    either = (object_scans[pairs.objects] + track_scans[pairs.tracks]).astype(np.float64)
    overlap = np.bincount(number, _overlap(near, similarity), count)
    chosen = least_cost(near.estimate, near.truth, (-overlap / (either - overlap))[number] * similarity, 0.0)
    similarity, number = similarity[chosen], number[chosen]
    parts = np.empty((len(THRESHOLDS), 3))
    for row, threshold in enumerate(THRESHOLDS):
        matched = similarity >= threshold - ROUNDING
        together = np.bincount(number[matched], minlength=count).astype(np.float64)
        n_matched = int(np.count_nonzero(matched))
        points = len(truth.label) + len(estimates.label)
        parts[row] = (
            n_matched / max(points - n_matched, 1),
            float((together * together / np.maximum(either - together, 1.0)).sum()) / max(n_matched, 1),
            float(similarity[matched].mean()) if n_matched else 1.0,
        )
    detection, association, localisation = parts.T
    return Hota(np.sqrt(detection * association), detection, association, localisation)


def _overlap(near: NearPairs, similarity: Array) -> Array:
    """Return the similarity of each pair over that of all pairs that share a point with it."""
    of_estimate = np.bincount(near.estimate, similarity)
    of_truth = np.bincount(near.truth, similarity)
    whole = of_estimate[near.estimate] + of_truth[near.truth] - similarity
    return np.divide(similarity, whole, out=np.zeros_like(similarity), where=whole > 0.0)
