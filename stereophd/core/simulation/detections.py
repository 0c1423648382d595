"""Detections of the cameras of a scene: with noise, misses and clutter."""

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.simulation.boxes import SizedObjects, draw_boxes
from stereophd.core.simulation.objects import SceneObject, StateWindow, state_windows
from stereophd.core.simulation.timing import TimeGrid

# Label of a false detection.
CLUTTER_ID = -1

# Row times are exact to a picosecond; each iteration gains a digit or more at the speeds that a camera can follow.
READOUT_ITERATIONS = 50
READOUT_TOLERANCE_S = 1e-12


@dataclass(frozen=True)
class Scene:
    """Cameras and objects of one run."""

    cameras: tuple[Camera, ...]
    grid: TimeGrid  # its schedules are those of `cameras`, in order
    objects: tuple[SceneObject, ...]
    motion: Motion  # of those objects that a motion model moves
    sized: SizedObjects | None = None  # shape and sizes of objects that detectors report as boxes

    def windows(self) -> Iterator[StateWindow]:
        """Yield the states of the objects, window by window, in order of true time."""
        return state_windows(self.objects, self.grid, self.motion)


@dataclass(frozen=True)
class SimulatedFrame:
    """One frame of one camera."""

    log_time_s: float  # on the camera's own clock
    camera: int  # index of the camera
    frame: int  # number, from 0
    pixels: Array  # (m, 2): detections in distorted pixels, in random order; none is a frame too
    object_id: NDArray[np.int64]  # (m,): label of the object of each detection, `CLUTTER_ID` for clutter
    sizes: Array | None = None  # (m, 2): width and height of the boxes, px


def simulate_frames(scene: Scene, seed: np.random.SeedSequence) -> Iterator[SimulatedFrame]:
    """Yield the frames of all cameras in order of log time, ties in camera order.

    Each camera makes its own frames from its own random numbers (a child of `seed`) and its own pass over the objects'
    paths: clocks may be hours apart without more than a window of each camera in memory.
    """
    make = _camera_frames if scene.sized is None else _camera_boxes
    streams = [make(scene, index, child) for index, child in enumerate(seed.spawn(len(scene.cameras)))]
    return merge(*streams, key=lambda frame: (frame.log_time_s, frame.camera))


def _camera_frames(scene: Scene, index: int, seed: np.random.SeedSequence) -> Iterator[SimulatedFrame]:
    camera = scene.cameras[index]
    detection_generator, clutter_generator, order_generator = map(np.random.default_rng, seed.spawn(3))
    for window in scene.windows():
        numbers, times_s = scene.grid.frames[index].window(window.lower_s, window.upper_s)
        seen = _detect(camera, window, times_s, detection_generator)
        false = _clutter(camera, times_s.size, clutter_generator)
        frame = np.concatenate([seen[0], false[0]])
        pixels = np.concatenate([seen[1], false[1]])
        identifiers = np.concatenate([seen[2], false[2]])
        # Detections of a frame come in no order: the first must not be the first object.
        order = np.lexsort((order_generator.random(frame.size), frame))
        bounds = np.searchsorted(frame[order], np.arange(times_s.size + 1))
        log_times_s = np.asarray(camera.clock.to_log(times_s))
        for position, number in enumerate(numbers):
            rows = order[bounds[position] : bounds[position + 1]]
            yield SimulatedFrame(float(log_times_s[position]), index, int(number), pixels[rows], identifiers[rows])


def _camera_boxes(scene: Scene, index: int, seed: np.random.SeedSequence) -> Iterator[SimulatedFrame]:
    """Yield the frames of a camera whose detections are boxes."""
    assert scene.sized is not None
    camera, generator = scene.cameras[index], np.random.default_rng(seed)
    for window in scene.windows():
        numbers, times_s = scene.grid.frames[index].window(window.lower_s, window.upper_s)
        columns = np.searchsorted(window.times_s, times_s)
        log_times_s = np.asarray(camera.clock.to_log(times_s))
        for position, number in enumerate(numbers):
            states = window.states[:, columns[position]]
            exists = ~np.isnan(states[:, 0])
            pixels, sizes, labels = draw_boxes(
                camera.at(float(times_s[position])), states[exists], window.object_id[exists], scene.sized, generator
            )
            order = generator.permutation(len(labels))
            yield SimulatedFrame(
                float(log_times_s[position]), index, int(number), pixels[order], labels[order], sizes[order]
            )


