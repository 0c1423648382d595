"""How tracks and true objects belong together over a run: identity switches, purity, completeness, IDF1.

All count the matched pairs of all scans. The dominant object of a track is the one it is matched to most often (the
smallest identity of several), and likewise the dominant track of an object (A. A. Gorji, R. Tharmarasa, T. Kirubarajan,
"Performance measures for multiple target tracking problems", FUSION 2011).

IDF1 is the share of points with the right identity when each object is given at most one track for the whole run
(E. Ristani, F. Solera, R. Zou, R. Cucchiara, C. Tomasi, "Performance measures and a data set for multi-target,
multi-camera tracking", ECCV Workshops 2016, section 3).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.metrics.distances.ospa import ScanScores
from stereophd.core.metrics.errors import mean_of
from stereophd.core.metrics.matching.near_pairs import NearPairs, couples, least_cost
from stereophd.core.metrics.scans import UNLABELLED, PointSets

# An object is mostly tracked if it is matched in at least this share of its scans, and mostly lost below the rest.
MOSTLY = 0.8
ALL = slice(None)


@dataclass(frozen=True)
class PartnerCounts:
    """What each track, or each true object, was matched to: arrays (k,) in order of identity."""

    identity: Integers
    n_points: Integers  # Estimates of a track; scans at which an object exists
    n_matched: Integers  # Those of them that are matched at all
    partner: Integers  # The dominant object, or track; without meaning where there is none
    n_dominant: Integers  # Matches with it
    n_partners: Integers  # Number of different ones: the fragmentation of an object, 1 if followed well

    @property
    def share_matched(self) -> Array:
        """Share of the points that are matched, (k,): the completeness of an object."""
        return self.n_matched / self.n_points

    @property
    def share_dominant(self) -> Array:
        """Share of the points that are matched to the dominant partner, (k,): the purity of a track, 0 if false."""
        return self.n_dominant / self.n_points


def tabulate(identity: Integers, owner: Integers, partner: Integers, is_named: Booleans | slice = ALL) -> PartnerCounts:
    """Return what each identity was matched to, from those of all points (n,) and both sides (q,) of matched pairs.

    Pairs that are not `is_named` (q,) count for `PartnerCounts.n_matched` only.
    """
    names, n_points = np.unique(identity, return_counts=True)
    number = np.searchsorted(names, owner)
    n_matched = np.bincount(number, minlength=len(names)).astype(np.int64)
    return PartnerCounts(names, n_points, n_matched, *_dominant(number[is_named], partner[is_named], len(names)))


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
    pair_track, pair_object = estimates.label[scores.pairs.estimate], truth.label[scores.pairs.truth]
    labelled = pair_track > UNLABELLED
    tracks = tabulate(estimates.label[estimates.label > UNLABELLED], pair_track[labelled], pair_object[labelled])
    objects = tabulate(truth.label, pair_object, pair_track, labelled)
    owner = np.searchsorted(objects.identity, pair_object[switched])
    switches = np.bincount(owner, minlength=len(objects.identity))
    known = has_identities(estimates)
    of_tracks = {
        "matched_dominant": objects.n_dominant,
        "completeness_dominant": objects.share_dominant,
        "fragmentation": objects.n_partners,
        "identity_switches": switches,
    }
    return {
        "purity": {
            "mean": mean_of(tracks.share_dominant),
            "table": _rows(
                {
                    "track_id": tracks.identity,
                    "object_id": _known_partners(tracks),
                    "estimates": tracks.n_points,
                    "matched": tracks.n_matched,
                    "matched_dominant": tracks.n_dominant,
                    "purity": tracks.share_dominant,
                }
            ),
        },
        "completeness": {
            "mean": mean_of(objects.share_matched),
            "mean_dominant": mean_of(objects.share_dominant) if known else float("nan"),
            "fragmentation": mean_of(objects.n_partners) if known else float("nan"),
            "table": _rows(
                {
                    "object_id": objects.identity,
                    "track_id": _known_partners(objects),
                    "scans": objects.n_points,
                    "matched": objects.n_matched,
                    "matched_dominant": objects.n_dominant,
                    "completeness": objects.share_matched,
                    **{name: values if known else np.full(len(values), None) for name, values in of_tracks.items()},
                }
            ),
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
    matched, points = len(scores.pairs.scan), len(truth.label)
    if not has_identities(estimates):
        return {"mota": None, "motp": mean_of(distance), "mostly_tracked": None, "mostly_lost": None}
    wrong = points + len(estimates.label) - 2 * matched + int(switched.sum())
    number = np.unique(truth.label, return_inverse=True)[1]
    share = np.bincount(number[scores.pairs.truth], minlength=number.max(initial=-1) + 1) / np.bincount(number)
    return {
        "mota": 1.0 - wrong / points if points else float("nan"),
        "motp": mean_of(distance),
        "mostly_tracked": int((share >= MOSTLY).sum()),
        "mostly_lost": int((share < 1.0 - MOSTLY).sum()),
    }


def _known_partners(of: PartnerCounts) -> NDArray[Any]:
    """Return the dominant partners, as objects of Python, None without one."""
    out = of.partner.astype(object)
    out[of.n_dominant == 0] = None
    return out


def _rows(columns: dict[str, NDArray[Any]]) -> list[dict[str, Any]]:
    """Return one dictionary of plain values for each row of a table."""
    values = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in values]


def identity_score(estimates: PointSets, truth: PointSets, near: NearPairs) -> dict[str, float]:
    """Return ``idf1``, ``id_precision`` and ``id_recall``, from all pairs of the same scans nearer than the cutoff.

    They are between 0 and 1; NaN where there is nothing to divide by. An estimate without an identity is a track of its
    own.
    """
    pairs = couples(estimates, truth, near)
    common = np.bincount(pairs.number, minlength=len(pairs.objects)).astype(np.float64)
    right = int(common[least_cost(pairs.objects, pairs.tracks, -common, 0.0)].sum())
    n_truth, n_estimates = len(truth.label), len(estimates.label)
    wholes = {"idf1": (n_truth + n_estimates) / 2.0, "id_precision": n_estimates, "id_recall": n_truth}
    return {name: right / whole if whole else float("nan") for name, whole in wholes.items()}
