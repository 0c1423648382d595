"""Leave out tracks that are too short (``report.min_track_length``)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from stereophd.core.numerics.times import same_time
from stereophd.pipeline.tracking.loop import Record


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
    waiting: deque[Record] = deque()
    first: dict[int, float] = {}
    last: dict[int, float] = {}
    for record in records:
        if record.reported:
            for track_id in record.estimates.track_ids.tolist():
                first.setdefault(track_id, record.time_s)
                last[track_id] = record.time_s
        waiting.append(record)
        while record.time_s - waiting[0].time_s > min_length_s + same_time(record.time_s):
            yield _without_short(waiting.popleft(), first, last, min_length_s)
    while waiting:
        yield _without_short(waiting.popleft(), first, last, min_length_s)


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
