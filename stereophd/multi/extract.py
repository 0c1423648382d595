"""Which components are reported as objects: thresholds with hysteresis, one estimate per label."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.multi.intensity import UNLABELLED, GaussianMixture


@dataclass(frozen=True)
class Hysteresis:
    """Thresholds of reporting.

    Attributes
    ----------
    confirm : float
        A label is reported from this weight (PHD) or existence on.
    release : float
        A reported label stays reported until its weight or existence falls below this.
    """

    confirm: float
    release: float


@dataclass(frozen=True)
class Selection:
    """Outcome of `select_objects`: the relabelled mixture, and which components are reported."""

    mixture: GaussianMixture
    index: NDArray[np.intp]
    existence: NDArray[np.float64]
    next_label: int
    next_track: int


def select_objects(
    mixture: GaussianMixture, hysteresis: Hysteresis, next_label: int, next_track: int, split: bool = True
) -> Selection:
    """Choose the components that are reported, and give identities in order of confirmation.

    The components of a label are alternatives for one object: their weights add up, and the heaviest
    gives the estimate. A further component of a label that alone reaches the confirmation threshold is
    another object (two objects were merged while they were close), and gets a label of its own.

    Parameters
    ----------
    mixture : GaussianMixture
        After an event.
    hysteresis : Hysteresis
        Thresholds.
    next_label, next_track : int
        First unused label and identity.
    split : bool
        Whether a label may stand for several objects: in a PHD it may; hypotheses of one track exclude
        each other.

    Returns
    -------
    Selection
    """
    labels = mixture.labels.copy()
    order = np.lexsort((-mixture.weights, labels))
    order = order[labels[order] != UNLABELLED]
    first = np.ones(len(order), dtype=bool)
    first[1:] = labels[order][1:] != labels[order][:-1]
    apart = order[~first & (mixture.weights[order] >= hysteresis.confirm)] if split else order[:0]
    if len(apart):
        labels[apart] = next_label + np.arange(len(apart))
        next_label += len(apart)
        tracks, reported = mixture.tracks.copy(), mixture.reported.copy()
        tracks[apart], reported[apart] = -1, False
        mixture = replace(mixture, labels=labels, tracks=tracks, reported=reported)
        order = np.lexsort((-mixture.weights, labels))
        order = order[labels[order] != UNLABELLED]
        first[1:] = labels[order][1:] != labels[order][:-1]
    if len(order) == 0:
        return Selection(mixture, np.empty(0, dtype=np.intp), np.empty(0), next_label, next_track)

    group = np.cumsum(first) - 1
    leaders = order[first]
    totals = np.asarray(np.bincount(group, weights=mixture.weights[order]), dtype=np.float64)
    # any part of a label may carry its identity: the heaviest may come from a merged newborn
    tracks = np.maximum.reduceat(mixture.tracks[order], np.flatnonzero(first))
    was_reported = np.logical_or.reduceat(mixture.reported[order], np.flatnonzero(first))
    shown = totals >= np.where(was_reported, hysteresis.release, hysteresis.confirm)
    fresh = np.flatnonzero(shown & (tracks < 0))
    tracks[fresh] = next_track + np.arange(len(fresh))

    new_tracks, new_reported = np.full_like(mixture.tracks, UNLABELLED), np.zeros_like(mixture.reported)
    new_tracks[order], new_reported[order] = tracks[group], shown[group]
    mixture = replace(mixture, tracks=new_tracks, reported=new_reported)
    return Selection(mixture, leaders[shown], totals[shown], next_label, next_track + len(fresh))
