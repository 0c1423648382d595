"""Rays of one-camera tracks at common times, for any clocks and lenses of the cameras.

A row compares track a at the time of one of its detections with track b at the same true time. Which time on the
clock of b that is depends on both clocks; the rays of b are interpolated there, between its own detections.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.rows import ArrayRows

# Tracks are interpolated over at most this many of their median steps.
LONGEST_GAP = 3.5


@dataclass(frozen=True)
class RawTracks:
    """Pixels of one-camera tracks on their cameras' own clocks."""

    cameras: Integers  # (k,) of int
    first: Integers  # Track j has the entries first[j] to first[j + 1] - 1
    log_times: Array  # (n,): s, increasing within a track
    pixels: Array  # (n, 2): Raw pixels
    rows: Array  # (n,): Row of each detection over the height of the image

    @cached_property
    def _spacing(self) -> float:
        """Length of the stretch of keys that each track gets, longer than all times."""
        return 4.0 * float(np.ptp(self.log_times)) + 1.0

    @cached_property
    def _keys(self) -> Array:
        track = np.repeat(np.arange(len(self.cameras)), np.diff(self.first))
        return np.asarray(self.log_times - self.log_times.min() + track * self._spacing)

    def spans(self, tracks: Integers | slice = slice(None)) -> list[tuple[int, int]]:
        """Return the first entry of each of some tracks, and the one after its last."""
        return list(zip(self.first[:-1][tracks].tolist(), self.first[1:][tracks].tolist(), strict=True))

    def interval_s(self, camera: int) -> float:
        """Return the median time from detection to detection of a camera's tracks, s on its clock; NaN without one."""
        steps = [np.diff(self.log_times[a:b]) for a, b in self.spans(np.flatnonzero(self.cameras == camera))]
        return float(np.median(np.concatenate(steps))) if steps else float("nan")

    @cached_property
    def longest_gaps(self) -> Array:
        """Longest step (k,) over which each track is interpolated, s."""
        return np.array([LONGEST_GAP * float(np.median(np.diff(self.log_times[a:b]))) for a, b in self.spans()])

    @cached_property
    def cameras_of_entries(self) -> Integers:
        """Camera (n,) of each entry."""
        return np.repeat(self.cameras, np.diff(self.first))

    def at(self, tracks: Integers, log_times: Array) -> tuple[Array, Booleans]:
        """Pixels (n, 2) of tracks (n,) at times on their cameras' clocks, and whether they were seen around then."""
        right, part, seen = self.between(tracks, log_times)
        return interpolated(self.pixels, right, part), seen

    def between(self, tracks: Integers, log_times: Array) -> tuple[Integers, Array, Booleans]:
        """Entries (n,) that follow times on the clocks of tracks (n,), parts (n,) of the step to them; seen as `at`."""
        if not len(tracks):  # there may be no track at all
            return np.empty(0, dtype=np.int64), np.empty(0), np.empty(0, dtype=np.bool_)
        margin = 0.25 * self._spacing
        since = np.clip(log_times - self.log_times.min(), -margin, self._spacing - 2.0 * margin)
        right = np.searchsorted(self._keys, since + tracks * self._spacing)
        right = np.clip(right, self.first[tracks] + 1, self.first[tracks + 1] - 1)
        before, after = self.log_times[right - 1], self.log_times[right]
        part = (log_times - before) / (after - before)
        seen = (part >= 0.0) & (part <= 1.0) & (after - before <= self.longest_gaps[tracks])
        return right, np.clip(part, 0.0, 1.0), seen


def interpolated(values: Array, right: Integers, part: Array) -> Array:
    """Interpolate values (e, 2) of entries between those before `right` (n,) and these, at parts (n,) of the step."""
    return np.asarray((1.0 - part)[:, None] * values[right - 1] + part[:, None] * values[right])


@dataclass(frozen=True)
class Rays(ArrayRows):
    """Rays of two cameras at common times, row by row, in the axes of the cameras."""

    rays: Array  # (r, 2, 3): third component 1
    times: Array  # (r,): true times, s
    cameras: Integers  # (r, 2) of int
    seen: Booleans  # (r,): false where track b was not seen, or a pixel cannot be undistorted


def rays_of(cameras: Sequence[Camera], tracks: RawTracks, entries: Integers, others: Integers) -> Rays:
    """Rays of the entries (r,) of tracks a, and of tracks b (r,) at the same true times, by these cameras."""
    index = np.stack([tracks.cameras_of_entries[entries], tracks.cameras[others]], axis=1)
    times, right, part, seen = _common_times(cameras, tracks, entries, others, index)
    # pairs share detections: each of these is undistorted once
    used = np.zeros(len(tracks.pixels), dtype=np.bool_)
    used[entries] = used[right] = used[right - 1] = True
    slopes = np.empty((len(used), 2))
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(used & (tracks.cameras_of_entries == number))
        slopes[rows] = camera.rays(tracks.pixels[rows])[:, :2]
    rays = np.ones((len(entries), 2, 3))
    rays[:, 0, :2], rays[:, 1, :2] = slopes[entries], interpolated(slopes, right, part)
    seen &= np.isfinite(rays).all(axis=(1, 2))
    rays[~seen] = 1.0
    return Rays(rays, times, index, seen)


def ray_poses(cameras: Sequence[Camera], rays: Rays) -> tuple[Array, Array]:
    """Rotations (r, 2, 3, 3) and centres (r, 2, 3) of the cameras of rays at their times."""
    turns, centers = np.empty((len(rays.times), 2, 3, 3)), np.empty((len(rays.times), 2, 3))
    for number, camera in enumerate(cameras):
        rows, side = np.nonzero(rays.cameras == number)
        motions = camera.pose.motions(rays.times[rows])
        turns[rows, side], centers[rows, side] = motions.rotations, motions.centers
    return turns, centers


def _common_times(
    cameras: Sequence[Camera], tracks: RawTracks, entries: Integers, others: Integers, index: Integers
) -> tuple[Array, Integers, Array, Booleans]:
    """True times (r,) of entries, and where these lie between the entries of the other tracks (`between`)."""
    offset, rate, readout = np.array([[c.clock.offset_s, c.clock.rate, c.readout_s] for c in cameras]).T
    times = offset[index[:, 0]] + rate[index[:, 0]] * tracks.log_times[entries]
    times = times + readout[index[:, 0]] * tracks.rows[entries]
    log_times = (times - offset[index[:, 1]]) / rate[index[:, 1]]
    right, part, seen = tracks.between(others, log_times)
    if readout.any():
        heights = np.array([float(camera.height) for camera in cameras])
        rows = interpolated(tracks.pixels, right, part)[:, 1] / heights[index[:, 1]]
        right, part, seen = tracks.between(others, log_times - readout[index[:, 1]] * rows / rate[index[:, 1]])
    return times, right, part, seen
