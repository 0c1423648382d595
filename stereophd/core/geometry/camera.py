"""A camera: pinhole, lens, pose, detector and clock, and the maps between world and pixels."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry import layout
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose
from stereophd.core.geometry.trajectory import EqualByValue, frozen

Time = TypeVar("Time", float, Array)

# Noise of the boxes of detectors of people: see `Detector.box_noise`.
BOX_NOISE = (0.06, 0.045, 0.05, 0.09)

# Where none is stated, a false detection in a hundred frames is expected: else any one would be an object for certain.
LEAST_CLUTTER = 0.01


@dataclass(frozen=True, init=False, eq=False)
class Detector(EqualByValue):
    """A camera's detector: noise, misses and false detections; ValueError if a value is out of its range.

    Attributes
    ----------
    sigma : (2,), standard deviation of a detection along u and v, px; a read-only copy
    p_detect : probability that an object in view is detected
    clutter_per_frame : mean number of false detections per frame, uniform over the image
    box_noise : (4,), standard deviations of middle u, top, bottom and width of a box, as parts of its height
    """

    sigma: Array
    p_detect: float
    clutter_per_frame: float
    box_noise: tuple[float, float, float, float]

    def __init__(
        self, sigma: ArrayLike, p_detect: float, clutter_per_frame: float, box_noise: Iterable[float] = BOX_NOISE
    ) -> None:
        values = frozen(sigma)
        if values.shape != (2,) or not (values > 0.0).all() or not np.isfinite(values).all():
            raise ValueError(f"detector: expected two positive standard deviations, found {sigma!r}")
        if not 0.0 <= p_detect <= 1.0:
            raise ValueError(f"detector: expected p_detect in [0, 1], found {p_detect}")
        if not 0.0 <= clutter_per_frame < np.inf:
            raise ValueError(f"detector: expected clutter_per_frame >= 0, found {clutter_per_frame}")
        self.__dict__.update(sigma=values, p_detect=float(p_detect), clutter_per_frame=float(clutter_per_frame))
        self.__dict__.update(box_noise=tuple(box_noise))

    @property
    def expected_clutter(self) -> float:
        """Mean number of false detections per frame that estimators expect, at least `LEAST_CLUTTER`."""
        return max(self.clutter_per_frame, LEAST_CLUTTER)


@dataclass(frozen=True)
class Clock:
    """Clock of a camera: true time = offset_s + rate * time in the log, both in seconds."""

    offset_s: float = 0.0
    rate: float = 1.0

    def to_true(self, t: Time) -> Time:
        """Return the true time of a time on this clock."""
        return self.offset_s + self.rate * t

    def to_log(self, t: Time) -> Time:
        """Return the time on this clock of a true time."""
        return (t - self.offset_s) / self.rate


@dataclass(frozen=True)
class Camera:
    """A camera of a name, with everything that a filter or a simulator needs to know about it.

    Camera axes: x right, y down, z forward. Pixel (0, 0) is the centre of the top-left pixel (OpenCV).
    Undistorted pixels are those of the pinhole camera with the same intrinsics; detections are distorted pixels. Raises
    ValueError if the image size or a focal length is not positive.

    A rolling shutter exposes row v of the distorted image ``readout_s * v / height`` after the time of the frame, which
    is that of row 0; one with a negative readout reads from the bottom up, one of zero all rows at once.

    Attributes
    ----------
    name : as in logs and configurations
    width, height : image size, px
    fx, fy : focal lengths along u and v, px
    cx, cy : principal point, px
    pose : in the world; of a moving camera, at ``pose.time_s``
    lens, detector, clock : distortion; noise, misses and false detections; the camera's own clock
    frame_rate_hz : frames per second, for simulation; None if it is not stated
    phase_s : time of the first frame after the start, s, for simulation
    readout_s : time from the first row of the image to the one after the last, s
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    pose: Pose
    lens: Lens
    detector: Detector
    frame_rate_hz: float | None = None
    phase_s: float = 0.0
    clock: Clock = field(default_factory=Clock)
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ValueError(f"camera {self.name}: expected a positive {name}, found {value}")
        if not np.isfinite([self.cx, self.cy]).all():
            raise ValueError(f"camera {self.name}: expected a finite cx, cy, found {self.cx}, {self.cy}")

    def at(self, time_s: float) -> Self:
        """Return the camera with its pose at a true time, s; the camera itself if it does not move."""
        if self.pose.is_static:
            return self
        return replace(self, pose=self.pose.at(time_s))

    def with_noise(self, sigma_px: Array | float) -> Self:
        """Return the camera with another noise of its detector, (2,) or one along both axes, px."""
        return replace(self, detector=replace(self.detector, sigma=np.broadcast_to(sigma_px, 2)))

    def row_delays(self, rows: Array) -> Array:
        """Return when rows (...,) of the distorted image are read, s after the frame's time; 0 without readout."""
        return self.readout_s / self.height * rows

    @property
    def readout_span(self) -> tuple[float, float]:
        """Times of the first and the last row after that of a frame, s, in order of time."""
        return min(self.readout_s, 0.0), max(self.readout_s, 0.0)

    @property
    def intrinsic_matrix(self) -> Array:
        """Intrinsic matrix K (3, 3), px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def projection_matrix(self) -> Array:
        """Projection matrix K R [I | -c] (3, 4) from the world to homogeneous undistorted pixels."""
        rotation = self.pose.rotation
        extrinsic = np.column_stack([rotation, -rotation @ self.pose.center])
        return np.asarray(self.intrinsic_matrix @ extrinsic, dtype=np.float64)

    def project(self, x_world: ArrayLike) -> Array:
        """Project world positions (n, 3) into the image.

        Returns distorted pixels (n, 2), inside the image or not; a row of NaN where the depth is not positive or the
        point is beyond the lens's `max_radius`.
        """
        x = self.pose.to_camera(x_world)
        depth = np.where(x[:, 2] > 0.0, x[:, 2], np.nan)
        xy = x[:, :2] / depth[:, None]
        if self.lens.model != "none":
            seen = np.einsum("ni,ni->n", xy, xy) <= self.lens.max_radius**2
            xy = self.lens.distort(np.where(seen[:, None], xy, np.nan))[0]
        return self._to_pixels(xy)

    def project_at(self, x_world: ArrayLike, times: Array) -> Array:
        """Project world positions (n, 3) at true times (n,), s, each with the pose of its own time; see `project`."""
        if self.pose.is_static:
            return self.project(x_world)
        motions = self.pose.motions(times)
        seen = np.einsum("nij,nj->ni", motions.rotations, np.asarray(x_world, dtype=np.float64) - motions.centers)
        return replace(self, pose=Pose(np.eye(3), np.zeros(3))).project(seen)

    def unproject(self, pixels: ArrayLike, depth: ArrayLike) -> Array:
        """Return the world positions (n, 3) of distorted pixels (n, 2) at depths (n,) along the optical axis, length.

        A row has NaN where a pixel cannot be undistorted.
        """
        return self.pose.to_world(self.rays(pixels) * np.asarray(depth, dtype=np.float64)[:, None])

    def rays(self, pixels: ArrayLike) -> Array:
        """Return the rays (n, 3) of distorted pixels (n, 2) in the camera's frame, with depth 1.

        A row has NaN where a pixel cannot be undistorted.
        """
        xy, _ = self.lens.undistort(self._to_normalised(pixels))
        return np.column_stack([xy, np.ones(len(xy))])

    def pinhole_rays(self, points: ArrayLike) -> Array:
        """Return the rays (n, 3) of undistorted pixels (n, 2) in the camera's frame, with depth 1."""
        xy = self._to_normalised(points)
        return np.column_stack([xy, np.ones(len(xy))])

    def in_view(self, x_world: ArrayLike) -> Booleans:
        """Return which world positions (n, 3) the camera sees, as bool (n,).

        Seen is what lies in front of the camera, within the lens's `max_radius`, and whose distorted
        pixel is in the image: ``-0.5 <= u <= width - 0.5`` and likewise v. Occlusion is not modelled.
        """
        return self.contains(self.project(x_world))

    def contains(self, pixels: ArrayLike, margin_px: float = 0.0) -> Booleans:
        """Return which distorted pixels (n, 2) are in the image, or so near it, as bool (n,); False for NaN."""
        uv = np.asarray(pixels, dtype=np.float64) + 0.5
        inside = (uv >= -margin_px) & (uv <= np.array([self.width, self.height]) + margin_px)
        return np.asarray(inside.all(axis=1), dtype=np.bool_)

    def undistort_pixels(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Undistort pixels (n, 2), with the Jacobian that carries their noise along.

        Returns the pixels (n, 2) of the pinhole camera, NaN where there are none, and d undistorted / d distorted (n,
        2, 2): a covariance C becomes J C J^T.
        """
        xy, jacobian = self.lens.undistort(self._to_normalised(pixels))
        return self._to_pixels(xy), self._jacobian_in_pixels(jacobian)

    def distort_pixels(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Distort pixels (n, 2) of the pinhole camera, the inverse of `undistort_pixels`.

        Returns pixels (n, 2) in the image and d distorted / d undistorted (n, 2, 2). Whether a pixel is within the
        lens's `max_radius` is not checked.
        """
        xy_d, jacobian = self.lens.distort(self._to_normalised(pixels))
        return self._to_pixels(xy_d), self._jacobian_in_pixels(jacobian)

    def packed(self) -> Array:
        """Return the camera as (28,) numbers for compiled kernels, in the layout of `geometry.layout`."""
        result = np.empty(layout.PACKED_SIZE)
        result[layout.FX : layout.CENTER] = self.fx, self.fy, self.cx, self.cy, self.width, self.height
        result[layout.CENTER : layout.ROTATION] = self.pose.center
        result[layout.ROTATION : layout.LENS_CODE] = self.pose.rotation.ravel()
        result[layout.LENS_CODE] = self.lens.code
        result[layout.LENS_COEFFICIENTS : layout.MAX_RADIUS] = self.lens.coefficients
        result[layout.MAX_RADIUS] = self.lens.max_radius
        return result

    def _to_normalised(self, pixels: ArrayLike) -> Array:
        uv = np.asarray(pixels, dtype=np.float64)
        return np.asarray((uv - [self.cx, self.cy]) / [self.fx, self.fy], dtype=np.float64)

    def _to_pixels(self, xy: Array) -> Array:
        return np.asarray(xy * [self.fx, self.fy] + [self.cx, self.cy], dtype=np.float64)

    def _jacobian_in_pixels(self, jacobian: Array) -> Array:
        focal = np.array([self.fx, self.fy])
        return np.asarray(jacobian * (focal[:, None] / focal), dtype=np.float64)
