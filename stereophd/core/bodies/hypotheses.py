"""Hypotheses of the tracks of bodies, and their reduction after an event."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.bodies.occlusion import exclusive_existence
from stereophd.core.bodies.outline import STATE_SIZE
from stereophd.core.multi.filter_settings.pmb import PmbSettings

# Most hypotheses of one track.
MOST_HYPOTHESES = 5


class Hypotheses(NamedTuple):
    """Gaussians of the tracks, in order of track, the heaviest of each first."""

    owners: Integers  # (n,): Tracks, numbered from 0
    weights: Array  # (n,): Those of a track add up to its probability of existence
    means: Array  # (n, 8)
    covariances: Array  # (n, 8, 8)

    @staticmethod
    def none() -> Hypotheses:
        """Return no hypotheses."""
        size = STATE_SIZE
        return Hypotheses(np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, size)), np.empty((0, size, size)))

    def take(self, kept: Integers | Booleans) -> Hypotheses:
        """Return some of the hypotheses."""
        return Hypotheses(self.owners[kept], self.weights[kept], self.means[kept], self.covariances[kept])

    def first(self) -> Integers:
        """Return the heaviest hypothesis of each track."""
        return np.flatnonzero(np.append(True, np.diff(self.owners) != 0)[: len(self.owners)])


def reduce_hypotheses(
    hypotheses: Hypotheses, reported: Booleans, settings: PmbSettings, up: Array
) -> tuple[Hypotheses, Integers]:
    """Drop, merge and bound the hypotheses of tracks, and let the tracks exclude each other.

    The hypotheses are in any order; `reported` (t,) says whether each track has been reported, and `up` (3,) is the
    axis of the bodies. Returns the hypotheses of the tracks that are kept, numbered anew, and those tracks.
    """
    owners, weights, n_tracks = hypotheses.owners, hypotheses.weights, len(reported)
    existence = np.bincount(owners, weights, n_tracks).astype(np.float64)
    kept = weights > np.maximum(settings.least_share * existence[owners], 0.0)
    kept &= existence[owners] >= settings.prune_weight
    hypotheses = hypotheses.take(kept)
    hypotheses = hypotheses.take(np.lexsort((-hypotheses.weights, hypotheses.owners)))
    if (np.diff(hypotheses.owners) == 0).any():
        hypotheses = _merged(hypotheses, settings.hypothesis_distance)
    # what was dropped belongs to the hypotheses that stay
    totals = np.bincount(hypotheses.owners, hypotheses.weights, n_tracks)
    first = hypotheses.first()
    tracks = hypotheses.owners[first]
    exclusive = exclusive_existence(
        existence[tracks], hypotheses.means[first], hypotheses.covariances[first], reported[tracks], up
    )
    existence[tracks] = exclusive
    weights = hypotheses.weights * existence[hypotheses.owners] / np.maximum(totals[hypotheses.owners], 1e-300)
    tracks = tracks[exclusive >= settings.prune_weight]
    if settings.max_components is not None and len(tracks) > settings.max_components:
        tracks = np.sort(tracks[np.argsort(-existence[tracks], kind="stable")[: settings.max_components]])
    number = np.full(n_tracks, -1)
    number[tracks] = np.arange(len(tracks))
    owners = number[hypotheses.owners]
    reduced = Hypotheses(owners, weights, hypotheses.means, hypotheses.covariances)
    return reduced.take(owners >= 0), tracks


def _merged(hypotheses: Hypotheses, distance: float) -> Hypotheses:
    """Merge hypotheses of a track that are close in both covariances, round by round with the heaviest that is left."""
    owners, weights, means, covariances = hypotheses
    inverses = np.linalg.inv(covariances)
    group, rest = np.full(len(owners), -1), np.arange(len(owners))
    for _ in range(MOST_HYPOTHESES):
        first = np.append(True, np.diff(owners[rest]) != 0)
        leader = rest[first][np.cumsum(first) - 1]
        off = means[rest] - means[leader]
        there = np.einsum("ni,nij,nj->n", off, inverses[rest], off)
        back = np.einsum("ni,nij,nj->n", off, inverses[leader], off)
        near = (np.maximum(there, back) < distance) | (rest == leader)
        group[rest[near]] = leader[near]
        rest = rest[~near]
        if not len(rest):
            break
    order = np.argsort(group, kind="stable")
    order = order[group[order] >= 0]
    starts = np.flatnonzero(np.append(True, np.diff(group[order]) != 0))
    number = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
    totals = np.add.reduceat(weights[order], starts)
    share = weights[order] / totals[number]
    joint = np.add.reduceat(share[:, None] * means[order], starts)
    off = means[order] - joint[number]
    spread = covariances[order] + off[:, :, None] * off[:, None, :]
    joined = Hypotheses(owners[order[starts]], totals, joint, np.add.reduceat(share[:, None, None] * spread, starts))
    return joined.take(np.lexsort((-joined.weights, joined.owners)))
