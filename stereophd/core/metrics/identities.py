"""Purity of the tracks of a run, completeness of its objects, and IDF1.

IDF1 is the share of points with the right identity when each object is given at most one track for the whole run
(E. Ristani, F. Solera, R. Zou, R. Cucchiara, C. Tomasi, "Performance measures and a data set for multi-target,
multi-camera tracking", ECCV Workshops 2016, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.metrics.errors import UNLABELLED
from stereophd.core.metrics.matching.assignment import optimal_assignment
from stereophd.core.metrics.matching.identity import ObjectTable, TrackTable, tabulate_objects, tabulate_tracks
from stereophd.core.metrics.matching.near_pairs import Couples, NearPairs, couples
from stereophd.core.metrics.scans import PointSets, ScanScores

# An object is mostly tracked if it is matched in at least this share of its scans, and mostly lost below the rest.
MOSTLY = 0.8


def has_identities(estimates: PointSets) -> bool:
    """Return whether estimates carry identities; true without estimates."""
    return len(estimates.label) == 0 or bool((estimates.label > UNLABELLED).any())


def identity_figures(
    estimates: PointSets, truth: PointSets, scores: ScanScores, switched: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return the tables ``purity`` and ``completeness`` of the report, with their means, as a JSON-able dict.

    `switched` (q,) marks the matched pairs whose object has changed its track. Values are NaN where there is nothing to
    average, None where the estimates carry no identities.
    """
    pair_track, pair_object = estimates.label[scores.pair_estimate], truth.label[scores.pair_truth]
    tracks = tabulate_tracks(estimates.label, pair_track, pair_object)
    objects = tabulate_objects(truth.label, pair_track, pair_object)
    owner = np.searchsorted(objects.object_id, pair_object[switched])
    switches = np.bincount(owner, minlength=len(objects.object_id)).tolist()
    known = has_identities(estimates)
    return {
        "purity": {"mean": _mean(tracks.purity), "table": _track_rows(tracks)},
        "completeness": {
            "mean": _mean(objects.completeness),
            "mean_dominant": _mean(objects.completeness_dominant) if known else float("nan"),
            "fragmentation": _mean(objects.n_tracks) if known else float("nan"),
            "table": _object_rows(objects, switches, known),
        },
    }


def clear_mot_figures(
    estimates: PointSets, truth: PointSets, scores: ScanScores, switched: NDArray[np.bool_], distance: Array
) -> dict[str, Any]:
    """Return the figures of CLEAR MOT (Bernardin and Stiefelhagen, 2008) from the distance (q,) of each matched pair.

    ``mota``: 1 less the share of misses, false estimates and switches in all true points; ``motp``: mean distance of
    the matched pairs; how many objects are matched in at least `MOSTLY` of their scans, and in less than the rest. NaN
    without true points, None without identities. The other arguments are those of `identity_figures`.
    """
    matched, points = len(scores.pair_scan), len(truth.label)
    if not has_identities(estimates):
        return {"mota": None, "motp": _mean(distance), "mostly_tracked": None, "mostly_lost": None}
    wrong = points + len(estimates.label) - 2 * matched + int(switched.sum())
    number = np.unique(truth.label, return_inverse=True)[1]
    share = np.bincount(number[scores.pair_truth], minlength=number.max(initial=-1) + 1) / np.bincount(number)
    return {
        "mota": 1.0 - wrong / points if points else float("nan"),
        "motp": _mean(distance),
        "mostly_tracked": int((share >= MOSTLY).sum()),
        "mostly_lost": int((share < 1.0 - MOSTLY).sum()),
    }


def _track_rows(tracks: TrackTable) -> list[dict[str, Any]]:
    return [
        {
            "track_id": track,
            "object_id": dominant if most else None,
            "estimates": estimates,
            "matched": matched,
            "matched_dominant": most,
            "purity": purity,
        }
        for track, dominant, estimates, matched, most, purity in zip(
            tracks.track_id.tolist(),
            tracks.object_id.tolist(),
            tracks.n_estimates.tolist(),
            tracks.n_matched.tolist(),
            tracks.n_dominant.tolist(),
            tracks.purity.tolist(),
            strict=True,
        )
    ]


def _object_rows(objects: ObjectTable, switches: list[int], known: bool) -> list[dict[str, Any]]:
    rows = zip(
        objects.object_id.tolist(),
        objects.track_id.tolist(),
        objects.n_scans.tolist(),
        objects.n_matched.tolist(),
        objects.n_dominant.tolist(),
        objects.completeness.tolist(),
        objects.completeness_dominant.tolist(),
        objects.n_tracks.tolist(),
        switches,
        strict=True,
    )
    return [
        {
            "object_id": target,
            "track_id": dominant if most else None,
            "scans": scans,
            "matched": matched,
            "matched_dominant": most if known else None,
            "completeness": any_track,
            "completeness_dominant": one_track if known else None,
            "fragmentation": tracks if known else None,
            "identity_switches": changes if known else None,
        }
        for target, dominant, scans, matched, most, any_track, one_track, tracks, changes in rows
    ]


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else float("nan")


@dataclass(frozen=True)
class IdentityScore:
    """IDF1 and its two parts, between 0 and 1; NaN where there is nothing to divide by."""

    f1: float
    precision: float
    recall: float


def identity_score(estimates: PointSets, truth: PointSets, near: NearPairs) -> IdentityScore:
    """Return IDF1 with ID precision and ID recall, from all pairs of the same scans nearer than the cutoff.

    An estimate without an identity is a track of its own.
    """
    right = _most_common_scans(couples(estimates, truth, near))
    n_truth, n_estimates = len(truth.label), len(estimates.label)
    return IdentityScore(_share(2.0 * right, n_truth + n_estimates), _share(right, n_estimates), _share(right, n_truth))


def _share(part: float, whole: int) -> float:
    return part / whole if whole else float("nan")


def _most_common_scans(pairs: Couples) -> int:
    """Return the greatest total number of near pairs when each object is given at most one track.

    Objects and tracks that no chain of pairs connects are assigned apart, so that the work does not grow with the
    number of all objects times that of all tracks.
    """
    objects, tracks_of, count = pairs.objects, pairs.tracks, np.bincount(pairs.number)
    if len(objects) == 0:
        return 0
    from scipy.sparse import coo_array  # costly to import
    from scipy.sparse.csgraph import connected_components

    tracks = int(tracks_of.max()) + 1
    nodes = int(objects.max()) + 1 + tracks
    ones = np.ones(len(objects), dtype=np.int8)
    graph = coo_array((ones, (objects, tracks_of + nodes - tracks)), shape=(nodes, nodes))
    part = connected_components(graph, directed=False)[1][objects]
    order = np.argsort(part, kind="stable")
    total = 0
    for rows in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        row, column = (np.unique(names[rows], return_inverse=True)[1] for names in (objects, tracks_of))
        table = np.zeros((1, row.max() + 1, column.max() + 1))
        table[0, row, column] = count[rows]
        partner = optimal_assignment(-table)[0]
        paired = partner >= 0
        total += int(table[0, paired, partner[paired]].sum())
    return total
