"""Association marginals and evidence by loopy belief propagation (Williams and Lau 2014).

Tracks i and detections j are tied by the weights psi_ij of "i made j" against "i was missed and j is new
or clutter". Messages along the pairs converge to approximate marginals; the Bethe value of the fixed point
approximates the sum over all associations,

    Z = prod_i (1 + sum_j psi_ij nu_ji) prod_j (1 + sum_i mu_ij) / prod_ij (1 + mu_ij nu_ji),

exactly so where the pairs form no loop, and it is a smooth function of the weights.

Reference: J. L. Williams and R. A. Lau, "Approximate evaluation of marginal association probabilities with
belief propagation", IEEE Trans. AES 50 (4), 2014; P. O. Vontobel, "The Bethe permanent of a nonnegative
matrix", IEEE Trans. IT 59 (3), 2013.
"""

import math

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.compilation.compiled import compiled

# Messages may be as small as the odds are large: their relative change decides. On trees two or three sweeps do,
# on dense loops about fifteen.
TOLERANCE = 1e-9
MAX_SWEEPS = 200
# Of tens of thousands of pairs fewer, but at least `LEAST_SWEEPS`: the work of an event is bounded.
MOST_MESSAGES = 4_000_000
LEAST_SWEEPS = 10


@compiled
def propagate_beliefs(
    tracks: Integers, detections: Integers, odds: Array, n_tracks: int, n_detections: int
) -> tuple[Array, Array, Array, float]:
    """Marginal association probabilities of sparse pairs (p,) of tracks and detections with odds ``psi_ij`` (p,).

    Returns the probability of each pair (p,), that a track made no detection (n_tracks,), that no track made a
    detection (n_detections,), and the logarithm of the Bethe value Z.
    """
    count = len(tracks)
    to_detection = odds.copy()
    to_track = np.ones(count)
    per_track = np.zeros(n_tracks)
    per_detection = np.zeros(n_detections)
    for p in range(count):
        per_track[tracks[p]] += odds[p]
    for _ in range(min(MAX_SWEEPS, max(MOST_MESSAGES // max(count, 1), LEAST_SWEEPS))):
        per_detection[:] = 0.0
        for p in range(count):
            others = per_track[tracks[p]] - odds[p] * to_track[p]
            to_detection[p] = odds[p] / (1.0 + max(others, 0.0))
            per_detection[detections[p]] += to_detection[p]
        settled = True
        per_track[:] = 0.0
        for p in range(count):
            others = per_detection[detections[p]] - to_detection[p]
            message = 1.0 / (1.0 + max(others, 0.0))
            settled &= abs(message - to_track[p]) < TOLERANCE * message
            to_track[p] = message
            per_track[tracks[p]] += odds[p] * message
        if settled:
            break
    log_evidence = 0.0
    pair = np.empty(count)
    for p in range(count):
        pair[p] = odds[p] * to_track[p] / (1.0 + per_track[tracks[p]])
        log_evidence -= math.log1p(to_detection[p] * to_track[p])
    missed = np.empty(n_tracks)
    for i in range(n_tracks):
        missed[i] = 1.0 / (1.0 + per_track[i])
        log_evidence += math.log1p(per_track[i])
    unclaimed = np.empty(n_detections)
    for j in range(n_detections):
        unclaimed[j] = 1.0 / (1.0 + per_detection[j])
        log_evidence += math.log1p(per_detection[j])
    return pair, missed, unclaimed, log_evidence
