"""A detection log as recorded, and its events for given cameras.

Raw pixels and times on the cameras' own clocks are kept, so that lenses and clocks can be unknown: other cameras
make other events of the same recording.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.problem import Observations
from stereophd.core.disparity.events import Event, framed_detections
from stereophd.core.geometry.camera import Camera, Clock

# One frame: index of its camera, true time by the camera's clock, raw pixels (m, 2), standard deviations if stated.
RawFrame = tuple[int, float, Array, Array | None]

# Slots that a part of a log has at least, however slow its slowest camera is.
LEAST_SLOTS = 64


@dataclass(frozen=True)
class Recording:
    """Frames of a log and their detections in one array."""

    cameras: Integers  # (f,) of int: Camera of each frame
    times: Array  # (f,): True time of each frame by `clocks`, s, increasing
    clocks: tuple[Clock, ...]  # The clock of each camera by which the log was read
    first: Integers  # Frame i has the detections first[i] to first[i + 1] - 1
    # `pixels`, `sigma`: arrays (n, 2): Raw pixels and their standard deviations, px.
    pixels: Array
    sigma: Array
    heights: Array  # (c,): Height of each camera's image, px

    @staticmethod
    def of(cameras: Sequence[Camera], frames: Sequence[RawFrame]) -> "Recording":
        """Join frames that were read by the clocks of `cameras`, in order of time."""
        nothing = np.empty((0, 2))
        sigma = [
            np.broadcast_to(cameras[camera].detector.sigma if stated is None else stated, pixels.shape)
            for camera, _, pixels, stated in frames
        ]
        counts = np.array([len(pixels) for _, _, pixels, _ in frames], dtype=np.int64)
        return Recording(
            np.array([camera for camera, _, _, _ in frames], dtype=np.int64),
            np.array([time_s for _, time_s, _, _ in frames]),
            tuple(camera.clock for camera in cameras),
            np.concatenate([[0], np.cumsum(counts)]),
            np.concatenate([nothing, *(pixels for _, _, pixels, _ in frames)]),
            np.concatenate([nothing, *sigma]),
            np.array([float(camera.height) for camera in cameras]),
        )

    @cached_property
    def log_times(self) -> Array:
        """Time (f,) of each frame on its camera's own clock, s."""
        offset = np.array([clock.offset_s for clock in self.clocks])[self.cameras]
        return np.asarray((self.times - offset) / np.array([clock.rate for clock in self.clocks])[self.cameras])

    @cached_property
    def frame_of(self) -> Integers:
        """Frame (n,) of each detection."""
        return np.repeat(np.arange(len(self.cameras)), np.diff(self.first))

    def periods(self, count: int) -> Array:
        """Median time between two frames of each of `count` cameras, s; 0 of a camera with fewer than two."""
        steps = [np.diff(self.times[self.cameras == camera]) for camera in range(count)]
        return np.array([float(np.median(step)) if len(step) else 0.0 for step in steps])

    def with_noise(self, factors: Array) -> "Recording":
        """Return the recording with the noise of each camera's detections times a factor (c,)."""
        return replace(self, sigma=self.sigma * factors[self.cameras[self.frame_of], None])

    def true_times(self, cameras: Sequence[Camera]) -> Array:
        """True time (f,) of each frame by the clocks of cameras, s."""
        times = self.times.copy()
        for number, camera in enumerate(cameras):
            if camera.clock != self.clocks[number]:
                here = self.cameras == number
                times[here] = camera.clock.to_true(self.log_times[here])
        return times

    def not_invertible(self, cameras: Sequence[Camera]) -> int:
        """Number of detections at which the lens models of cameras cannot be inverted."""
        of_camera = self.cameras[self.frame_of]
        found = [camera.undistort_pixels(self.pixels[of_camera == k])[0] for k, camera in enumerate(cameras)]
        return sum(int((~np.isfinite(points).all(axis=1)).sum()) for points in found)

    def spread(self, share: float, length: float = 1.0) -> Integers:
        """Frames in time slots common to all cameras: a share of the slots, evenly over the log.

        A slot lasts for about so many frames (`length`) of the slowest camera, and holds those of every camera; it is
        no longer than the share of the log. A pause of all cameras lasts for no time. Cameras with hardly any frames do
        not count as the slowest, and keep them all.
        """
        if share >= 1.0 or not len(self.times):
            return np.arange(len(self.times))
        periods, span = self.periods(len(self.clocks)), float(np.ptp(self.times))
        usual = float(np.sort(periods)[(len(periods) - 1) // 2])
        period = min(float(periods.max()), max(usual, span * share / LEAST_SLOTS)) or 1.0
        place = (self.times - self.times[0]) / period + 0.5
        _, rank = np.unique(np.floor(place), return_inverse=True)
        total = share * (int(rank.max()) + 1)
        kept = max(int(total / length), 1)
        slot = ((rank + place % 1.0) * kept / total).astype(np.int64)
        count = math.ceil(kept / share)
        return np.flatnonzero(((slot * kept + count // 2) % count < kept) | (periods > period)[self.cameras])

    def part(self, frames: Integers) -> "Recording":
        """Return some of the frames, in increasing order."""
        if len(frames) == len(self.cameras):
            return self
        counts, rows = np.diff(self.first)[frames], np.isin(self.frame_of, frames)
        return replace(
            self, cameras=self.cameras[frames], times=self.times[frames],
            first=np.concatenate([[0], np.cumsum(counts)]), pixels=self.pixels[rows], sigma=self.sigma[rows],
        )  # fmt: skip

    def observations(
        self, cameras: Sequence[Camera], trajectories: Integers, detections: Integers, inflation: float = 1.0
    ) -> Observations:
        """Raw pixels of detections that belong to trajectories, timed by cameras, their noise inflated."""
        frames = self.frame_of[detections]
        of_camera = self.cameras[frames]
        rows = self.pixels[detections, 1] / self.heights[of_camera]
        readout = np.array([camera.readout_s for camera in cameras])[of_camera]
        times = self.true_times(cameras)[frames] + readout * rows
        precisions = np.zeros((len(detections), 2, 2))
        precisions[:, [0, 1], [0, 1]] = 1.0 / (self.sigma[detections] * inflation) ** 2
        return Observations(
            trajectories, of_camera, times, self.pixels[detections], precisions, self.log_times[frames], rows
        )  # fmt: skip


@dataclass(frozen=True)
class Scans:
    """The frames of a recording as seen by given cameras, and their detections in one array."""

    # `times`, `cameras`: arrays (e,): True times, s, in their order, ties in the order of the cameras; and indices of
    # the cameras.
    times: Array
    cameras: Integers
    first: Integers  # Frame i has the detections first[i] to first[i + 1] - 1
    not_invertible: Integers  # (e,): Detections of each frame that are left out, as no lens model images them
    # (n, 2), (n, 2, 2), (n,): Undistorted pixels of all detections, covariances, and areas, as in an `Event`.
    points: Array
    covariances: Array
    areas: Array
    # (n,), (n, 3): Delays, s, and travels as in an `Event`; NaN where it has none.
    delays: Array
    travels: Array
    source: Integers  # (n,) of int: Which detection of the recording each one is
    recording: Recording

    @staticmethod
    def of(recording: Recording, cameras: Sequence[Camera], frames: Integers | None = None) -> "Scans":
        """Undistort a recording, or some of its frames, and put it in the order of the cameras' clocks."""
        frames = np.arange(len(recording.cameras)) if frames is None else frames
        true = recording.true_times(cameras)
        frames = frames[np.lexsort((recording.cameras[frames], true[frames]))]
        counts, of_frame = np.diff(recording.first)[frames], recording.cameras[frames]
        frame = np.repeat(np.arange(len(frames)), counts)
        rows = np.arange(len(frame)) + np.repeat(recording.first[frames] - np.cumsum(counts) + counts, counts)
        values = [np.full((len(rows), *shape), np.nan) for shape in ((2,), (2, 2), (), (), (3,))]
        for number, camera in enumerate(cameras):
            own = np.flatnonzero(of_frame[frame] == number)
            found = framed_detections(
                camera, true[frames[frame[own]]], recording.pixels[rows[own]], recording.sigma[rows[own]]
            )
            for value, part in zip(values, found, strict=True):
                value[own] = np.nan if part is None else part
        points, areas = values[0], values[2]
        order = np.lexsort((points[:, 1], points[:, 0], frame))
        order = order[np.isfinite(points[order]).all(axis=1) & (areas[order] > 0.0)]
        first = np.searchsorted(frame[order], np.arange(len(frames) + 1))
        points, covariances, areas, delays, travels = (value[order] for value in values)
        return Scans(
            true[frames], of_frame, first, counts - np.diff(first), points, covariances, areas, delays, travels,
            rows[order], recording,
        )  # fmt: skip

    @cached_property
    def event_of(self) -> Integers:
        """Frame (n,) of each detection."""
        return np.repeat(np.arange(len(self.times)), np.diff(self.first))

    @cached_property
    def precisions(self) -> Array:
        """Inverse covariance (n, 2, 2) of each detection."""
        return np.asarray(np.linalg.inv(self.covariances), dtype=np.float64)

    @cached_property
    def detection_times(self) -> Array:
        """Time (n,) of each detection, s: of its frame, and with a rolling shutter of its row."""
        return self.times[self.event_of] + np.nan_to_num(self.delays)

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """The events, as `stereophd.core.disparity.events.make_event` makes them one by one."""
        ends, out = self.first.tolist(), []
        late, moving = (
            set(self.cameras[self.event_of[~np.isnan(each)]].tolist()) for each in (self.delays, self.travels[:, 0])
        )
        for number, (time_s, camera) in enumerate(zip(self.times.tolist(), self.cameras.tolist(), strict=True)):
            own = slice(ends[number], ends[number + 1])
            out.append(
                Event(
                    time_s, camera, self.points[own], self.covariances[own], self.areas[own],
                    self.delays[own] if camera in late else None,
                    not_invertible=int(self.not_invertible[number]),
                    travels=self.travels[own] if camera in moving else None,
                )
            )  # fmt: skip
        return tuple(out)

    def of_camera(self, camera: int) -> "Scans":
        """Return the frames of one camera."""
        frames, rows = self.cameras == camera, self.cameras[self.event_of] == camera
        return Scans(
            self.times[frames], self.cameras[frames], np.append(0, np.cumsum(np.diff(self.first)[frames])),
            self.not_invertible[frames], self.points[rows], self.covariances[rows], self.areas[rows],
            self.delays[rows], self.travels[rows], self.source[rows], self.recording,
        )  # fmt: skip
