"""Consistency: do the covariances tell the errors (NEES), and do the labels stay (identity switches)?

References
----------
Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 5.4.2 (NEES and its chi-square interval).
K. Bernardin, R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics",
EURASIP Journal on Image and Video Processing, 2008 (identity switches, there "mismatches").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereophd.metrics.assignment import FloatArray, IntArray, is_positive_definite

# A track without an identity (filters that do not label their estimates) carries a negative label.
UNLABELLED = -1


def nees(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the normalised estimation error squared ``e^T P^-1 e`` of each error.

    Parameters
    ----------
    errors : (n, d) array
        Estimate minus truth.
    covariance : (n, d, d) array
        Covariance that the filter states.

    Returns
    -------
    (n,) array
        Without unit; d on average for a consistent filter. NaN where the covariance is not positive definite.
    """
    good = is_positive_definite(covariance)
    result = np.full(len(errors), np.nan)
    inverse = np.linalg.inv(covariance[good])
    result[good] = np.einsum("ni,nij,nj->n", errors[good], inverse, errors[good])
    return result


def nees_interval(count: int, dimension: int, probability: float = 0.95) -> tuple[float, float]:
    """Return the interval that holds the mean NEES of a consistent filter with this probability.

    Parameters
    ----------
    count : int
        Number of errors averaged. They are taken as independent; errors of one track at successive times
        are not, so the true interval is wider.
    dimension : int
        Dimension of the errors.
    probability : float
        Two-sided probability.

    Returns
    -------
    tuple of float
        Low and high end; NaN when count is zero.
    """
    if count == 0:
        return float("nan"), float("nan")
    from scipy.special import chdtri  # costly to import, and scipy.stats costs even more

    tail = 0.5 * (1.0 - probability)
    freedom = float(count * dimension)
    return float(chdtri(freedom, 1.0 - tail)) / count, float(chdtri(freedom, tail)) / count


def identity_switches(scan: IntArray, object_id: IntArray, track_id: IntArray) -> NDArray[np.bool_]:
    """Mark the matched pairs at which a true object is matched to another track than the time before.

    Parameters
    ----------
    scan, object_id, track_id : (n,) arrays
        Scan (in time order), true object and track of each matched pair. Pairs whose track is unlabelled
        (negative) neither are nor cause a switch.

    Returns
    -------
    (n,) array of bool
        True at the later pair of each change. Scans at which the object is not matched in between do not
        matter.
    """
    switched = np.zeros(len(scan), dtype=bool)
    labelled = np.flatnonzero(track_id > UNLABELLED)
    order = labelled[np.lexsort((scan[labelled], object_id[labelled]))]
    same_object = object_id[order[1:]] == object_id[order[:-1]]
    switched[order[1:]] = same_object & (track_id[order[1:]] != track_id[order[:-1]])
    return switched
