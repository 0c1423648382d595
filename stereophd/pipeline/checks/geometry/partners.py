"""Partners: detections of two cameras on one-camera tracks that meet most of the time: those of one object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.rows import sums_between
from stereophd.pipeline.checks.geometry.rays import GOLDEN_ANGLE, signed_distances
from stereophd.pipeline.checks.log.sample import CameraSample

# Detections of a camera that are examined, and candidates of all of them together.
MOST_DETECTIONS, MOST_PAIRS, LEAST_DETECTIONS = 3000, 200_000, 30
# Frames in which a one-camera track is examined whole, or not at all where there are more detections: single ones of
# tracks that misses end soon are too few.
PIECE = 64
# Frames on either side from which an image velocity is fitted.
HALF_WINDOW = 4
# Largest distance of partners, over that at which most rays meet beyond chance; frames, and share of a track, in which
# two tracks must meet.
FARTHEST, LEAST_COMMON, LEAST_SHARE = 2.0, 8, 0.5
# Share of the pairs of tracks that may be those of different objects, which stay near each other's rays for a while.
MOST_WRONG = 0.15


@dataclass(frozen=True)
class Partners:
    """Detections of two cameras that belong to the same object."""

    # `a`, `b`: The cameras.
    a: int
    b: int
    # Of the detections of A, and of those of B at the same times, between its frames
    sides: tuple[TrackMotion, TrackMotion]
    distance: Array  # (n,): Signed distance of the rays, standard deviations
    tracks: Integers  # (n,) of int: Number of the pair of one-camera tracks
    times: Array  # (n,): s
    # (n,): Of each detection the next of the pair of tracks that shares no detection of B with it, -1 of none
    following: Integers

    @property
    def lasting(self) -> tuple[float, float]:
        """Mean product of successive distances, of white noise 0, and that over the error that white noise gives it.

        The pairs of tracks with the largest products do not count: they may be those of different objects. One always
        does.
        """
        first = np.flatnonzero(self.following >= 0)
        products = self.distance[first] * self.distance[self.following[first]]
        _, owners, counts = np.unique(self.tracks[first], return_inverse=True, return_counts=True)
        sums = np.bincount(owners, products, len(counts))
        kept = np.argsort(-sums)[min(int(np.ceil(MOST_WRONG * len(sums))), len(sums) - 1) :]
        mean = float(sums[kept].sum() / max(counts[kept].sum(), 1))
        return mean, mean * float(counts[kept].sum()) ** 0.5 / max(float((self.distance**2).mean()), 1e-12)


class TrackMotion(NamedTuple):
    """Where the one-camera tracks of a camera are, and how they move, by the detections beside each."""

    places: Array  # (n, 2), px: Of each detection, by lines through those before and after it, without it
    velocity: Array  # (n, 2), px/s: Of these lines
    tracks: Integers  # (n,): Track of each detection, -1 of none


def track_motion(sample: CameraSample) -> TrackMotion:
    """Return the motion about each detection of a one-camera track, which its own noise does not change."""
    places, velocity = np.full((2, len(sample.pixels), 2), np.nan)
    found = TrackMotion(places, velocity, np.full(len(sample.pixels), -1, dtype=np.int64))
    for index, track in enumerate(sample.tracks):
        times = sample.times[sample.frame_of[track]]
        table = np.column_stack([times - times[0], sample.pixels[track]])
        frames = np.arange(len(track))
        low, high = np.maximum(frames - HALF_WINDOW, 0), np.minimum(frames + HALF_WINDOW + 1, len(track))
        count = (high - low - 1).astype(float)[:, None]
        mean = (sums_between(table, low, high) - table) / count
        squares = table[:, :1] * table
        products = sums_between(squares, low, high) - squares - count * mean[:, :1] * mean
        found.velocity[track] = products[:, 1:] / np.maximum(products[:, :1], 1e-12)
        found.places[track] = mean[:, 1:] + (table[:, :1] - mean[:, :1]) * found.velocity[track]
        found.tracks[track] = index
    return found


def partners(
    samples: list[CameraSample], motion: list[TrackMotion], a: int, b: int, farthest: float
) -> Partners | None:
    """Return detections of A with those of B on one-camera tracks that meet them most of the time; None for few.

    Rays meet within the distance `farthest`, standard deviations.
    """
    first, second = samples[a], samples[b]
    if len(second.times) < 4 or not len(first.pixels):
        return None
    times, track_a, track_b = first.times[first.frame_of], motion[a].tracks, motion[b].tracks
    usable = np.flatnonzero((track_a >= 0) & (times >= second.times[0]) & (times <= second.times[-1]))
    width = int(np.diff(second.first).max(initial=0))
    most = min(MOST_DETECTIONS, max(LEAST_DETECTIONS, MOST_PAIRS // max(width, 1)), len(usable))
    if len(usable) < LEAST_DETECTIONS or not width:
        return None
    pieces = first.frame_of[usable] // PIECE * len(first.tracks) + track_a[usable]
    number = np.unique(pieces, return_inverse=True)[1]
    chosen = usable[GOLDEN_ANGLE * number % (2.0 * np.pi) <= 2.0 * np.pi * most / len(usable)]
    interval, passed = second.around(times[chosen])
    index = second.first[interval][:, None] + np.arange(width)
    present = index < second.first[interval + 1][:, None]
    index = np.where(present, index, 0)
    present &= (second.links[index] >= 0) & (track_b[index] >= 0)
    following = np.where(present, second.links[index], index)
    weight = passed[:, None, None]
    pixels_b = (1.0 - weight) * second.pixels[index] + weight * second.pixels[following]
    pixels_a = np.repeat(first.pixels[chosen], width, axis=0)
    found = np.abs(signed_distances(first.camera, second.camera, pixels_a, pixels_b.reshape(-1, 2)))
    found = np.where(present & np.isfinite(found.reshape(index.shape)), found.reshape(index.shape), np.inf)
    rows, best, nearest = np.arange(len(chosen)), found.argmin(axis=1), found.min(axis=1)
    index, following = index[rows, best], following[rows, best]
    near = (nearest <= farthest) & _nearest_of_frame(first.frame_of[chosen], index, nearest)
    joined, tracks = _joined(track_a[chosen][near], track_b[index][near])
    if joined.sum() < LEAST_DETECTIONS:
        return None
    own, index, following = chosen[near][joined], index[near][joined], following[near][joined]
    speed = 0.5 * (motion[b].velocity[index] + motion[b].velocity[following])
    pixels_a, pixels_b = first.pixels[own], pixels_b[rows, best][near][joined]
    weight = passed[near][joined][:, None]
    places_b = (1.0 - weight) * motion[b].places[index] + weight * motion[b].places[following]
    # rolling shutters: from the times of frames to those of rows
    delay = speed * (first.camera.row_delays(pixels_a[:, 1]) - second.camera.row_delays(pixels_b[:, 1]))[:, None]
    distance = signed_distances(first.camera, second.camera, pixels_a, pixels_b + delay)
    sides = (
        TrackMotion(motion[a].places[own], motion[a].velocity[own], track_a[own]),
        TrackMotion(places_b + delay, speed, track_b[index]),
    )
    tracks = tracks[joined]
    return Partners(a, b, sides, distance, tracks, times[own], _following(tracks, interval[near][joined]))


def _following(tracks: Integers, intervals: Integers) -> Integers:
    """Return of each detection (n,) the next of its track beyond the interval of B after its own; -1 of none."""
    order = np.lexsort((intervals, tracks))
    # places of the intervals of all tracks, one after the other
    places = tracks[order] * (int(intervals.max(initial=0)) + 3) + intervals[order]
    found = np.searchsorted(places, places + 2)
    following = np.full(len(tracks), -1, dtype=np.int64)
    inside = found < len(order)
    inside[inside] = tracks[order[found[inside]]] == tracks[order[inside]]
    following[order[inside]] = order[found[inside]]
    return following


def _nearest_of_frame(frames: Integers, others: Integers, distances: Array) -> NDArray[np.bool_]:
    """Return which detections (n,) of these frames are nearest to their partner of all that have the same."""
    order = np.lexsort((distances, others, frames))
    repeated = (np.diff(frames[order], prepend=-1) == 0) & (np.diff(others[order], prepend=-1) == 0)
    nearest = np.empty(len(frames), dtype=np.bool_)
    nearest[order] = ~repeated
    return nearest


def _joined(track_a: Integers, track_b: Integers) -> tuple[NDArray[np.bool_], Integers]:
    """Return which partners belong to tracks that meet most of the time, and the number of each pair of tracks."""
    _, number, count = np.unique(np.stack([track_a, track_b]), axis=1, return_inverse=True, return_counts=True)
    _, own, total = np.unique(track_a, return_inverse=True, return_counts=True)
    number = number.ravel()
    return (count[number] >= LEAST_COMMON) & (count[number] >= LEAST_SHARE * total[own]), number
