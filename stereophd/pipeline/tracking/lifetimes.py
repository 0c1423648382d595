"""Leave out tracks that are too short (``report.min_track_length``)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.numerics.times import same_time
from stereophd.io.outputs.checkpoints import reachable_classes
from stereophd.io.outputs.columns import pack, unpack
from stereophd.pipeline.tracking.loop import LEFT_OUT, Record


def lasting(records: Iterable[Record], min_length_s: float) -> Iterator[Record]:
    """Yield records without the tracks that are shorter than a length.

    Every record waits until the records are `min_length_s` past it: a track is known then to last that long, or not
    to. A track that is not reported at that time, but again later, is left out before the gap.

    Parameters
    ----------
    records : iterable of Record
        In order of time.
    min_length_s : float
        Least time between the first and the last reported estimate, s.
    """
    return LastingTracks(min_length_s).records(records)


@dataclass(frozen=True)
class SavedLasting:
    """`LastingTracks` for a checkpoint."""

    # Records that wait, as `stereophd.io.outputs.columns.pack` returns them; None without any.
    waiting: dict[str, Any] | None
    # `track_ids`, `spans`: (n,), array (n, 2): Tracks so far, and the times of their first and last reported
    # estimate, s.
    track_ids: NDArray[np.int64]
    spans: NDArray[np.float64]


class LastingTracks:
    """What `lasting` knows between two records.

    Parameters
    ----------
    min_length_s : float
    saved : SavedLasting, optional
        Where it begins.
    """

    def __init__(self, min_length_s: float, saved: SavedLasting | None = None) -> None:
        self._min_length_s = min_length_s
        self._waiting: deque[Record] = deque()
        self._first: dict[int, float] = {}
        self._last: dict[int, float] = {}
        if saved is not None:
            if saved.waiting is not None:
                self._waiting.extend(unpack(saved.waiting, reachable_classes([Record])))
            track_ids = saved.track_ids.tolist()
            self._first = dict(zip(track_ids, saved.spans[:, 0].tolist(), strict=True))
            self._last = dict(zip(track_ids, saved.spans[:, 1].tolist(), strict=True))

    def records(self, records: Iterable[Record]) -> Iterator[Record]:
        """Yield records as `lasting` does."""
        waiting = self._waiting
        for record in records:
            if record.reported:
                for track_id in record.estimates.track_ids.tolist():
                    self._first.setdefault(track_id, record.time_s)
                    self._last[track_id] = record.time_s
            waiting.append(record)
            while record.time_s - waiting[0].time_s > self._min_length_s + same_time(record.time_s):
                yield self._without_short(waiting.popleft())
        while waiting:
            yield self._without_short(waiting.popleft())

    def saved(self) -> SavedLasting:
        """Return it for a checkpoint; records come back without what only the loop needs."""
        return SavedLasting(
            pack(list(self._waiting), LEFT_OUT) if self._waiting else None,
            np.array(list(self._first), dtype=np.int64),
            np.array([list(self._first.values()), list(self._last.values())], dtype=np.float64).T,
        )

    def _without_short(self, record: Record) -> Record:
        return _without_short(record, self._first, self._last, self._min_length_s)


def _without_short(record: Record, first: dict[int, float], last: dict[int, float], min_length_s: float) -> Record:
    least = min_length_s - same_time(record.time_s)

    def lasts(track_ids: list[int]) -> list[bool]:
        return [one in first and last[one] - first[one] >= least for one in track_ids]

    estimates, tentative = record.estimates, record.estimates.tentative
    kept = np.array(lasts(estimates.track_ids.tolist()), dtype=bool)
    if tentative is not None:
        tentative = tentative.take(np.array(lasts(tentative.track_ids.tolist()), dtype=bool))
    rows = [(one, np.array(lasts(one.track_ids.tolist()), dtype=bool)) for one in record.associations]
    return replace(
        record,
        estimates=estimates if kept.all() and tentative is None else replace(estimates.take(kept), tentative=tentative),
        associations=tuple(one if mask.all() else one.take(mask) for one, mask in rows if mask.any()),
    )
