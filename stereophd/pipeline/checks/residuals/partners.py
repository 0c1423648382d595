"""Detections of two cameras that belong to the same object, from one-camera tracks that meet most of the time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.pipeline.checks.geometry.rays import signed_distances
from stereophd.pipeline.checks.log.sample import CameraSample

# Detections of a camera that are examined, and candidates of all of them together.
MOST_DETECTIONS, MOST_PAIRS, LEAST_DETECTIONS = 3000, 200_000, 100
# Frames on either side from which an image velocity is fitted.
HALF_WINDOW = 4
# Largest distance of partners, standard deviations; frames, and share of a track, in which two tracks must meet.
FARTHEST, LEAST_COMMON, LEAST_SHARE = 6.0, 8, 0.5


@dataclass(frozen=True)
class Partners:
    """Detections of two cameras that belong to the same object."""

    # `a`, `b`: The cameras.
    a: int
    b: int
    # `pixels_a`, `pixels_b`: (n, 2): At the same times, those of B between its frames.
    pixels_a: Array
    pixels_b: Array
    velocity_b: Array  # (n, 2): Image velocity of B's detections, px/s
    distance: Array  # (n,): Signed distance of the rays, standard deviations
    tracks: Integers  # (n,) of int: Number of the pair of one-camera tracks

    @property
    def track_count(self) -> int:
        """Number of pairs of one-camera tracks."""
        return len(np.unique(self.tracks))

    @property
    def correlation(self) -> float:
        """Correlation of the distances in successive detections of a pair of tracks."""
        order = np.argsort(self.tracks, kind="stable")
        values, same = self.distance[order], np.diff(self.tracks[order]) == 0
        products = (values[1:] * values[:-1])[same]
        return float(products.mean() / max((values**2).mean(), 1e-12)) if len(products) else 0.0


def track_velocities(sample: CameraSample) -> tuple[Array, Integers]:
    """Return image velocities (n, 2), px/s, from lines through a few frames, and the track of each detection or -1."""
    velocity = np.full((len(sample.pixels), 2), np.nan)
    number = np.full(len(sample.pixels), -1, dtype=np.int64)
    for index, track in enumerate(sample.tracks):
        times = sample.times[sample.frame_of[track]]
        table = np.column_stack([times - times[0], sample.pixels[track]])
        places = np.arange(len(track))
        low, high = np.maximum(places - HALF_WINDOW, 0), np.minimum(places + HALF_WINDOW + 1, len(track))
        count = (high - low).astype(float)[:, None]

        def windowed(values: Array, low: Integers = low, high: Integers = high) -> Array:
            sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
            return np.asarray(sums[high] - sums[low])

        mean = windowed(table) / count
        products = windowed(table[:, :1] * table) - count * mean[:, :1] * mean
        velocity[track] = products[:, 1:] / np.maximum(products[:, :1], 1e-12)
        number[track] = index
    return velocity, number


def partners(samples: list[CameraSample], motion: list[tuple[Array, Integers]], a: int, b: int) -> Partners | None:
    """Return detections of A with those of B on one-camera tracks that meet them most of the time; None for few."""
    first, second = samples[a], samples[b]
    if len(second.times) < 4 or not len(first.pixels):
        return None
    times, track_a, (velocity, track_b) = first.times[first.frame_of], motion[a][1], motion[b]
    usable = np.flatnonzero((track_a >= 0) & (times >= second.times[0]) & (times <= second.times[-1]))
    width = int(np.diff(second.first).max(initial=0))
    most = min(MOST_DETECTIONS, max(LEAST_DETECTIONS, MOST_PAIRS // max(width, 1)), len(usable))
    if len(usable) < LEAST_DETECTIONS or not width:
        return None
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, most).astype(int))]
    interval = (np.searchsorted(second.times, times[chosen], side="right") - 1).clip(0, len(second.times) - 2)
    index = second.first[interval][:, None] + np.arange(width)
    present = index < second.first[interval + 1][:, None]
    index = np.where(present, index, 0)
    present &= (second.links[index] >= 0) & (track_b[index] >= 0)
    following = np.where(present, second.links[index], index)
    span = second.times[interval + 1] - second.times[interval]
    weight = ((times[chosen] - second.times[interval]) / np.where(span > 0.0, span, 1.0))[:, None, None]
    pixels_b = (1.0 - weight) * second.pixels[index] + weight * second.pixels[following]
    pixels_a = np.repeat(first.pixels[chosen], width, axis=0)
    found = signed_distances(first.camera, second.camera, pixels_a, pixels_b.reshape(-1, 2)).reshape(index.shape)
    found = np.where(present & np.isfinite(found), found, np.inf)
    rows = np.arange(len(chosen))
    best = np.abs(found).argmin(axis=1)
    near = np.abs(found[rows, best]) <= FARTHEST
    near &= _nearest_of_frame(first.frame_of[chosen], index[rows, best], np.abs(found[rows, best]))
    index, following = index[rows, best], following[rows, best]
    lasting, tracks = _lasting(track_a[chosen][near], track_b[index][near])
    if lasting.sum() < LEAST_DETECTIONS:
        return None
    speed = (0.5 * (velocity[index] + velocity[following]))[near][lasting]
    own, other = first.pixels[chosen][near][lasting], pixels_b[rows, best][near][lasting]
    distance = found[rows, best][near][lasting]
    delay = _delays(first.camera, own) - _delays(second.camera, other)
    if delay.any():  # rolling shutters: from the times of frames to those of rows
        other = other + speed * delay[:, None]
        distance = signed_distances(first.camera, second.camera, own, other)
    return Partners(a, b, own, other, speed, distance, tracks[lasting])


def _nearest_of_frame(frames: Integers, others: Integers, distances: Array) -> NDArray[np.bool_]:
    """Return which detections (n,) of these frames are nearest to their partner of all that have the same."""
    order = np.lexsort((distances, others, frames))
    repeated = (np.diff(frames[order], prepend=-1) == 0) & (np.diff(others[order], prepend=-1) == 0)
    nearest = np.empty(len(frames), dtype=np.bool_)
    nearest[order] = ~repeated
    return nearest


def _delays(camera: Camera, pixels: Array) -> Array:
    """Return how long after its frame each detection (n,) was made, s."""
    delays = camera.row_delays(pixels[:, 1])
    return np.zeros(len(pixels)) if delays is None else delays


def _lasting(track_a: Integers, track_b: Integers) -> tuple[NDArray[np.bool_], Integers]:
    """Return which partners belong to tracks that meet most of the time, and the number of each pair of tracks."""
    _, number, count = np.unique(np.stack([track_a, track_b]), axis=1, return_inverse=True, return_counts=True)
    _, own, total = np.unique(track_a, return_inverse=True, return_counts=True)
    number = number.ravel()
    return (count[number] >= LEAST_COMMON) & (count[number] >= LEAST_SHARE * total[own]), number
