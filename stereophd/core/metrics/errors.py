"""Errors of matched pairs, whether covariances (NEES) and labels (identity switches) keep to them, and confirmation.

References
----------
Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 5.4.2 (NEES and its chi-square interval).
K. Bernardin, R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics",
EURASIP Journal on Image and Video Processing, 2008 (identity switches, there "mismatches").
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.distances.ospa import ScanScores
from stereophd.core.metrics.scans import UNLABELLED, PointSets
from stereophd.core.numerics.covariance_factors import is_positive_definite


def root_mean_square(errors: Array) -> float:
    """Return the root of the mean squared length of errors (n, d); NaN without a finite row.

    Rows that are not finite (an unknown velocity, say) are left out.
    """
    squared = np.einsum("nd,nd->n", errors, errors)
    squared = squared[np.isfinite(squared)]
    return float(np.sqrt(squared.mean())) if squared.size else float("nan")


def root_mean_square_per_group(errors: Array, group: Integers, groups: int) -> Array:
    """Return `root_mean_square` (groups,) of the rows of each group; `group` (n,) is in [0, groups)."""
    squared = np.einsum("nd,nd->n", errors, errors)
    return np.asarray(np.sqrt(mean_per_group(squared, group, groups)))


def mean_per_group(values: Array, group: Integers, groups: int) -> Array:
    """Return the mean of the finite values of each group, NaN for a group without any."""
    finite = np.isfinite(values)
    count = np.bincount(group[finite], minlength=groups)
    total = np.bincount(group[finite], weights=values[finite], minlength=groups)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def error_percentiles(errors: Array) -> dict[str, float]:
    """Return ``median`` and ``p90`` of the lengths of error vectors (n, d), NaN without any, and their number ``n``."""
    length = np.sqrt(np.einsum("nd,nd->n", errors, errors))
    median, p90 = np.percentile(length, [50.0, 90.0]).tolist() if len(length) else (float("nan"), float("nan"))
    return {"median": median, "p90": p90, "n": len(length)}


def mean_of(values: NDArray[Any]) -> float:
    """Return the mean of values, NaN without any."""
    return float(values.mean()) if len(values) else float("nan")


# Errors are no longer alike where the squared norm of their correlation is below this many times its mean by chance.
CHANCE = 2.0


def whitened(errors: Array, covariance: Array) -> Array:
    """Return ``L^-1 e`` of each error, with ``P = L L^T``: of identity covariance for a consistent filter.

    Errors (n, d) are estimate minus truth, the covariance P (n, d, d) is the filter's. Rows are NaN where it is not
    positive definite. The sum of squares of a row is the normalised estimation error squared (NEES) ``e^T P^-1 e``, d
    on average for a consistent filter.
    """
    good = is_positive_definite(covariance)
    result = np.full(errors.shape, np.nan)
    result[good] = np.linalg.solve(np.linalg.cholesky(covariance[good]), errors[good, :, None])[:, :, 0]
    return result


def nees(errors: Array, covariance: Array) -> Array:
    """Return the NEES of each error, (n,), NaN where the covariance is not positive definite; see `whitened`."""
    return np.asarray((whitened(errors, covariance) ** 2).sum(axis=1))


def independent_count(errors: Array, group: Integers) -> float:
    """Return the number of independent errors, at most n, that would determine the mean NEES as well as these do.

    `errors` (n, d) are whitened (see `whitened`), finite, and of each object in order of time. `group` (n,) is the
    object of each; errors of different objects are taken as independent.

    Errors w of one object at successive times are alike. For two Gaussian errors with the (d, d) covariance R, the
    covariance of their NEES is ``2 |R|^2`` (Frobenius norm). The mean of n has the variance ``2 sum_ij |R_ij|^2 /
    n^2``, that of m independent ones ``2 d / m``:

        m = d n^2 / sum_ij |R_ij|^2.

    R is taken to depend on the number of steps between the two alone, and is estimated over all objects. The sum ends
    where the errors are no longer alike: where the trace of R is not positive (cf. the initial positive sequence of C.
    J. Geyer, "Practical Markov chain Monte Carlo", 1992), or |R|^2 what chance makes of independent errors.
    """
    order = np.argsort(group, kind="stable")
    w, group = errors[order], group[order]
    count, dimension = w.shape
    scale = float((w**2).mean()) if count else 0.0
    if count < 2 or scale == 0.0:
        return float(count)
    lags, terms = [0.0], [float(count * dimension)]
    for lag in _lags(count):
        same = group[lag:] == group[:-lag]
        pairs = int(np.count_nonzero(same))
        if pairs == 0:
            break
        correlation = w[:-lag][same].T @ w[lag:][same] / (pairs * scale)
        norm = float((correlation**2).sum())
        if np.trace(correlation) <= 0.0 or norm * pairs <= CHANCE * dimension**2:
            lags, terms = [*lags, float(lag)], [*terms, 0.0]
            break
        lags, terms = [*lags, float(lag)], [*terms, 2.0 * pairs * norm]
    # lags in between by interpolation
    every = np.arange(1.0, lags[-1] + 1.0)
    total = terms[0] + (float(np.interp(every, lags[1:], terms[1:]).sum()) if len(lags) > 1 else 0.0)
    return float(dimension * count**2 / total)


def independent_means(errors: Array, group: Integers) -> float:
    """Return the number of independent errors whose mean would be known as well as that of these, in (0, n].

    If their correlation falls exponentially, with the n errors worth m of a mean square (`independent_count`), those of
    a mean are worth about n / (2 n / m - 1).
    """
    return len(errors) / max(2.0 * len(errors) / max(independent_count(errors, group), 1.0) - 1.0, 1.0)


def _lags(count: int) -> list[int]:
    """All small numbers of steps, and ever fewer of the larger ones."""
    few = np.arange(1, 33)
    many = np.unique(np.round(np.geomspace(33, max(count, 34), 64)).astype(np.int64))
    return [int(lag) for lag in np.concatenate([few, many]) if lag < count]


def nees_interval(count: float, dimension: int, probability: float = 0.95) -> tuple[float, float]:
    """Return the ends of the two-sided interval that holds the mean NEES of a consistent filter with this probability.

    `count` independent errors are averaged (`independent_count`); both ends are NaN when it is zero.
    """
    if count == 0:
        return float("nan"), float("nan")
    from scipy.special import chdtri  # costly to import, and scipy.stats costs even more

    tail = 0.5 * (1.0 - probability)
    freedom = count * dimension
    return float(chdtri(freedom, 1.0 - tail)) / count, float(chdtri(freedom, tail)) / count


def confirmation_figures(
    time_s: Array, estimates: PointSets, truth: PointSets, scores: ScanScores, reported_id: Integers, reported_s: Array
) -> dict[str, Any]:
    """Return how long the objects of the scored scans at times (k,) waited for a confirmed estimate and a first report.

    The latter is that of the estimate's track, confirmed or tentative: tracks and times of all reports (n,) are in
    order of time. An unknown status counts as confirmed. ``never``: objects that were not paired with a confirmed one.
    """
    labels, target = np.unique(truth.label, return_inverse=True)
    appears = np.full(len(labels), np.inf)
    np.minimum.at(appears, target, time_s[truth.scan])
    pairs = scores.pairs
    if estimates.confirmed is not None:
        pairs = pairs.take(estimates.confirmed[pairs.estimate])
    # Pairs are in order of scan.
    tracked, first = np.unique(target[pairs.truth], return_index=True)
    confirmed = time_s[pairs.scan[first]]
    reported = _first_reported(estimates.label[pairs.estimate[first]], confirmed, reported_id, reported_s)
    waited = confirmed - appears[tracked]
    return {
        "mean_s": mean_of(waited),
        "median_s": float(np.median(waited)) if len(waited) else float("nan"),
        "max_s": float(waited.max()) if len(waited) else float("nan"),
        "first_report_mean_s": mean_of(np.clip(reported - appears[tracked], 0.0, waited)),
        "objects": len(waited),
        "never": len(labels) - len(tracked),
    }


def _first_reported(track_id: Integers, otherwise: Array, reported_id: Integers, reported_s: Array) -> Array:
    """Return the times of the first reports of some tracks (n,), and `otherwise` for those without an identity."""
    tracks, row = np.unique(reported_id, return_index=True)
    tracks, row = tracks[tracks > UNLABELLED], row[tracks > UNLABELLED]
    if len(tracks) == 0:
        return otherwise
    place = np.minimum(np.searchsorted(tracks, track_id), len(tracks) - 1)
    return np.where(tracks[place] == track_id, reported_s[row[place]], otherwise)
