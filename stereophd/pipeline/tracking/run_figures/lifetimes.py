"""Leave out tracks that are too short (``report.min_track_length``)."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from stereophd.core.numerics.times import same_time
from stereophd.pipeline.tracking.loop import Record


@dataclass
class LastingTracks:
    """Takes tracks out of records whose first and last reported estimates are less than a time apart; holds its state.

    Every record waits until the records are `min_length_s` past it: a track is known then to last that long, or not to.
    A track that is not reported at that time, but again later, is left out before the gap.
    """

    min_length_s: float
    waiting: list[Record] = field(default_factory=list)
    # Tracks so far -> times of their first and last reported estimate, s.
    first: dict[int, float] = field(default_factory=dict)
    last: dict[int, float] = field(default_factory=dict)

    def records(self, records: Iterable[Record]) -> Iterator[Record]:
        """Yield records, in order of time, without the short tracks."""
        waiting = self.waiting
        for record in records:
            if record.reported:
                for track_id in record.estimates.track_ids.tolist():
                    self.first.setdefault(track_id, record.time_s)
                    self.last[track_id] = record.time_s
            waiting.append(record)
            while record.time_s - waiting[0].time_s > self.min_length_s + same_time(record.time_s):
                yield self._without_short(waiting.pop(0))
        while waiting:
            yield self._without_short(waiting.pop(0))

    def _without_short(self, record: Record) -> Record:
        least = self.min_length_s - same_time(record.time_s)

        def lasts(track_ids: list[int]) -> list[bool]:
            return [one in self.first and self.last[one] - self.first[one] >= least for one in track_ids]

        estimates, tentative = record.estimates, record.estimates.tentative
        kept = np.array(lasts(estimates.track_ids.tolist()), dtype=bool)
        if tentative is not None:
            tentative = tentative.take(np.array(lasts(tentative.track_ids.tolist()), dtype=bool))
        rows = [(one, np.array(lasts(one.track_ids.tolist()), dtype=bool)) for one in record.associations]
        if not kept.all() or tentative is not None:
            estimates = replace(estimates.take(kept), tentative=tentative)
        return replace(
            record,
            estimates=estimates,
            associations=tuple(one if mask.all() else one.take(mask) for one, mask in rows if mask.any()),
        )
