"""Hypotheses of the tracks of bodies, and their reduction after an event."""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.bodies.occlusion import exclusive_existence
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.multi.filter_settings.pmb import PmbSettings

# Most hypotheses of one track, from one instant to the next and while an instant is open.
MOST_HYPOTHESES, MOST_OPEN = 5, 10
# Part of `least_share` for hypotheses of false objects: a box that fits a body well leaves them little at first.
FALSE_SHARE = 0.01
# Probability of a body, as part of that of a false object, below which no evidence drives it.
LEAST_BODY = 0.01


class Hypotheses(NamedTuple):
    """Gaussians of the tracks, in order of track, the heaviest of each first."""

    owners: Integers  # (n,): Tracks, numbered from 0
    weights: Array  # (n,): Those of a track add up to its probability of existence
    means: Array  # (n, 8)
    covariances: Array  # (n, 8, 8)
    # (n, c): Box of the last frame of each camera of the open instant, -1 for none, and the factor by which the other
    # tracks' claims on that box reduce the weight
    boxes: Integers
    factors: Array
    views: Integers  # (n,): The only camera of a false object, which goes on to make boxes there; -1: a body

    @staticmethod
    def undecided(
        owners: Integers, weights: Array, means: Array, covariances: Array, views: Integers, n_cameras: int
    ) -> "Hypotheses":
        """Return hypotheses before an instant."""
        shape = (len(owners), n_cameras)
        return Hypotheses(owners, weights, means, covariances, np.full(shape, -1), np.ones(shape), views)

    def existence(self, n_tracks: int) -> Array:
        """Return the probability (t,) that each track is a body."""
        bodies = self.views < 0
        return np.asarray(np.bincount(self.owners[bodies], self.weights[bodies], n_tracks).astype(np.float64))

    def bodies(self, n_tracks: int) -> tuple[Array, Array, Array]:
        """Return the probability (t,) that each track is a body, and the mean and the covariance of that body."""
        chosen = np.flatnonzero(self.views < 0)
        return moments(
            self.owners[chosen], self.weights[chosen], self.means[chosen], self.covariances[chosen], n_tracks
        )

    def take(self, kept: Integers | Booleans) -> "Hypotheses":
        """Return some of the hypotheses."""
        return Hypotheses._make(values[kept] for values in self)

    def first(self) -> Integers:
        """Return the heaviest hypothesis of each track."""
        return np.flatnonzero(np.append(True, np.diff(self.owners) != 0)[: len(self.owners)])


def reduce_hypotheses(
    hypotheses: Hypotheses, reported: Booleans, settings: PmbSettings, up: Array
) -> tuple[Hypotheses, Integers]:
    """Drop and bound the hypotheses of tracks, and let the tracks exclude each other.

    The hypotheses are in any order; `reported` (t,) is True for tracks that have been reported, and `up` (3,) is the
    axis of the bodies. Returns the hypotheses of the tracks that are kept, numbered anew, and those tracks.
    """
    owners, weights, n_tracks = hypotheses.owners, hypotheses.weights, len(reported)
    existence = np.bincount(owners, weights, n_tracks).astype(np.float64)
    is_body = hypotheses.views < 0
    kept = weights > settings.least_share * np.where(is_body, 1.0, FALSE_SHARE) * existence[owners]
    # what one camera goes on to see may be a body that the others miss for a reason that lasts
    best = np.zeros(n_tracks)
    np.maximum.at(best, owners[is_body], weights[is_body])
    kept |= is_body & (weights == best[owners]) & (weights > 0.0)
    kept &= existence[owners] >= settings.prune_weight
    hypotheses = hypotheses.take(kept)
    hypotheses = hypotheses.take(np.lexsort((-hypotheses.weights, hypotheses.owners)))
    first = hypotheses.first()
    ranks = np.arange(len(hypotheses.owners)) - np.repeat(first, np.diff(np.append(first, len(hypotheses.owners))))
    hypotheses = hypotheses.take(ranks < MOST_OPEN)
    # what was dropped belongs to the hypotheses that stay
    totals = np.bincount(hypotheses.owners, hypotheses.weights, n_tracks)
    weights = hypotheses.weights * (existence / np.maximum(totals, 1e-300))[hypotheses.owners]
    hypotheses = hypotheses._replace(weights=weights)
    first = hypotheses.first()
    tracks = hypotheses.owners[first]
    bodies = hypotheses.existence(n_tracks)
    exclusive = exclusive_existence(
        bodies[tracks], hypotheses.means[first], hypotheses.covariances[first], reported[tracks], up
    )
    scales = np.ones((2, n_tracks))
    false = np.maximum(existence - bodies, 0.0)[tracks]
    least = np.where(bodies[tracks] > 0.0, LEAST_BODY * false, 0.0)
    scales[0, tracks] = np.maximum(exclusive, least) / np.maximum(bodies[tracks], 1e-300)
    scales[1, tracks] = 1.0 - np.maximum(least - exclusive, 0.0) / np.maximum(false, 1e-300)
    weights = weights * scales[(hypotheses.views >= 0).astype(np.int64), hypotheses.owners]
    existence = np.bincount(hypotheses.owners, weights, n_tracks).astype(np.float64)
    tracks = tracks[existence[tracks] >= settings.prune_weight]
    if settings.max_components is not None and len(tracks) > settings.max_components:
        tracks = np.sort(tracks[np.argsort(-existence[tracks], kind="stable")[: settings.max_components]])
    number = np.full(n_tracks, -1)
    number[tracks] = np.arange(len(tracks))
    reduced = hypotheses._replace(owners=number[hypotheses.owners], weights=weights)
    return reduced.take(reduced.owners >= 0), tracks


