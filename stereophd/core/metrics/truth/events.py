"""Events as they are named in tables, by time, camera and frame: arrays of one row each, which compare as a whole."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers

EventKeys = NDArray[Any]  # (k,) of `KEY`
KEY = np.dtype([("time_s", np.float64), ("camera", np.int64), ("frame", np.int64)])


def event_keys(time_s: Array, camera: Integers, frame: Integers) -> EventKeys:
    """Return the names of events from times (k,), indices of cameras and frames."""
    keys = np.empty(len(time_s), dtype=KEY)
    keys["time_s"], keys["camera"], keys["frame"] = time_s, camera, frame
    return keys


def first_rows_of_events(keys: EventKeys) -> Integers:
    """Return the first row of each run of rows with one key."""
    return np.flatnonzero(np.append(True, keys[1:] != keys[:-1])[: len(keys)]).astype(np.int64)


def first_repeated(keys: EventKeys) -> int | None:
    """Return the first row whose key is that of an earlier row, None if all keys differ."""
    repeated = np.ones(len(keys), dtype=bool)
    repeated[np.unique(keys, return_index=True)[1]] = False
    return int(np.argmax(repeated)) if repeated.any() else None


def find_events(wanted: EventKeys, among: EventKeys) -> Integers:
    """Return the row of `among` (distinct keys) that has each wanted key, -1 where there is none."""
    number = np.unique(np.concatenate([among, wanted]), return_inverse=True)[1]
    row_of_number = np.full(len(number), -1, dtype=np.int64)
    row_of_number[number[: len(among)]] = np.arange(len(among))
    return row_of_number[number[len(among) :]]
