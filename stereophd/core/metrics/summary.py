"""The figures of a run from the scores of its scans."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.metrics import identities
from stereophd.core.metrics.distances.hota import Hota, hota
from stereophd.core.metrics.distances.ospa import Gospa, Ospa, ScanScores
from stereophd.core.metrics.distances.ospa2 import ospa2_of_windows
from stereophd.core.metrics.errors import (
    error_percentiles,
    independent_count,
    mean_of,
    mean_per_group,
    nees,
    nees_interval,
    root_mean_square,
    root_mean_square_per_group,
    whitened,
)
from stereophd.core.metrics.matching.near_pairs import NearPairs
from stereophd.core.metrics.scans import UNLABELLED, PointSets

POSITION_DIMENSION = 3

# Covariances inverted at once: bounds the memory of a long run.
PAIRS_AT_ONCE = 65_536


@dataclass(frozen=True)
class PairErrors:
    """Errors of the matched pairs, in the order of `ScanScores.pairs`."""

    # `position`, `velocity`: (q, 3) arrays: Estimate minus truth in the world; NaN where a velocity is unknown.
    position: Array
    velocity: Array
    # (q, 3) array: Position errors in standard deviations (see `whitened`); NaN without a usable covariance.
    whitened: Array
    switched: NDArray[np.bool_]  # (q,) bool array: The true object was matched to another track the last time
    # (q,) array or None: NEES without what uncertain cameras add to the covariance
    nees_without_cameras: Array | None = None

    @property
    def nees(self) -> Array:
        """Normalised error squared (q,) of the position."""
        return np.asarray((self.whitened**2).sum(axis=1))


def pair_errors(estimates: PointSets, truth: PointSets, scores: ScanScores) -> PairErrors:
    """Return the errors of the matched pairs of scored scans."""
    x, y = scores.pairs.estimate, scores.pairs.truth
    position = estimates.position[x] - truth.position[y]
    normalised, alone = np.full(position.shape, np.nan), np.full(len(x), np.nan)
    if estimates.covariance is not None:
        for first in range(0, len(x), PAIRS_AT_ONCE):
            rows = slice(first, first + PAIRS_AT_ONCE)
            normalised[rows] = whitened(position[rows], estimates.covariance[x[rows]])
            if (part := estimates.cameras_part) is not None:
                alone[rows] = nees(position[rows], (estimates.covariance - part)[x[rows]])
    return PairErrors(
        position,
        estimates.velocity[x] - truth.velocity[y],
        normalised,
        identities.identity_switches(scores.pairs.scan, truth.label[y], estimates.label[x]),
        None if estimates.cameras_part is None else alone,
    )


def track_ospa(
    estimates: PointSets, truth: PointSets, near: NearPairs, window: int, order: float, cutoff: float
) -> Ospa:
    """Return OSPA(2) of each window of scans, as `ospa2_of_windows`; NaN for estimates without identities."""
    if identities.has_identities(estimates):
        return ospa2_of_windows(estimates, truth, near, window, order, cutoff)
    unknown = np.full(estimates.scans, np.nan)
    return Ospa(unknown, unknown, unknown)


def per_scan_columns(
    time_s: Array, estimates: PointSets, truth: PointSets, scores: ScanScores, ospa2: Ospa, errors: PairErrors
) -> dict[str, NDArray[Any]]:
    """Return the columns of ``per_scan.parquet``, arrays (k,); NaN where a scan has no matched pair."""
    scans, group = len(time_s), scores.pairs.scan
    return {
        "time_s": time_s,
        "ospa": scores.ospa.distance,
        "ospa_localisation": scores.ospa.localisation,
        "ospa_cardinality": scores.ospa.cardinality,
        "ospa2": ospa2.distance,
        "ospa2_localisation": ospa2.localisation,
        "ospa2_cardinality": ospa2.cardinality,
        "gospa": scores.gospa.distance,
        "n_truth": truth.counts,
        "n_estimates": estimates.counts,
        "n_matched": scores.n_matched,
        "rmse_position": root_mean_square_per_group(errors.position, group, scans),
        "rmse_velocity": root_mean_square_per_group(errors.velocity, group, scans),
        "nees_position": mean_per_group(errors.nees, group, scans),
        "identity_switches": np.bincount(group[errors.switched], minlength=scans).astype(np.int64),
    }


def figures(
    estimates: PointSets,
    truth: PointSets,
    scores: ScanScores,
    matchable: NearPairs,
    ospa2: Ospa,
    errors: PairErrors,
    confirmation: dict[str, Any],
) -> dict[str, Any]:
    """Return the figures of a run as nested JSON-able values; NaN where there is nothing to average.

    `matchable` are all pairs that may be matched (IDF1); `confirmation` is of `confirmation_figures`.

    Means of OSPA, OSPA(2) and GOSPA (and of their parts) are over scans, the others over matched pairs. The
    parts of a mean distance do not add up to it: only those of a single scan do.
    """
    surplus = estimates.counts - truth.counts
    normalised, alone = errors.nees, errors.nees_without_cameras
    known = np.isfinite(normalised)
    normalised = normalised[known]
    independent = independent_count(errors.whitened[known], truth.label[scores.pairs.truth[known]])
    low, high = nees_interval(independent, POSITION_DIMENSION)
    matched = int(scores.n_matched.sum())
    labels = estimates.label[estimates.label > UNLABELLED]
    return {
        "ospa": _means(scores.ospa),
        "ospa2": _means(ospa2),
        "gospa": _means(scores.gospa),
        "rmse": {"position": root_mean_square(errors.position), "velocity": root_mean_square(errors.velocity)},
        "position_error": error_percentiles(errors.position),
        "cardinality": {
            "bias": mean_of(surplus),
            "mae": mean_of(np.abs(surplus)),
            "mean_truth": mean_of(truth.counts),
            "mean_estimates": mean_of(estimates.counts),
        },
        "pairs": {
            "matched": matched,
            "missed": int(truth.counts.sum()) - matched,
            "false": int(estimates.counts.sum()) - matched,
        },
        # Without labels there are no identities to switch.
        "identity_switches": int(errors.switched.sum()) if labels.size or matched == 0 else None,
        "clear_mot": identities.clear_mot_figures(
            estimates, truth, scores, errors.switched, np.linalg.norm(errors.position, axis=1)
        ),
        **_identity_scores(estimates, truth, scores.near, matchable),
        "tracks": len(np.unique(labels)),
        **identities.identity_figures(estimates, truth, scores, errors.switched),
        "confirmation": confirmation,
        "nees": {
            "position": mean_of(normalised),
            "interval_95": [low, high],
            "dimension": POSITION_DIMENSION,
            "n": len(normalised),
            "n_independent": independent,
            # where uncertain cameras add to the covariance
            **({} if alone is None else {"without_cameras": mean_of(alone[np.isfinite(alone)])}),
        },
    }


def _means(distances: Ospa | Gospa | Hota) -> dict[str, float]:
    """Return the means of a distance (as ``mean``) and of its parts."""
    return dict(zip(("mean", *distances._fields[1:]), map(mean_of, distances), strict=True))


def _identity_scores(estimates: PointSets, truth: PointSets, near: NearPairs, matchable: NearPairs) -> dict[str, Any]:
    """Return IDF1 and HOTA; NaN for estimates without identities."""
    if not identities.has_identities(estimates):
        unknown = float("nan")
        return {
            **dict.fromkeys(("idf1", "id_precision", "id_recall"), unknown),
            "hota": dict.fromkeys(("mean", "detection", "association", "localisation"), unknown),
        }
    return {**identities.identity_score(estimates, truth, matchable), "hota": _means(hota(estimates, truth, near))}