def merged(hypotheses: Hypotheses, distance: float) -> Hypotheses:
    """Merge hypotheses of a track that are close in both covariances, round by round with the heaviest that is left.

    The instant of their boxes has ended: the merged hypotheses are undecided.
    """
    n_cameras = hypotheses.boxes.shape[1]
    # bodies and false objects stay apart
    kinds = hypotheses.owners * (n_cameras + 1) + hypotheses.views
    hypotheses, kinds = hypotheses.take(order := np.lexsort((-hypotheses.weights, kinds))), kinds[order]
    owners, weights, means, covariances, _, _, views = hypotheses
    inverses = np.linalg.inv(covariances)
    if not len(owners):
        return hypotheses
    group, rest = np.full(len(owners), -1), np.arange(len(owners))
    for _ in range(MOST_HYPOTHESES):
        first = np.append(True, np.diff(kinds[rest]) != 0)[: len(rest)]
        leader = rest[first][np.cumsum(first) - 1]
        off = means[rest] - means[leader]
        there = np.einsum("ni,nij,nj->n", off, inverses[rest], off)
        back = np.einsum("ni,nij,nj->n", off, inverses[leader], off)
        near = (np.maximum(there, back) < distance) | (rest == leader)
        group[rest[near]] = leader[near]
        rest = rest[~near]
        if not len(rest):
            break
    kept = np.flatnonzero(group >= 0)
    leaders, number = np.unique(group[kept], return_inverse=True)
    totals, joint, spread = moments(number, weights[kept], means[kept], covariances[kept], len(leaders))
    joined = Hypotheses.undecided(owners[leaders], totals, joint, spread, views[leaders], n_cameras)
    return joined.take(np.lexsort((-joined.weights, joined.owners)))


def moments(
    groups: Integers, weights: Array, means: Array, covariances: Array, n_groups: int
) -> tuple[Array, Array, Array]:
    """Return weight (g,), mean (g, 8) and covariance (g, 8, 8) of mixtures, from the group of each Gaussian."""
    order = np.argsort(groups, kind="stable")
    present, starts = np.unique(groups[order], return_index=True)

    def summed(values: Array) -> Array:
        sums = np.zeros((n_groups, *values.shape[1:]))
        sums[present] = np.add.reduceat(values[order], starts) if len(starts) else 0.0
        return sums

    totals = summed(weights)
    shares = weights / np.maximum(totals, 1e-300)[groups]
    joint = summed(shares[:, None] * means)
    off = means - joint[groups]
    return totals, joint, summed(shares[:, None, None] * (covariances + off[:, :, None] * off[:, None, :]))


def reassociate(hypotheses: Hypotheses, camera: int, n_tracks: int, n_boxes: int) -> Hypotheses:
    """Decide anew which tracks made the boxes of one camera of the open instant, given what the others say now.

    The factors of the other cameras are kept: rounds over the cameras are expectation propagation between the
    associations of frames, each of which is exact.
    """
    owners, columns = hypotheses.owners, hypotheses.boxes[:, camera]
    weights = hypotheses.weights / hypotheses.factors[:, camera]
    rest = np.maximum(1.0 - np.bincount(owners, hypotheses.weights, n_tracks), 1e-12)
    detected = np.flatnonzero(columns >= 0)
    free = rest + np.bincount(owners, np.where(columns < 0, weights, 0.0), n_tracks)
    keys, inverse = np.unique(owners[detected] * n_boxes + columns[detected], return_inverse=True)
    tracks = keys // n_boxes
    odds = np.bincount(inverse, weights[detected], len(keys)) / free[tracks]
    taken, missing, _, _ = association_marginals(tracks, keys % n_boxes, odds, n_tracks, n_boxes)
    factors = hypotheses.factors.copy()
    factors[detected, camera] = box_factors(taken, missing[tracks], odds)[inverse]
    weights = weights * factors[:, camera] * (missing / free)[owners]
    return hypotheses._replace(weights=weights, factors=factors)


def box_factors(taken: Array, missing: Array, odds: Array) -> Array:
    """Return the factors (k,) by which claims of others reduce the odds of pairs of tracks and boxes."""
    return np.asarray(np.clip(taken / np.maximum(missing * odds, 1e-300), 1e-12, 1.0))
