"""Sets of points, one for each scan of a run."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers

# A track without an identity (filters that do not label their estimates) carries a negative label.
UNLABELLED = -1


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

    def keep_points(self, keep: NDArray[np.bool_]) -> "PointSets":
        """Return the same scans with only the marked points, (n,) bool."""
        kept = np.concatenate([[0], np.cumsum(keep, dtype=np.int64)])
        return self._rows(kept[self.start], np.flatnonzero(keep))

    def keep_scans(self, keep: NDArray[np.bool_]) -> "PointSets":
        """Return only the marked scans, (k,) bool, with all their points."""
        start = np.concatenate([[0], np.cumsum(self.counts[keep], dtype=np.int64)])
        return self._rows(start, np.flatnonzero(np.repeat(keep, self.counts)))

    def _rows(self, start: Integers, rows: Integers) -> "PointSets":
        columns = {name: values for name, values in vars(self).items() if name != "start" and values is not None}
        return PointSets(start, **{name: values[rows] for name, values in columns.items()})
