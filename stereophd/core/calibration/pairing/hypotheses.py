"""Cameras from hypotheses that one pair of tracks is one object, for scenes whose tracks are close together.

Draws from the prior rarely pair the corners of a board: under most of them a corner meets the neighbour of its image.
But one pair of one-camera tracks that last some seconds holds dozens of epipolar constraints along a curved path. For
two cameras every pair of their tracks is therefore taken for one object in turn, the cameras are fitted to it under the
prior, and the hypothesis is judged by how many other tracks find a partner. A pairing shifted by one corner competes
with the right one; it leaves the tracks at the edge without partners, and its offset turns with the board. The best
hypotheses of the camera pairs along a spanning tree are then fitted together.

Distances are linearised about the cameras of a start, so that a hypothesis takes milliseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.pairing.choice import TOLERANCES, Pairing, choose_pairs, pair_gains
from stereophd.core.calibration.pairing.track_pairs import TrackPairs
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.two_views.epipolar import epipolar_distances, slopes_of

# Tracks are close together if each has so many possible partners in another camera on average.
CROWDED = 7.0
# Tolerance at which hypotheses are judged in linear approximation, and those of the fits that follow.
FIRST, NEXT = TOLERANCES[1], TOLERANCES[1:]
# Hypotheses of two cameras that are refined, those of them that are combined, and combinations that are refined.
REFINED, COMBINED, MOST_COMBINATIONS = 4, 2, 3
# Reweighted steps of a linear fit.
STEPS = 3


@dataclass(frozen=True)
class _Linear:
    """Distances of all rows of the pairs, linear in some of the values.

    `offsets` are those values at which it was linearised, in prior standard deviations from the prior mean; unknown
    distances are zero, and marked in `missing`.
    """

    parameters: ParameterSet
    pairs: TrackPairs
    values: Array
    columns: Integers
    offsets: Array
    distances: Array
    jacobian: Array
    missing: Booleans

    @staticmethod
    def at(parameters: ParameterSet, pairs: TrackPairs, values: Array, columns: Integers) -> _Linear:
        distances, jacobian = slopes_of(parameters, pairs, values, np.arange(len(pairs.pair)), columns)
        missing = ~(np.isfinite(distances) & np.isfinite(jacobian).all(axis=1))
        distances, jacobian = np.where(missing, 0.0, distances), np.where(missing[:, None], 0.0, jacobian)
        offsets = ((values - parameters.prior_mean) / parameters.prior_std)[columns]
        return _Linear(parameters, pairs, values, columns, offsets, distances, jacobian, missing)

    def chosen(self, offsets: Array, tolerance: float) -> tuple[Integers, float]:
        """Pair the tracks at the cameras of offsets; return the pairs and their gain."""
        distances = self.distances + self.jacobian @ (offsets - self.offsets)
        return choose_pairs(self.pairs, pair_gains(self.pairs, np.where(self.missing, np.nan, distances), tolerance))

    def fitted(self, chosen: Sequence[int] | Integers, tolerance: float, offsets: Array) -> Array:
        """Offsets at which pairs meet, with the prior and Cauchy weights."""
        rows = np.flatnonzero(np.isin(self.pairs.pair, chosen))
        jacobian = self.jacobian[rows] / tolerance
        for _ in range(STEPS):
            distances = self.distances[rows] / tolerance + jacobian @ (offsets - self.offsets)
            weights = 1.0 / (1.0 + distances**2)
            matrix = jacobian.T @ (weights[:, None] * jacobian) + np.eye(len(offsets))
            offsets = offsets - np.linalg.solve(matrix, jacobian.T @ (weights * distances) + offsets)
        return offsets

    def values_of(self, offsets: Array) -> Array:
        values = self.values.copy()
        parameters, columns = self.parameters, self.columns
        values[columns] = parameters.prior_mean[columns] + offsets * parameters.prior_std[columns]
        return values


def crowded(pairs: TrackPairs) -> bool:
    """Whether tracks have many possible partners, so that draws from the prior mostly pair them wrongly."""
    if not len(pairs.cameras):
        return False
    sides = [np.column_stack([pairs.tracks[:, side], pairs.cameras[:, 1 - side]]) for side in (0, 1)]
    return len(pairs.cameras) * 2.0 / len(np.unique(np.concatenate(sides), axis=0)) >= CROWDED


def hypotheses(parameters: ParameterSet, pairs: TrackPairs, values: Array, columns: Integers) -> list[Pairing]:
    """Find cameras under which the tracks pair, about `values` (m,): the best of them first.

    `columns` are the values that matter for pairing. The list is empty if no two cameras pair.
    """
    of_cameras = {}
    for two in pairs.camera_pairs:
        found = _of_two(parameters, pairs, values, columns, two)
        if found:
            of_cameras[two] = found
    trees = _spanning(of_cameras)
    if not trees:
        return []
    ranked = sorted(
        product(*(of_cameras[two][:COMBINED] for two in trees)), key=lambda parts: -sum(one.gain for one in parts)
    )[: 2 * MOST_COMBINATIONS]
    joint = [_joined(parameters, pairs, values, columns, parts) for parts in ranked]
    joint = sorted(joint, key=lambda one: -one.gain)[:MOST_COMBINATIONS]
    settled = [_settled(parameters, pairs, one.values, columns, (NEXT[1], *NEXT[1:])) for one in joint]
    return sorted((one for one in settled if one is not None), key=lambda one: -one.gain)


def _of_two(
    parameters: ParameterSet, pairs: TrackPairs, values: Array, columns: Integers, cameras: tuple[int, int]
) -> list[Pairing]:
    """Distinct hypotheses of two cameras, the best first; their pairs are numbered as in `pairs`."""
    members = np.flatnonzero((pairs.cameras == cameras).all(axis=1))
    part = pairs.take(members)
    names = {parameters.cameras[number].name for number in cameras}
    own = np.array([k for k in columns.tolist() if names & set(parameters.parameters[k].cameras)], dtype=np.int64)
    linear = _Linear.at(parameters, part, values, own)
    found: dict[bytes, tuple[float, Array]] = {}
    for pair in range(len(members)):
        offsets = linear.fitted([pair], TOLERANCES[-1], linear.fitted([pair], FIRST, linear.offsets))
        chosen, _ = linear.chosen(offsets, FIRST)
        offsets = linear.fitted(chosen, FIRST, offsets)
        chosen, total = linear.chosen(offsets, FIRST)
        gain = total - float(offsets @ offsets)
        key = np.sort(chosen).tobytes()
        if len(chosen) and (key not in found or found[key][0] < gain):
            found[key] = (gain, offsets)
    out: dict[bytes, Pairing] = {}
    for key, (_, offsets) in sorted(found.items(), key=lambda one: -one[1][0])[:REFINED]:
        if key in out:
            continue  # another hypothesis ended there
        settled = _settled(parameters, part, linear.values_of(offsets), own, NEXT)
        if settled is not None:
            out.setdefault(np.sort(settled.chosen).tobytes(), settled)
    whole = [Pairing(one.values, members[one.chosen], one.gain) for one in out.values()]
    return sorted(whole, key=lambda one: -one.gain)


def _spanning(found: dict[tuple[int, int], list[Pairing]]) -> list[tuple[int, int]]:
    """Camera pairs of a spanning tree, those of the greatest gain first."""
    group = {camera: camera for two in found for camera in two}
    tree = []
    for two in sorted(found, key=lambda two: -found[two][0].gain):
        one, other = group[two[0]], group[two[1]]
        if one != other:
            tree.append(two)
            group = {camera: one if member == other else member for camera, member in group.items()}
    return tree


def _joined(
    parameters: ParameterSet, pairs: TrackPairs, values: Array, columns: Integers, parts: Sequence[Pairing]
) -> Pairing:
    """Fit all cameras to the pairs of several hypotheses and to those that follow from them, and judge the fit."""
    few = pairs.take(_following(pairs, np.concatenate([part.chosen for part in parts])))
    every = np.arange(len(few.cameras))
    for tolerance in (*TOLERANCES, TOLERANCES[-1]):
        linear = _Linear.at(parameters, few, values, columns)
        values = linear.values_of(linear.fitted(every, tolerance, linear.offsets))
    return _judged(parameters, few, values, FIRST)


def _following(pairs: TrackPairs, chosen: Integers) -> Integers:
    """Return all pairs of tracks that are one object if the chosen pairs are: with a, b and b, c also a, c."""
    group = np.arange(int(pairs.tracks.max()) + 1)
    for one, other in pairs.tracks[chosen].tolist():
        group[group == group[other]] = group[one]
    return np.flatnonzero(group[pairs.tracks[:, 0]] == group[pairs.tracks[:, 1]])


def _settled(
    parameters: ParameterSet, pairs: TrackPairs, values: Array, columns: Integers, tolerances: Sequence[float]
) -> Pairing | None:
    """Pair and fit in turns, with a tolerance that falls; None where nothing pairs."""
    for tolerance in tolerances:
        linear = _Linear.at(parameters, pairs, values, columns)
        offsets = linear.offsets
        for _ in range(2):
            chosen, _ = linear.chosen(offsets, tolerance)
            if not len(chosen):
                return None
            offsets = linear.fitted(chosen, tolerance, offsets)
        values = linear.values_of(offsets)
    found = _judged(parameters, pairs, values, tolerances[-1])
    return found if len(found.chosen) else None


def _judged(parameters: ParameterSet, pairs: TrackPairs, values: Array, tolerance: float) -> Pairing:
    distances = epipolar_distances(parameters.build(values), pairs, np.arange(len(pairs.pair)))
    chosen, total = choose_pairs(pairs, pair_gains(pairs, distances, tolerance))
    offsets = (values - parameters.prior_mean) / parameters.prior_std
    return Pairing(values, chosen, total - float(offsets @ offsets))
