"""Errors of matched pairs and of the number of objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers


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


@dataclass(frozen=True)
class ErrorPercentiles:
    """Median and 90th percentile of n lengths of error; NaN when n is zero."""

    median: float
    p90: float
    n: int


def error_percentiles(errors: Array) -> ErrorPercentiles:
    """Return percentiles of the lengths of error vectors (n, d), with linear interpolation."""
    if len(errors) == 0:
        return ErrorPercentiles(float("nan"), float("nan"), 0)
    length = np.sqrt(np.einsum("nd,nd->n", errors, errors))
    median, p90 = np.percentile(length, [50.0, 90.0])
    return ErrorPercentiles(float(median), float(p90), len(length))


@dataclass(frozen=True)
class CardinalityError:
    """Error of the number of objects: bias (estimates minus truth) and mean absolute error."""

    bias: float
    mae: float


def cardinality_error(n_estimates: Integers, n_truth: Integers) -> CardinalityError:
    """Return the error of the numbers of objects (k,) over scans; the bias of too many estimates is positive."""
    if len(n_truth) == 0:
        return CardinalityError(float("nan"), float("nan"))
    error = n_estimates.astype(np.float64) - n_truth
    return CardinalityError(float(error.mean()), float(np.abs(error).mean()))
