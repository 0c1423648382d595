"""The input of a filter: the cameras, and events of one camera at one time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.rolling import NO_READINGS, readings, travels, turned_to_frame
from stereophd.core.disparity.space import PACKED_SIZE, DisparitySpace
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.region import rays_meet
from stereophd.core.numerics.rows import ArrayRows

# Packed spaces of moving cameras that are kept.
MOST_KEPT = 4096
# Standard deviations by which a detection may miss the view of the region, and the places around it that are tried.
OUTSIDE_ERRORS = 4.0
# Pixels of each side of an image at which it is asked what sees the region.
VIEW_PIXELS = 40
NEIGHBOURS = np.array([(0.0, 0.0), *((np.cos(a), np.sin(a)) for a in 0.25 * np.pi * np.arange(8))])


@dataclass(frozen=True)
class Event(ArrayRows):
    """The detections of one camera at one time, undistorted."""

    time_s: float  # Time, s
    camera: int  # Index of the camera in the rig
    # (m, 2): Undistorted pixels, ordered by u, so that results do not depend on the order in the log. Of a rolling
    # shutter that turns: in the axes of the camera at `time_s` (`stereophd.core.disparity.rolling`).
    points: Array
    covariances: Array  # (m, 2, 2): Noise of the undistorted pixels, px^2
    # (m,): Area of an undistorted pixel per distorted pixel: turns densities over the undistorted plane into
    # densities over the image, where clutter and births are uniform.
    areas: Array
    # (m,), optional: Time of each detection after `time_s`, s, of a rolling shutter; None: all are of that time.
    delays: Array | None = None
    frame: int = -1  # Number of the frame that the camera gave it; -1 where no number is known
    # Detections of the frame that were left out, because the lens model cannot be inverted there.
    not_invertible: int = 0
    own_noise: bool = False  # Whether each detection states its own noise, which replaces the detector's
    pixels: Array | None = None  # (m, 2), optional: The detections as in the log, distorted
    # (m, 3), optional: Displacement of the camera's centre in the world from `time_s` until each detection was made,
    # of a rolling shutter that moves; None: it stands still meanwhile.
    travels: Array | None = None
    sizes: Array | None = None  # (m, 2), optional: Width and height of the detections' boxes, distorted px
    rows: Integers | None = None  # (m,), optional: Row of each detection in the log, or its number in the run

    outside: int = 0  # Detections of the frame that were left out, because they see nothing of the region

    def within(self, rig: Rig) -> Event:
        """Return the event without the detections whose rays, moved by the noise, pass the region of the rig by.

        They are no objects. Those of boxes stay: a body may reach into the region.
        """
        if rig.region is None or len(rig.region) == 2 or self.sizes is not None or not len(self.points):
            return self
        camera = rig.cameras[self.camera].at(self.time_s)
        reach = OUTSIDE_ERRORS * np.sqrt(np.trace(self.covariances, axis1=1, axis2=2))
        kept = np.zeros(len(self.points), dtype=np.bool_)
        for step in NEIGHBOURS:
            rest = np.flatnonzero(~kept)
            moved = self.points[rest] + reach[rest, None] * step
            rays = camera.pinhole_rays(moved) @ camera.pose.rotation
            kept[rest] = rays_meet(camera.pose.center, rays, rig.region)
            if kept.all():
                return self
        return replace(self.take(kept), outside=int(len(kept) - kept.sum()))

    def readings(self, space: Array) -> Array:
        """Return when and from where the detections were read (m, 3): `stereophd.core.disparity.rolling.readings`.

        `space` (30,) is the packed space of the camera at `time_s`. (0, 3) without a rolling shutter.
        """
        return NO_READINGS if self.delays is None else readings(self.delays, self.travels, self.points, space)


@dataclass(frozen=True)
class Rig:
    """The cameras, each with its disparity space."""

    cameras: tuple[Camera, ...]  # In the order of the configuration
    baseline: float  # Baseline of the abstract rectified companions, length
    rectification: Literal["horizontal", "vertical"]  # Rectification of the companions
    packed: Array  # (c, 30): Packed spaces at time 0; valid at any time if no camera moves
    moving: bool  # Whether any camera moves
    # (r,), optional: Where objects can be (`stereophd.core.geometry.region`)
    region: Array | None = None
    _kept: dict[tuple[int, float], Array] = field(default_factory=dict, init=False, compare=False, repr=False)

    def space(self, camera: int, time_s: float) -> Array:
        """Packed space (30,) of a camera at a time."""
        if not self.moving or self.cameras[camera].pose.is_static:
            return np.asarray(self.packed[camera])
        # components stay at home at the time of an earlier event: the same spaces are needed many times
        kept = self._kept.get((camera, time_s))
        if kept is None:
            if len(self._kept) >= MOST_KEPT:
                self._kept.clear()
            frozen = self.cameras[camera].at(time_s)
            kept = DisparitySpace(frozen, self.baseline, self.rectification).packed()
            self._kept[camera, time_s] = kept
        return kept

    def shares_of_view(self) -> list[float]:
        """Return the share of each camera's image that sees something of the region, at time 0."""
        if self.region is None:
            return [1.0] * len(self.cameras)
        shares = []
        for camera in (camera.at(0.0) for camera in self.cameras):
            u, v = np.meshgrid(*(np.linspace(0.0, side - 1.0, VIEW_PIXELS) for side in (camera.width, camera.height)))
            rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
            rays = rays[np.isfinite(rays).all(axis=1)] @ camera.pose.rotation
            shares.append(float(rays_meet(camera.pose.center, rays, self.region).mean()))
        return shares

    def spaces(self, cameras: NDArray[np.int64], times: Array) -> Array:
        """Packed spaces (n, 30) of components, each at home in a camera at a time."""
        if not self.moving:
            return self.packed.take(cameras, axis=0)
        out = np.empty((len(cameras), PACKED_SIZE))
        for camera, time_s in set(zip(cameras.tolist(), times.tolist(), strict=True)):
            out[(cameras == camera) & (times == time_s)] = self.space(camera, time_s)
        return out

    def numbered_spaces(self, cameras: NDArray[np.int64], times: Array) -> tuple[Array, Integers]:
        """Packed spaces (s, 30) of components, and which of them (n,) each is at home in."""
        if not self.moving:
            return self.packed, cameras
        return self.spaces(cameras, times), np.arange(len(cameras))

    def views(self, time_s: float) -> Array:
        """Packed spaces (c, 30) of all cameras at a time."""
        if not self.moving:
            return self.packed
        return np.stack([self.space(camera, time_s) for camera in range(len(self.cameras))])


