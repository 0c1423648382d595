"""When frames are taken: schedules of cameras, and windows of time that keep memory bounded."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.times import TIME_DECIMALS

# Instants handled at once: large enough for array operations to dominate, small enough for the cache.
INSTANTS_PER_WINDOW = 4096


@dataclass(frozen=True)
class Schedule:
    """Instants ``start_s + phase_s + k / rate_hz``, k = 0, 1, ..., that lie in ``[start_s, end_s)``."""

    rate_hz: float  # frames per second, positive
    # `start_s`, `end_s`: the run, true time, rounded to the nanosecond as all instants are; an instant before the start
    # (negative phase) is left out
    start_s: float
    end_s: float
    phase_s: float = 0.0  # time of the instant k = 0 after the start

    def __post_init__(self) -> None:
        # Rounded as the instants are: else the first one could lie before the start.
        object.__setattr__(self, "start_s", round(self.start_s, TIME_DECIMALS))
        object.__setattr__(self, "end_s", round(self.end_s, TIME_DECIMALS))

    def window(self, lower_s: float, upper_s: float) -> tuple[Integers, Array]:
        """Return the frame numbers (n,), counted from 0, and true times (n,) in ``[lower_s, upper_s)``."""
        index, time_s = self._instants(max(lower_s, self.start_s), min(upper_s, self.end_s))
        return index - self._first_index(), time_s

    def count(self) -> int:
        """Return the number of instants of the run."""
        last = self._instants(max(self.start_s, self.end_s - 2.0 / self.rate_hz), self.end_s)[0]
        return 0 if last.size == 0 else max(0, int(last[-1]) - self._first_index() + 1)

    def _first_index(self) -> int:
        if self.phase_s >= 0.0:
            return 0
        return int(self._instants(self.start_s, self.start_s + 2.0 / self.rate_hz)[0][0])

    def _instants(self, lower_s: float, upper_s: float) -> tuple[Integers, Array]:
        first_s = self.start_s + self.phase_s
        # One index more on either side: the rounded times decide which instants are inside.
        low = max(0, int(np.floor((lower_s - first_s) * self.rate_hz)) - 1)
        high = max(low, int(np.ceil((upper_s - first_s) * self.rate_hz)) + 2)
        index = np.arange(low, high, dtype=np.int64)
        time_s = np.round(first_s + index / self.rate_hz, TIME_DECIMALS)
        inside = (time_s >= lower_s) & (time_s < upper_s)
        return index[inside], time_s[inside]


@dataclass(frozen=True)
class TimeGrid:
    """All instants of a run: the frames of every camera, and the instants of the truth."""

    frames: tuple[Schedule, ...]  # one per camera
    truth: Schedule | None = None  # when the truth is written; None: at every distinct frame time

    @property
    def start_s(self) -> float:
        """First instant that a run may hold, true time."""
        return self.frames[0].start_s

    @property
    def end_s(self) -> float:
        """End of the run (excluded), true time."""
        return self.frames[0].end_s

    def windows(self) -> Iterator[tuple[float, float]]:
        """Yield contiguous ``(lower_s, upper_s)`` that cover the run, each of boundedly many instants."""
        rate_hz = sum(schedule.rate_hz for schedule in self._schedules())
        count = max(1, int(np.ceil((self.end_s - self.start_s) * rate_hz / INSTANTS_PER_WINDOW)))
        width_s = (self.end_s - self.start_s) / count
        for index in range(count):
            last = index == count - 1
            yield (self.start_s + index * width_s, self.end_s if last else self.start_s + (index + 1) * width_s)

    def frame_count(self) -> int:
        """Return the number of frames that all cameras take."""
        return sum(schedule.count() for schedule in self.frames)

    def times(self, lower_s: float, upper_s: float) -> Array:
        """Return the distinct instants (n,) of a window, ascending, true time."""
        return _distinct_times(self._schedules(), lower_s, upper_s)

    def truth_times(self, lower_s: float, upper_s: float) -> Array:
        """Return the instants (n,) of a window at which the truth is written, ascending, true time."""
        schedules = self.frames if self.truth is None else (self.truth,)
        return _distinct_times(schedules, lower_s, upper_s)

    def _schedules(self) -> tuple[Schedule, ...]:
        return self.frames if self.truth is None else (*self.frames, self.truth)


def _distinct_times(schedules: Sequence[Schedule], lower_s: float, upper_s: float) -> Array:
    times = [schedule.window(lower_s, upper_s)[1] for schedule in schedules]
    return np.unique(np.concatenate(times))
