"""Search of the prior for cameras under which one-camera tracks pair: several distinct pairings, the best first.

What one camera sees of an object can be tracked without knowing where any other camera is. Whether the tracks a and b
of two cameras may be one object depends on the cameras alone: at every common time the two rays must meet. Cameras are
drawn from the prior, in crowded scenes also taken from single pairs of tracks (`calibration.pairing.hypotheses`). Then
tracks are paired at the greatest total gain, and the cameras moved to where the paired tracks meet
(`calibration.pairing.refinement`). Some wrong pairings meet nearly as well as the right one, so all distinct pairings
are kept. Pairs whose rays meet behind a camera do not count, and neither do cameras that the prior rules out.
"""

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.pairing.choice import Pairing, choose_pairs
from stereophd.core.calibration.pairing.hypotheses import crowded, hypotheses
from stereophd.core.calibration.pairing.refinement import TOLERANCES, gains_at, judged, less_prior, settled
from stereophd.core.calibration.pairing.track_pairs import TrackPairs
from stereophd.core.calibration.unknowns.parameters import ParameterSet

# Draws of a start, and those refined.
DRAWS, REFINED = 256, 8
# Draws where hypotheses of single pairs of tracks were followed.
CROWDED_DRAWS = 32
# Pairings are the same if this share of the rows of the smaller one is common to both, and the cameras differ by at
# most this many standard deviations of the prior in every value.
SAME_ROWS, SAME_CAMERAS = 0.8, 0.25


def distinct_pairings(parameters: ParameterSet, pairs: TrackPairs, draws: Array) -> list[Pairing]:
    """Find cameras that pair the tracks, from draws (k, m) of the prior: distinct pairings, the best first.

    None of them if nothing pairs.
    """
    if not len(pairs.cameras):
        return []
    ends: list[Array] = []
    if crowded(pairs):
        ends += [pairing.values for pairing in hypotheses(parameters, pairs, draws[0])]
    if ends:
        draws = draws[:CROWDED_DRAWS]
    gains = [
        less_prior(parameters, values, choose_pairs(pairs, gains_at(parameters, pairs, values, TOLERANCES[0]))[1])
        for values in draws
    ]
    first = [draws[k] for k in np.argsort(-np.array(gains), kind="stable")[:REFINED]]
    ends += settled(parameters, pairs, first, TOLERANCES)
    pairings = [
        pairing
        for pairing in (judged(parameters, pairs, values, TOLERANCES[-1]) for values in ends)
        if pairing.gain > 0.0 and parameters.prior_disagreement(pairing.values) is None
    ]
    kept: list[Pairing] = []
    for pairing in sorted(pairings, key=lambda pairing: -pairing.gain):
        if not any(_same(parameters, pairs, other, pairing) for other in kept):
            kept.append(pairing)
    return kept


def _same(parameters: ParameterSet, pairs: TrackPairs, one: Pairing, other: Pairing) -> bool:
    """Whether two pairings are of the same tracks, at about the same cameras.

    Where more than poses is unknown the tracks decide: lenses and rates of clocks differ from draw to draw.
    """
    size = np.bincount(pairs.pair, minlength=len(pairs.cameras))
    common = size[np.intersect1d(one.chosen, other.chosen)].sum()
    if common < SAME_ROWS * min(size[one.chosen].sum(), size[other.chosen].sum()):
        return False
    if not parameters.only_moves:
        return True
    return bool((np.abs(one.values - other.values) <= SAME_CAMERAS * parameters.prior_std).all())


def paired_objects(pairs: TrackPairs, pairing: Pairing, tracks: int) -> Integers:
    """Object of every track (tracks,), numbered from 0; -1 of those that are not paired."""
    leader = np.arange(tracks)
    for a, b in pairs.tracks[pairing.chosen].tolist():
        leader[leader == leader[b]] = leader[a]
    paired = np.isin(np.arange(tracks), pairs.tracks[pairing.chosen])
    objects = np.full(tracks, -1)
    objects[paired] = np.unique(leader[paired], return_inverse=True)[1]
    return objects
