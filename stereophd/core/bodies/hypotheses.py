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
    hypotheses: Hypotheses, n_tracks: int, settings: PmbSettings, up: Array
) -> tuple[Hypotheses, Integers]:
    """Drop, merge and bound the hypotheses of tracks, and let the tracks exclude each other.

    Parameters
    ----------
    hypotheses : Hypotheses
        In any order.
    n_tracks : int
    settings : PmbSettings
    up : array (3,)
        Axis of the bodies.

    Returns
    -------
    Hypotheses
        Of the tracks that are kept, numbered anew.
    array (t,) of int
        Those tracks.
    """
    owners, weights = hypotheses.owners, hypotheses.weights
    existence = np.bincount(owners, weights, n_tracks).astype(np.float64)
    kept = weights > np.maximum(settings.least_share * existence[owners], 0.0)
    kept &= existence[owners] >= settings.prune_weight
    hypotheses = hypotheses.take(kept)
    hypotheses = hypotheses.take(np.lexsort((-hypotheses.weights, hypotheses.owners)))
    several = np.flatnonzero(np.bincount(hypotheses.owners, minlength=n_tracks) > 1)
    if len(several):
        hypotheses = _merged(hypotheses, several, settings.hypothesis_distance)
    # what was dropped belongs to the hypotheses that stay
    totals = np.bincount(hypotheses.owners, hypotheses.weights, n_tracks)
    first = hypotheses.first()
    tracks = hypotheses.owners[first]
    exclusive = exclusive_existence(existence[tracks], hypotheses.means[first], hypotheses.covariances[first], up)
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


def _merged(hypotheses: Hypotheses, tracks: Integers, distance: float) -> Hypotheses:
    """Merge hypotheses of the tracks that are close in both covariances, and keep the heaviest."""
    out = [hypotheses.take(~np.isin(hypotheses.owners, tracks))]
    bounds = np.searchsorted(hypotheses.owners, np.stack([tracks, tracks + 1]))
    for start, end in bounds.T.tolist():
        out.append(_merged_track(hypotheses.take(np.arange(start, end)), distance))
    joined = Hypotheses(*(np.concatenate(values) for values in zip(*out, strict=True)))
    return joined.take(np.lexsort((-joined.weights, joined.owners)))


def _merged_track(track: Hypotheses, distance: float) -> Hypotheses:
    """Merge the hypotheses of one track, the heaviest first."""
    rest, groups = np.arange(len(track.weights)), list[Integers]()
    inverses = np.linalg.inv(track.covariances)
    while len(rest) and len(groups) < MOST_HYPOTHESES:
        off = track.means[rest] - track.means[rest[0]]
        there = np.einsum("ni,nij,nj->n", off, inverses[rest], off)
        back = np.einsum("ni,ij,nj->n", off, inverses[rest[0]], off)
        near = np.maximum(there, back) < distance
        near[0] = True
        groups.append(rest[near])
        rest = rest[~near]
    weights = np.array([track.weights[group].sum() for group in groups])
    means, covariances = np.empty((len(groups), STATE_SIZE)), np.empty((len(groups), STATE_SIZE, STATE_SIZE))
    for k, group in enumerate(groups):
        share = track.weights[group] / weights[k]
        means[k] = share @ track.means[group]
        off = track.means[group] - means[k]
        covariances[k] = np.einsum("n,nij->ij", share, track.covariances[group] + off[:, :, None] * off[:, None, :])
    return Hypotheses(track.owners[: len(groups)], weights, means, covariances)
