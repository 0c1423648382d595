"""How tracks and true objects belong together over a run: identity switches, purity, completeness.

Both count the matched pairs of all scans. The dominant object of a track is the one it is matched to most
often (the smallest identity of several), and likewise the dominant track of an object.

References
----------
A. A. Gorji, R. Tharmarasa, T. Kirubarajan, "Performance measures for multiple target tracking problems",
FUSION 2011 (purity, completeness, fragmentation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.errors import UNLABELLED


@dataclass(frozen=True)
class TrackTable:
    """Figures of each track, arrays (t,) in order of identity."""

    track_id: Integers  # (t,) array: Identity
    # `n_estimates`, `n_matched`: (t,) arrays: Number of its estimates, and of those that are matched to an object.
    n_estimates: Integers
    n_matched: Integers
    object_id: Integers  # (t,) array: Its dominant object; without meaning where nothing is matched
    n_dominant: Integers  # (t,) array: Number of its estimates that are matched to that object

    @property
    def purity(self) -> Array:
        """Share of the estimates that are matched to the dominant object, (t,); 0 for a false track."""
        return self.n_dominant / self.n_estimates


@dataclass(frozen=True)
class ObjectTable:
    """How each true object was followed, arrays (o,) in order of identity."""

    object_id: Integers  # (o,) array: Identity
    # `n_scans`, `n_matched`: (o,) arrays: Number of scans at which it exists, and of those at which any estimate is
    # matched to it.
    n_scans: Integers
    n_matched: Integers
    track_id: Integers  # (o,) array: Its dominant track; without meaning where no track is matched
    n_dominant: Integers  # (o,) array: Number of scans at which that track is matched to it
    # (o,) array: Number of tracks that are matched to it at some scan: its fragmentation, 1 if followed well.
    n_tracks: Integers

    @property
    def completeness(self) -> Array:
        """Share of the scans at which any estimate is matched, (o,)."""
        return self.n_matched / self.n_scans

    @property
    def completeness_dominant(self) -> Array:
        """Share of the scans at which the dominant track is matched, (o,)."""
        return self.n_dominant / self.n_scans


def tabulate_tracks(label: Integers, pair_track: Integers, pair_object: Integers) -> TrackTable:
    """Return what each track did, from the labels (n,) of estimates and the tracks and objects (q,) of matched pairs.

    Unlabelled estimates (negative) are left out.
    """
    tracks, n_estimates = np.unique(label[label > UNLABELLED], return_counts=True)
    labelled = pair_track > UNLABELLED
    owner = np.searchsorted(tracks, pair_track[labelled])
    partner, most, _ = _dominant(owner, pair_object[labelled], len(tracks))
    n_matched = np.bincount(owner, minlength=len(tracks)).astype(np.int64)
    return TrackTable(tracks, n_estimates, n_matched, partner, most)


def tabulate_objects(object_id: Integers, pair_track: Integers, pair_object: Integers) -> ObjectTable:
    """Return how each true object was followed, from the objects (n,) of true points and those (q,) of matched pairs.

    At most one pair for an object and scan. Unlabelled tracks (negative) count for `ObjectTable.n_matched` only.
    """
    objects, n_scans = np.unique(object_id, return_counts=True)
    owner = np.searchsorted(objects, pair_object)
    labelled = pair_track > UNLABELLED
    partner, most, partners = _dominant(owner[labelled], pair_track[labelled], len(objects))
    n_matched = np.bincount(owner, minlength=len(objects)).astype(np.int64)
    return ObjectTable(objects, n_scans, n_matched, partner, most, partners)


def _dominant(owner: Integers, partner: Integers, owners: int) -> tuple[Integers, Integers, Integers]:
    """Return the most frequent partner of each owner, how often it is, and the number of partners."""
    names, number = np.unique(partner, return_inverse=True)
    couple, times = np.unique(owner * max(len(names), 1) + number, return_counts=True)
    who, whom = np.divmod(couple, max(len(names), 1))
    # The last of each owner is its most frequent partner, of equals the smallest.
    order = np.lexsort((-whom, times, who))
    dominant, most = np.full(owners, UNLABELLED, dtype=np.int64), np.zeros(owners, dtype=np.int64)
    last = order[np.append(np.diff(who[order]) > 0, True)] if len(order) else order
    dominant[who[last]], most[who[last]] = names[whom[last]], times[last]
    return dominant, most, np.bincount(who, minlength=owners).astype(np.int64)


def identity_switches(scan: Integers, object_id: Integers, track_id: Integers) -> NDArray[np.bool_]:
    """Mark the matched pairs at which a true object is matched to another track than the time before.

    Scan (in time order), object and track are those of each matched pair (n,). Pairs whose track is unlabelled
    (negative) neither are nor cause a switch, and scans at which the object is not matched in between do not matter.
    """
    switched = np.zeros(len(scan), dtype=bool)
    labelled = np.flatnonzero(track_id > UNLABELLED)
    order = labelled[np.lexsort((scan[labelled], object_id[labelled]))]
    same_object = object_id[order[1:]] == object_id[order[:-1]]
    switched[order[1:]] = same_object & (track_id[order[1:]] != track_id[order[:-1]])
    return switched
