"""Metrics of a whole run: estimates against truth, scan by scan, in time linear in the number of scans."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.distances.ospa import Gospa, Ospa, gospa_of_matching, match, ospa_of_matching
from stereophd.core.metrics.matching.assignment import euclidean_distances, mahalanobis_distances

# Distances held at once: bounds the memory of a batch to a few megabytes and keeps it in cache.
BATCH_ENTRIES = 100_000


@dataclass(frozen=True)
class PointSets:
    """One set of points for each of k scans, stored one after the other."""

    start: Integers  # The points of scan i are the rows ``start[i]:start[i + 1]``
    position: Array  # (n, 3) array: In the world, length unit
    velocity: Array  # (n, 3) array: In the world, length unit per second; NaN where unknown
    label: Integers  # (n,) array: Identity of the object or track
    covariance: Array | None = None  # (n, 3, 3) array or None: Covariance of the position
    # (n,) bool array or None: Whether each estimate is confirmed rather than tentative; None where that is not known.
    confirmed: NDArray[np.bool_] | None = None
    # (n, 3, 3) array or None: The part of the covariance that comes from uncertain cameras
    cameras_part: Array | None = None

    @property
    def scans(self) -> int:
        """Number of scans."""
        return len(self.start) - 1

    @property
    def counts(self) -> Integers:
        """Number of points of each scan, (k,)."""
        return np.diff(self.start)

    @property
    def scan(self) -> Integers:
        """Scan of each point, (n,)."""
        return np.repeat(np.arange(self.scans, dtype=np.int64), self.counts)

    def keep_points(self, keep: NDArray[np.bool_]) -> PointSets:
        """Return the same scans with only the marked points, (n,) bool."""
        kept = np.concatenate([[0], np.cumsum(keep, dtype=np.int64)])
        return self._rows(kept[self.start], np.flatnonzero(keep))

    def keep_scans(self, keep: NDArray[np.bool_]) -> PointSets:
        """Return only the marked scans, (k,) bool, with all their points."""
        start = np.concatenate([[0], np.cumsum(self.counts[keep], dtype=np.int64)])
        return self._rows(start, np.flatnonzero(np.repeat(keep, self.counts)))

    def _rows(self, start: Integers, rows: Integers) -> PointSets:
        covariance = None if self.covariance is None else self.covariance[rows]
        confirmed = None if self.confirmed is None else self.confirmed[rows]
        part = None if self.cameras_part is None else self.cameras_part[rows]
        return PointSets(start, self.position[rows], self.velocity[rows], self.label[rows], covariance, confirmed, part)


@dataclass(frozen=True)
class ScanScores:
    """Metrics of each scan, arrays (k,), and the matched pairs, arrays (q,) in order of scan."""

    ospa: Ospa
    gospa: Gospa
    n_matched: Integers  # (k,) array: Pairs nearer than the cutoff
    # `pair_scan`, `pair_estimate`, `pair_truth`: (q,) arrays: Those pairs: the scan, and the rows of the estimate and
    # of the true point.
    pair_scan: Integers
    pair_estimate: Integers
    pair_truth: Integers


def score_scans(
    estimates: PointSets, truth: PointSets, order: float, cutoff: float, *, mahalanobis: bool = False
) -> ScanScores:
    """Score the estimates of each scan against its true points, by OSPA and GOSPA of this order and cutoff.

    The base distance is Euclidean or taken from the covariance of each estimate (Mahalanobis); the cutoff is in its
    unit. Scans with equal numbers of estimates and true points are one batch: the work per scan is constant for a
    bounded number of objects.

    Raises ValueError when the scans differ in number, parameters are out of range, or a covariance that is needed is
    missing or not positive definite.
    """
    if estimates.scans != truth.scans:
        raise ValueError(f"expected as many scans of truth as of estimates, {estimates.scans}")
    if mahalanobis and estimates.covariance is None:
        raise ValueError("expected covariances for the Mahalanobis distance")
    ospa, gospa = np.zeros((3, estimates.scans)), np.zeros((4, estimates.scans))
    n_matched = np.zeros(estimates.scans, dtype=np.int64)
    pairs: list[tuple[Integers, Integers, Integers]] = []
    for scans, m, n in batches_of_one_size(estimates.counts, truth.counts):
        rows = estimates.start[scans][:, None] + np.arange(m)
        columns = truth.start[scans][:, None] + np.arange(n)
        matching = match(base_distances(estimates, truth, rows, columns, mahalanobis), order, cutoff)
        ospa[:, scans] = ospa_of_matching(matching, n, order, cutoff)
        gospa[:, scans] = gospa_of_matching(matching, n, order, cutoff)
        near = matching.distance < cutoff
        n_matched[scans] = near.sum(axis=1)
        batch, row = np.nonzero(near)
        pairs.append((scans[batch], rows[batch, row], columns[batch, matching.truth[batch, row]]))
    scan, estimate, true_point = _in_scan_order(pairs)
    return ScanScores(Ospa(*ospa), Gospa(*gospa), n_matched, scan, estimate, true_point)


def batches_of_one_size(n_estimates: Integers, n_truth: Integers) -> Iterator[tuple[Integers, int, int]]:
    """Group scans by their numbers (k,) of estimates and true points; yield scans (b,) and their two numbers.

    A group has at most `BATCH_ENTRIES` distances.
    """
    if len(n_truth) == 0:
        return
    size = n_estimates * (n_truth.max() + 1) + n_truth
    order = np.argsort(size, kind="stable")
    bounds = np.flatnonzero(np.diff(size[order])) + 1
    for group in np.split(order, bounds):
        m, n = int(n_estimates[group[0]]), int(n_truth[group[0]])
        step = max(1, BATCH_ENTRIES // max(m * n, 1))
        for first in range(0, len(group), step):
            yield group[first : first + step], m, n


def base_distances(
    estimates: PointSets, truth: PointSets, rows: Integers, columns: Integers, mahalanobis: bool
) -> Array:
    """Return the base distances (k, m, n) between the points of a batch, given by their rows (k, m) and (k, n)."""
    x, y = estimates.position[rows], truth.position[columns]
    if mahalanobis and estimates.covariance is not None:
        return mahalanobis_distances(x, y, estimates.covariance[rows])
    return euclidean_distances(x, y)


def _in_scan_order(pairs: list[tuple[Integers, Integers, Integers]]) -> tuple[Integers, Integers, Integers]:
    """Join the pairs of all batches; rows of estimates are in scan order, so they give the order."""
    if not pairs:
        empty = np.zeros(0, dtype=np.int64)
        return empty, empty, empty
    scan, estimate, truth = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    order = np.argsort(estimate, kind="stable")
    return scan[order], estimate[order], truth[order]
