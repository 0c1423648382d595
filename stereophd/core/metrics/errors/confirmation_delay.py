"""How long objects wait until they are confirmed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.errors.consistency import UNLABELLED
from stereophd.core.metrics.scans import PointSets, ScanScores


@dataclass(frozen=True)
class FirstReports:
    """When each track was first reported, confirmed or tentative: rising identities and times, arrays (t,)."""

    track_id: Integers
    time_s: Array

    def of(self, track_id: Integers, otherwise: Array) -> Array:
        """Return the times of some tracks (n,), and `otherwise` for those without an identity."""
        if len(self.track_id) == 0:
            return otherwise
        place = np.minimum(np.searchsorted(self.track_id, track_id), len(self.track_id) - 1)
        return np.where(self.track_id[place] == track_id, self.time_s[place], otherwise)


def first_reports(track_id: Integers, time_s: Array) -> FirstReports:
    """Return the first report of each track, from identities (n,) and times of estimates in order of time."""
    tracks, row = np.unique(track_id, return_index=True)
    known = tracks > UNLABELLED
    return FirstReports(tracks[known], time_s[row[known]])


@dataclass(frozen=True)
class Waits:
    """Waiting times of true objects from their first scored scan on."""

    # (n,) array: Until a confirmed estimate is paired with the object, s; of the objects to which this happens.
    confirmed_s: Array
    reported_s: Array  # (n,) array: Until the track of that estimate is first reported, confirmed or tentative, s
    never: int  # Number of the other objects


def waits(time_s: Array, estimates: PointSets, truth: PointSets, scores: ScanScores, reports: FirstReports) -> Waits:
    """Return how long the objects of the scored scans at times (k,) waited; an unknown status counts as confirmed."""
    labels, target = np.unique(truth.label, return_inverse=True)
    if len(labels) == 0:
        return Waits(np.zeros(0), np.zeros(0), 0)
    appears = np.full(len(labels), np.inf)
    np.minimum.at(appears, target, time_s[truth.scan])
    pairs = np.arange(len(scores.pair_scan))
    if estimates.confirmed is not None:
        pairs = pairs[estimates.confirmed[scores.pair_estimate]]
    # Pairs are in order of scan.
    tracked, first = np.unique(target[scores.pair_truth[pairs]], return_index=True)
    first = pairs[first]
    confirmed = time_s[scores.pair_scan[first]]
    reported = reports.of(estimates.label[scores.pair_estimate[first]], confirmed)
    start = appears[tracked]
    never = len(labels) - len(tracked)
    return Waits(confirmed - start, np.clip(reported - start, 0.0, confirmed - start), never)
