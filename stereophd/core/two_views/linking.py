"""One-camera tracks by linking detections in the image, cut wherever the next detection is ambiguous.

A filter does not know the depth of what one camera sees, so its gate is as wide as the fastest object at the least
depth can move. Where many objects are near one another and move together (corners of a board), its tracks swap them.
In the image they are easy to follow as long as they move by less than their distance: a track continues with the
detection nearest to its prediction if both are each other's nearest and every alternative is much further away. Any
other track ends, and what it may have been begins a new one: short tracks, but hardly any of two objects.
"""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.numerics.compilation.compiled import compiled

# An alternative is ambiguous within this many times the distance of the nearest, and this many times the noise.
RATIO, NOISE = 2.0, 4.0
# Most successive frames without a detection.
MOST_MISSED = 2
# `_continued` returns these for tracks without a detection in reach, and for ambiguous ones.
MISSED, AMBIGUOUS = -1, -2


@dataclass
class _Track:
    """A track that can still grow: its detections, and its last point, time and velocity (None: not known yet)."""

    rows: list[int]
    point: Array
    time_s: float
    velocity: Array | None = None
    missed: int = 0

    def go_on(self, row: int, point: Array, time_s: float) -> None:
        """Take one more detection."""
        self.velocity = (point - self.point) / (time_s - self.time_s)
        self.rows.append(row)
        self.point, self.time_s, self.missed = point, time_s, 0


def linked(times: Array, first: Integers, points: Array, noise: Array, reach: float) -> list[Integers]:
    """Link the detections of one camera, frame by frame: the detections of each track.

    Times (f,) of the frames increase, s; frame i has the detections first[i] to first[i + 1] - 1. Points (n, 2) are
    pixels and `noise` (n,) their standard deviation; `reach` is the longest distance from a prediction, px.
    """
    every: list[_Track] = []
    active: list[_Track] = []
    for frame, time_s in enumerate(times.tolist()):
        rows = np.arange(first[frame], first[frame + 1])
        free = np.ones(len(rows), dtype=np.bool_)
        going: list[_Track] = []
        for track, place in zip(active, _continued(active, time_s, points[rows], noise[rows], reach), strict=True):
            if place >= 0:
                track.go_on(int(rows[place]), points[rows[place]], time_s)
                free[place] = False
            elif place == MISSED:
                track.missed += 1
            if place != AMBIGUOUS and track.missed <= MOST_MISSED:
                going.append(track)
        begun = [_Track([row], points[row], time_s) for row in rows[free].tolist()]
        active = going + begun
        every += begun
    return [np.array(track.rows, dtype=np.int64) for track in every]


def _continued(tracks: list[_Track], time_s: float, points: Array, noise: Array, reach: float) -> list[int]:
    """Return the index of the next detection of each track, `MISSED` or `AMBIGUOUS`."""
    if not tracks or not len(points):
        return [MISSED] * len(tracks)
    known = [track.velocity for track in tracks if track.velocity is not None]
    # what has no velocity yet moves as the others do: neighbours on one object move alike
    common = np.median(known, axis=0) if known else np.zeros(2)
    predicted = np.stack([
        track.point + (time_s - track.time_s) * (common if track.velocity is None else track.velocity)
        for track in tracks
    ])  # fmt: skip
    distances = np.linalg.norm(predicted[:, None] - points[None], axis=2)
    out = []
    for number, row in enumerate(distances):
        place = int(row.argmin())
        margin = RATIO * row[place] + NOISE * noise[place]
        column = distances[:, place]
        others = np.concatenate([np.delete(row, place), np.delete(column, number)])
        if row[place] > reach:
            out.append(MISSED)
        elif column.argmin() == number and (others > margin).all():
            out.append(place)
        else:
            out.append(AMBIGUOUS)
    return out


@compiled
def nearest_of_frame(first: Integers, points: Array, step: int, asked: Booleans, there: Booleans) -> Integers:
    """Return the place of the nearest point of frame k + step for each of the points (n, 2) of frame k; -1 of none.

    Frame k has the points first[k] to first[k + 1] - 1, which increase along the first axis. Points that are not
    `asked` (n,) have none, and only those that are `there` (n,) are found.
    """
    nearest, frames = np.full(len(points), -1), len(first) - 1
    for k in range(max(0, -step), min(frames, frames - step)):
        low, high = first[k + step], first[k + step + 1]
        for i in range(first[k], first[k + 1]):
            least, right = np.inf, low + np.searchsorted(points[low:high, 0], points[i, 0])
            for j, direction in ((right, 1), (right - 1, -1)):
                while asked[i] and low <= j < high and (points[j, 0] - points[i, 0]) ** 2 < least:
                    squared = (points[j, 0] - points[i, 0]) ** 2 + (points[j, 1] - points[i, 1]) ** 2
                    if there[j] and squared < least:
                        least, nearest[i] = squared, j
                    j += direction
    return nearest