def make_rig(
    cameras: Sequence[Camera],
    baseline: float,
    rectification: Literal["horizontal", "vertical"],
    region: Array | None = None,
) -> Rig:
    """Build the rig of these cameras."""
    packed = np.stack([DisparitySpace(c.at(0.0), baseline, rectification).packed() for c in cameras])
    moving = any(not camera.pose.is_static for camera in cameras)
    return Rig(tuple(cameras), baseline, rectification, packed, moving, region)


def make_event(
    camera: Camera,
    index: int,
    time_s: float,
    pixels: Array,
    sigma: Array | None = None,
    frame: int = -1,
    sizes: Array | None = None,
    rows: Integers | None = None,
) -> Event:
    """Undistort the detections of a frame, carrying their noise through the Jacobian.

    Pixels (m, 2) are as in the log, with standard deviations `sigma` (m, 2), px, by default the detector's, and with
    widths and heights `sizes` (m, 2) of boxes; `index` is that of the camera in the rig, and `rows` (m,) those of the
    log, by default numbers in the frame. The event has no detections at which the lens model cannot be inverted; it
    counts them.
    """
    std = np.empty(pixels.shape)
    std[:] = camera.detector.sigma if sigma is None else sigma
    points, covariances, areas, delays, moved = framed_detections(camera, np.full(len(pixels), time_s), pixels, std)
    order = np.lexsort((points[:, 1], points[:, 0]))
    if not (np.isfinite(points).all() and (areas > 0.0).all()):
        order = order[(np.isfinite(points).all(axis=1) & (areas > 0.0))[order]]
    # `take` is faster than an index
    return Event(
        time_s, index, points.take(order, axis=0), covariances.take(order, axis=0), areas.take(order),
        None if delays is None else delays[order], frame, len(pixels) - len(order), sigma is not None,
        pixels.take(order, axis=0), None if moved is None else moved[order], None if sizes is None else sizes[order],
        order if rows is None else rows[order]
    )  # fmt: skip


def framed_detections(
    camera: Camera, times: Array, pixels: Array, std: Array
) -> tuple[Array, Array, Array, Array | None, Array | None]:
    """Undistort detections of any frames of a camera, each in the axes of the camera at the time of its frame.

    Times of the frames are (n,), s; distorted pixels and their standard deviations are (n, 2), px. Returns points,
    covariances, areas, delays and travels as in an `Event`; a row of NaN points where a detection cannot be used.
    """
    points, covariances, areas = undistorted_detections(camera, pixels, std)
    delays = camera.row_delays(pixels[:, 1]) if camera.readout_s else None
    if delays is None or camera.pose.is_static:
        return points, covariances, areas, delays, None
    points, covariances, areas = turned_to_frame(camera, times, delays, points, covariances, areas)
    return points, covariances, areas, delays, travels(camera.pose, times, delays)


def undistorted_detections(camera: Camera, pixels: Array, std: Array) -> tuple[Array, Array, Array]:
    """Undistorted pixels (m, 2) of detections, their covariances (m, 2, 2), and areas (m,) as those of an `Event`.

    Distorted pixels and their standard deviations are (m, 2), px.
    """
    if camera.lens.code == 0:
        covariances = np.zeros((len(pixels), 2, 2))
        covariances[:, 0, 0], covariances[:, 1, 1] = std[:, 0] ** 2, std[:, 1] ** 2
        return pixels, covariances, np.ones(len(pixels))
    points, jacobian = camera.undistort_pixels(pixels)
    scaled = jacobian * std[:, None, :]
    covariances = scaled @ np.swapaxes(scaled, 1, 2)
    areas = np.abs(jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0])
    return points, covariances, areas