def _detect(
    camera: Camera, window: StateWindow, times_s: Array, generator: np.random.Generator
) -> tuple[Integers, Array, Integers]:
    """Return frame index (k,), pixels (k, 2) and object (k,) of the true detections in a window."""
    columns = np.searchsorted(window.times_s, times_s)
    states = window.states[:, columns].transpose(1, 0, 2)  # (frames, objects, 6)
    shape = states.shape[:2]
    detected = generator.random(shape) < camera.detector.p_detect
    noise = generator.standard_normal((*shape, 2)) * np.asarray(camera.detector.sigma)
    frame, row = np.nonzero(detected & ~np.isnan(states[:, :, 0]))
    points, times_s = states[frame, row, :3], times_s[frame]
    if camera.readout_s != 0.0:
        velocities = states[frame, row, 3:]
        delays = _row_delays(camera, points, velocities, times_s)
        points, times_s = points + delays[:, None] * velocities, times_s + delays
    exact = camera.project_at(points, times_s)
    pixels = exact + noise[frame, row]
    # Noise over the edge of the image is no detection: the sensor ends there.
    kept = camera.contains(exact) & camera.contains(pixels)
    return frame[kept], pixels[kept], window.object_id[row[kept]]


def _row_delays(camera: Camera, points: Array, velocities: Array, times_s: Array) -> Array:
    """Return when a rolling shutter reads moving points (n, 3), s after the times (n,) of their frames.

    The points are where the objects are at the times of the frames. The delay t solves t = readout v(x + t dx/dt) /
    height, v being the distorted row in the camera where it is t later: iterated from the middle row on, a contraction
    by the speed along the rows over that of the readout. During a readout objects move on straight. NaN for a point
    that keeps pace with the readout: it may be seen many times, or never.
    """
    outermost = np.array([-0.5, camera.height - 0.5])
    delays = np.full(len(points), camera.readout_s / 2.0)
    change = np.zeros(len(points))
    for _ in range(READOUT_ITERATIONS):
        rows = camera.project_at(points + delays[:, None] * velocities, times_s + delays)[:, 1]
        # outside the image (NaN: behind the camera) nothing is read: any time will do
        rows = np.clip(np.where(np.isnan(rows), camera.height / 2.0, rows), *outermost)
        reached = camera.row_delays(rows)
        change = np.abs(reached - delays)
        delays = reached
        if not (change > READOUT_TOLERANCE_S).any():
            break
    return np.where(change > READOUT_TOLERANCE_S, np.nan, delays)


def _clutter(camera: Camera, frames: int, generator: np.random.Generator) -> tuple[Integers, Array, Integers]:
    """Return frame index (k,), pixels (k, 2) and label (k,) of Poisson clutter, uniform over the image."""
    counts = generator.poisson(camera.detector.clutter_per_frame, frames)
    total = int(counts.sum())
    pixels = generator.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5], (total, 2))
    return np.repeat(np.arange(frames), counts), pixels, np.full(total, CLUTTER_ID, dtype=np.int64)


def truth_rows(scene: Scene) -> Iterator[tuple[Array, Integers, Array]]:
    """Yield times (n,), object labels (n,) and states (n, 6) of the truth, window by window.

    Rows are in order of true time, then of label; an object has a row at every instant of its life.
    """
    for window in scene.windows():
        columns = np.searchsorted(window.times_s, scene.grid.truth_times(window.lower_s, window.upper_s))
        order = np.argsort(window.object_id)
        states = window.states[order][:, columns].transpose(1, 0, 2)
        instant, row = np.nonzero(~np.isnan(states[:, :, 0]))
        yield window.times_s[columns][instant], window.object_id[order][row], states[instant, row]
