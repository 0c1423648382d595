"""Events as they are named in tables: by time, camera and frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers


@dataclass(frozen=True)
class EventKeys:
    """Names of events, one row each: time, index of the camera, frame; arrays (k,)."""

    time_s: Array
    camera: Integers
    frame: Integers

    def take(self, rows: Integers) -> EventKeys:
        """Return the chosen rows."""
        return EventKeys(self.time_s[rows], self.camera[rows], self.frame[rows])


def first_rows_of_events(keys: EventKeys) -> Integers:
    """Return the first row of each run of rows with one key."""
    new = np.ones(len(keys.time_s), dtype=bool)
    new[1:] = np.diff(keys.time_s) != 0
    new[1:] |= (np.diff(keys.camera) != 0) | (np.diff(keys.frame) != 0)
    return np.flatnonzero(new).astype(np.int64)


def first_repeated(keys: EventKeys) -> int | None:
    """Return the first row whose key is that of an earlier row, None if all keys differ."""
    first = np.unique(_number_equal(keys), return_index=True)[1]
    repeated = np.ones(len(keys.time_s), dtype=bool)
    repeated[first] = False
    return int(np.argmax(repeated)) if repeated.any() else None


def find_events(wanted: EventKeys, among: EventKeys) -> Integers:
    """Return the row of `among` (distinct keys) that has each wanted key, -1 where there is none."""
    number = _number_equal(among, wanted)
    count = len(among.time_s)
    row_of_number = np.full(len(number), -1, dtype=np.int64)
    row_of_number[number[:count]] = np.arange(count)
    return row_of_number[number[count:]]


def _number_equal(*parts: EventKeys) -> Integers:
    """Number the keys of all parts, one after the other, so that equal keys have equal numbers."""
    columns = [np.concatenate([getattr(part, name) for part in parts]) for name in ("time_s", "camera", "frame")]
    order = np.lexsort(columns[::-1])
    new = np.zeros(len(order), dtype=bool)
    for column in columns:
        new[1:] |= np.diff(column[order]) != 0
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(new)
    return number
