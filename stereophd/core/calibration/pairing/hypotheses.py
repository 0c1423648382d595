"""Cameras from hypotheses that one pair of tracks is one object, for scenes whose tracks are close together.

Draws from the prior rarely pair the corners of a board: under most of them a corner meets the neighbour of its image.
But one pair of one-camera tracks that last some seconds holds dozens of epipolar constraints along a curved path. For
two cameras every pair of their tracks is therefore taken for one object in turn, the cameras are fitted to it under the
prior, and the hypothesis is judged by how many other tracks find a partner. A pairing shifted by one corner competes
with the right one; it leaves the tracks at the edge without partners, and its offset turns with the board. The best
hypotheses of the camera pairs along a spanning tree are then fitted together.

Distances are linearised about the cameras of a start, so that a hypothesis takes milliseconds.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.pairing.choice import Pairing, choose_pairs, pair_gains
from stereophd.core.calibration.pairing.refinement import TOLERANCES, Linear, judged, settled
from stereophd.core.calibration.pairing.track_pairs import TrackPairs
from stereophd.core.calibration.unknowns.parameters import ParameterSet

# Tracks are close together if each has so many possible partners in another camera on average.
CROWDED = 7.0
# Tolerance at which hypotheses are judged in linear approximation, and those of the fits that follow.
FIRST, NEXT = TOLERANCES[1], TOLERANCES[1:]
# Hypotheses of two cameras that are refined, those of them that are combined, and combinations that are refined.
REFINED, COMBINED, MOST_COMBINATIONS = 4, 2, 3


def crowded(pairs: TrackPairs) -> bool:
    """Whether tracks have many possible partners, so that draws from the prior mostly pair them wrongly."""
    if not len(pairs.cameras):
        return False
    sides = [np.column_stack([pairs.tracks[:, side], pairs.cameras[:, 1 - side]]) for side in (0, 1)]
    return len(pairs.cameras) * 2.0 / len(np.unique(np.concatenate(sides), axis=0)) >= CROWDED


def hypotheses(parameters: ParameterSet, pairs: TrackPairs, values: Array) -> list[Pairing]:
    """Find cameras under which the tracks pair, about `values` (m,): the best of them first; none if no two pair."""
    of_cameras = {}
    for two in pairs.camera_pairs:
        pairings = _of_two(parameters, pairs, values, two)
        if pairings:
            of_cameras[two] = pairings
    tree = spanning_tree({two: pairings[0].gain for two, pairings in of_cameras.items()})
    if not tree:
        return []
    ranked = sorted(
        product(*(of_cameras[two][:COMBINED] for two in tree)), key=lambda parts: -sum(part.gain for part in parts)
    )[: 2 * MOST_COMBINATIONS]
    joint = _ranked(_joined(parameters, pairs, values, parts) for parts in ranked)[:MOST_COMBINATIONS]
    ends = settled(parameters, pairs, [pairing.values for pairing in joint], NEXT[1:])
    return _ranked(judged(parameters, pairs, end, TOLERANCES[-1]) for end in ends)


def _of_two(parameters: ParameterSet, pairs: TrackPairs, values: Array, cameras: tuple[int, int]) -> list[Pairing]:
    """Distinct hypotheses of two cameras, the best first; their pairs are numbered as in `pairs`."""
    members = np.flatnonzero((pairs.cameras == cameras).all(axis=1))
    part = pairs.take(members)
    linear = Linear.at(parameters, part, values)

    def chosen_at(offsets: Array) -> tuple[Integers, float]:
        return choose_pairs(part, pair_gains(part, linear.distances_at(offsets), FIRST))

    best: dict[bytes, tuple[float, Array]] = {}
    first_rows = np.searchsorted(part.pair, np.arange(len(members) + 1))
    for pair in range(len(members)):
        rows = np.arange(first_rows[pair], first_rows[pair + 1])
        alone = linear.take(rows)
        offsets = alone.fitted(TOLERANCES[-1], alone.fitted(FIRST, linear.offsets))
        own = replace(part, pair=part.pair[rows])
        if pair_gains(own, alone.distances_at(offsets), NEXT[1])[pair] <= 0.0:
            continue  # under the prior it is no one object
        chosen, _ = chosen_at(offsets)
        offsets = linear.take(part.rows_of(chosen)).fitted(FIRST, offsets)
        chosen, total = chosen_at(offsets)
        gain = total - float(offsets @ offsets)
        key = np.sort(chosen).tobytes()
        if len(chosen) and (key not in best or best[key][0] < gain):
            best[key] = (gain, offsets)
    first = sorted(best.values(), key=lambda entry: -entry[0])[:REFINED]
    ends = settled(parameters, part, [linear.values_of(offsets) for _, offsets in first], NEXT)
    pairings = _ranked(judged(parameters, part, end, TOLERANCES[-1]) for end in ends)
    return [Pairing(one.values, members[one.chosen], one.gain) for one in pairings]


def _ranked(pairings: Iterable[Pairing]) -> list[Pairing]:
    """Pairings of any tracks, the best first, one of each choice of pairs."""
    distinct: dict[bytes, Pairing] = {}
    for pairing in sorted(pairings, key=lambda pairing: -pairing.gain):
        if len(pairing.chosen):
            distinct.setdefault(np.sort(pairing.chosen).tobytes(), pairing)
    return list(distinct.values())


def spanning_tree(gains: Mapping[tuple[int, int], float]) -> list[tuple[int, int]]:
    """Camera pairs of a spanning tree, those of the greatest gain first."""
    group = {camera: camera for two in gains for camera in two}
    tree = []
    for two in sorted(gains, key=lambda two: -gains[two]):
        kept, merged = group[two[0]], group[two[1]]
        if kept != merged:
            tree.append(two)
            group = {camera: kept if member == merged else member for camera, member in group.items()}
    return tree


def _joined(parameters: ParameterSet, pairs: TrackPairs, values: Array, parts: Sequence[Pairing]) -> Pairing:
    """Fit all cameras to the pairs of several hypotheses and to those that follow from them, and judge the fit."""
    few = pairs.take(_following(pairs, np.concatenate([part.chosen for part in parts])))
    for tolerance in (*TOLERANCES, TOLERANCES[-1]):
        linear = Linear.at(parameters, few, values)
        values = linear.values_of(linear.fitted(tolerance, linear.offsets))
    return judged(parameters, few, values, FIRST)


def _following(pairs: TrackPairs, chosen: Integers) -> Integers:
    """Return all pairs of tracks that are one object if the chosen pairs are: with a, b and b, c also a, c."""
    group = np.arange(int(pairs.tracks.max()) + 1)
    for one, other in pairs.tracks[chosen].tolist():
        group[group == group[other]] = group[one]
    return np.flatnonzero(group[pairs.tracks[:, 0]] == group[pairs.tracks[:, 1]])
