"""Search of the prior for cameras under which one-camera tracks pair: several distinct pairings, the best first.

Cameras are drawn from the prior, tracks paired at the greatest total gain, and the cameras moved to where the paired
tracks meet, with a tolerance that falls (`calibration.pairing.choice`). Some wrong pairings meet nearly as well
as the right one, so all distinct pairings are kept. Pairs whose rays meet behind a camera do not count, and neither do
cameras that the prior rules out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.pairing.choice import TOLERANCES, Pairing, choose_pairs, pair_gains, refine
from stereophd.core.calibration.pairing.hypotheses import crowded, hypotheses
from stereophd.core.calibration.pairing.track_pairs import TrackPairs
from stereophd.core.calibration.pairing.track_rays import Rays, rays_of
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.two_views.epipolar import epipolar_distances, slopes_of

# Draws of a start, and those refined.
DRAWS, REFINED = 256, 8
# Draws where hypotheses of single pairs of tracks were followed (`stereophd.core.calibration.pairing.hypotheses`).
CROWDED_DRAWS = 32
# What stays at its prior mean while tracks are paired moves the rays by less than this, in units of the noise.
LATER_TOLERANCE = 8.0
# Two draws that come so near each other, in prior standard deviations, end at the same cameras.
MERGED = 0.05
# Pairings are the same if this share of the rows of the smaller one is common to both, and the cameras differ by at
# most this many standard deviations of the prior in every value.
SAME_ROWS, SAME_CAMERAS = 0.8, 0.25
# Sine of the angle between rays below which they are nearly parallel.
PARALLEL = 0.01


def coarse_columns(parameters: ParameterSet, pairs: TrackPairs, early: Booleans | None = None) -> Integers:
    """Return the values that matter for pairing, by how far one prior standard deviation moves the rays.

    A value that is free from the first stage on (`early`, all by default) matters if it moves them by more than the
    last tolerance, and any other value if it moves them by more than `LATER_TOLERANCE`.
    """
    every = np.arange(parameters.size)
    if pairs.raw is None:
        return every
    _, jacobian = slopes_of(parameters, pairs, parameters.prior_mean, np.arange(len(pairs.pair)), every)
    moved = np.sqrt(np.nanmean(np.concatenate([jacobian, np.zeros((1, parameters.size))]) ** 2, axis=0))
    return np.flatnonzero(
        moved > (TOLERANCES[-1] if early is None else np.where(early, TOLERANCES[-1], LATER_TOLERANCE))
    )


def distinct_pairings(
    parameters: ParameterSet, pairs: TrackPairs, draws: Array, early: Booleans | None = None
) -> list[Pairing]:
    """Find cameras that pair the tracks, from draws (k, m) of the prior: distinct pairings, the best first.

    None of them if nothing pairs. The values of `draws` that do not matter for pairing (`coarse_columns`) are set to
    the prior mean.
    """
    if not len(pairs.cameras):
        return []
    rows = np.arange(len(pairs.pair))

    def gains(values: Array, tolerance: float) -> Array:
        return pair_gains(pairs, epipolar_distances(parameters.build(values), pairs, rows), tolerance)

    def less_prior(values: Array, total: float) -> float:
        offset = (values - parameters.prior_mean) / parameters.prior_std
        return total - float(offset @ offset)

    columns = coarse_columns(parameters, pairs, early)
    fixed = np.setdiff1d(np.arange(parameters.size), columns)
    draws = draws.copy()
    draws[1:, fixed] = parameters.prior_mean[fixed]
    ends: list[Array] = []
    if pairs.raw is not None and crowded(pairs):
        ends += [one.values for one in hypotheses(parameters, pairs, draws[0], columns)]
    if ends:
        draws = draws[:CROWDED_DRAWS]
    first = np.array([less_prior(v, choose_pairs(pairs, gains(v, TOLERANCES[0]))[1]) for v in draws])
    passed: dict[float, list[Array]] = {tolerance: [] for tolerance in TOLERANCES}
    for k in np.argsort(-first, kind="stable")[:REFINED]:
        values = draws[k]
        for tolerance in TOLERANCES:
            chosen, _ = choose_pairs(pairs, gains(values, tolerance))
            if not len(chosen):
                break
            values = refine(parameters, pairs, values, np.flatnonzero(np.isin(pairs.pair, chosen)), tolerance, columns)
            if _near_any(values, passed[tolerance], parameters.prior_std):
                break  # an earlier draw went on from here
            passed[tolerance].append(values)
        ends.append(values)
    found: list[Pairing] = []
    for values in ends:
        in_front = np.where(behind(parameters, pairs, values), 0.0, gains(values, TOLERANCES[-1]))
        chosen, total = choose_pairs(pairs, in_front)
        total = less_prior(values, total)
        if total > 0.0 and parameters.prior_disagreement(values) is None:
            found.append(Pairing(values, chosen, total))
    found.sort(key=lambda pairing: -pairing.gain)
    kept: list[Pairing] = []
    for pairing in found:
        if not any(_same(parameters, pairs, other, pairing) for other in kept):
            kept.append(pairing)
    return kept


def _near_any(values: Array, others: list[Array], std: Array) -> bool:
    """Whether values (m,) come near any of some others."""
    return any(float((np.abs(values - other) / std).max()) < MERGED for other in others)


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


@dataclass(frozen=True)
class _Meeting:
    """Where the two rays of rows come nearest: rays (r, 2, 3) from centers (r, 2, 3), depths (r, 2) along them."""

    rays: Array
    centers: Array
    depths: Array
    times: Array
    parallax: Array
    seen: NDArray[np.bool_]


def _meeting(parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers) -> _Meeting:
    cameras = parameters.build(values)
    if pairs.raw is None:
        index = pairs.cameras[pairs.pair[rows]]
        found = Rays(
            pairs.rays[rows],
            pairs.times[rows],
            np.stack([c.pose.rotation for c in cameras])[index],
            np.stack([c.pose.center for c in cameras])[index],
            np.ones(len(rows), dtype=np.bool_),
        )
    else:
        found = rays_of(cameras, pairs.raw, pairs.entries[rows], pairs.others[rows])
    rays = np.einsum("nkij,nki->nkj", found.rotations, found.rays)
    between = found.centers[:, 1] - found.centers[:, 0]
    aa, bb = (rays[:, 0] ** 2).sum(axis=1), (rays[:, 1] ** 2).sum(axis=1)
    ab = (rays[:, 0] * rays[:, 1]).sum(axis=1)
    da, db = (rays[:, 0] * between).sum(axis=1), (rays[:, 1] * between).sum(axis=1)
    determinant = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    depths = np.stack([da * bb - db * ab, da * ab - db * aa], axis=1) / determinant[:, None]
    return _Meeting(rays, found.centers, depths, found.times, np.sqrt(determinant / (aa * bb)), found.seen)


def behind(parameters: ParameterSet, pairs: TrackPairs, values: Array) -> NDArray[np.bool_]:
    """Pairs (p,) of which most rays meet behind a camera. Rays that are nearly parallel may meet anywhere."""
    met = _meeting(parameters, pairs, values, np.arange(len(pairs.pair)))
    wrong = met.seen & (met.depths.min(axis=1) < 0.0) & (met.parallax > PARALLEL)
    count = np.bincount(pairs.pair, weights=met.seen, minlength=len(pairs.cameras))
    return np.asarray(2.0 * np.bincount(pairs.pair, weights=wrong, minlength=len(pairs.cameras)) > count)


def meeting_points(parameters: ParameterSet, pairs: TrackPairs, pairing: Pairing) -> tuple[Integers, Array, Array]:
    """Rows of the chosen pairs, their times (r,) and the points (r, 3) where their rays come nearest.

    Depths are kept positive: rays that meet behind a camera are taken where they are far apart from it instead.
    """
    rows = np.flatnonzero(np.isin(pairs.pair, pairing.chosen))
    met = _meeting(parameters, pairs, pairing.values, rows)
    distance = np.linalg.norm(met.centers[:, 1] - met.centers[:, 0], axis=1)[:, None]
    depths = np.clip(met.depths, 0.5 * distance, 100.0 * distance)
    points = met.centers + depths[:, :, None] * met.rays
    return rows[met.seen], met.times[met.seen], np.asarray(points.mean(axis=1))[met.seen]
