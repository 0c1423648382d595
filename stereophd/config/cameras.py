"""Cameras in a configuration: intrinsics, pose, lens, detector, clock; and the file that holds nothing else."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from stereophd.config.base import Model, OneOf, Units
from stereophd.core.geometry.camera import Camera, Clock, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.lenses import lens_models
from stereophd.core.geometry.lenses.none import NoDistortion
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.geometry.trajectory import BodyTrajectory, MountedPath
from stereophd.core.settings import (
    FINITE,
    LARGEST_SIGMA_PX,
    SMALLEST_SIGMA_PX,
    Degrees,
    DegreesPerSecond,
    Pixel,
    PositiveFraction,
    PositivePixels,
    Rate,
    Time,
    Vector3,
    parameter,
)
from stereophd.io.trajectories import read_trajectory, unpack_poses

ImageSize = Annotated[int, Interval(ge=1, le=1_000_000)]
Sigma = Annotated[float, Interval(ge=SMALLEST_SIGMA_PX, le=LARGEST_SIGMA_PX), FINITE]
ClutterRate = Annotated[float, Interval(ge=0, le=1e6), FINITE]
# Logs whose times are nanoseconds have a rate of 1e-9.
ClockRate = Annotated[float, Interval(ge=1e-12, le=1e12), FINITE]
Readout = Annotated[float, Interval(ge=-1e3, le=1e3), FINITE]
Entry = Annotated[float, Interval(ge=-2, le=2), FINITE]
Row = tuple[Entry, Entry, Entry]

# A rotation matrix typed by hand with six digits passes; a reflection or a scaled matrix does not.
ROTATION_TOLERANCE = 1e-5


class IntrinsicsConfig(Model):
    """Pinhole intrinsics in pixels."""

    fx: PositivePixels = parameter("focal length along u", unit="px")
    fy: PositivePixels = parameter("focal length along v", unit="px")
    cx: Pixel = parameter("principal point along u, from the centre of the top-left pixel", unit="px")
    cy: Pixel = parameter("principal point along v, from the centre of the top-left pixel", unit="px")


class UnknownFocalConfig(Model):
    """Intrinsics of which nothing is known: the focal length starts at the width of the image."""

    focal: Literal["unknown"] = parameter("the focal length is unknown: calibrate with a wide focal_std")
    cx: Pixel | None = parameter("principal point along u; default: the middle of the image", default=None, unit="px")
    cy: Pixel | None = parameter("principal point along v; default: the middle of the image", default=None, unit="px")


def _parse_intrinsics(value: Any, info: ValidationInfo) -> Any:
    """Turn an unknown focal length into intrinsics to start from."""
    size = info.data.get("image_size_px")
    if not isinstance(value, dict) or "focal" not in value or size is None:
        return value
    given = UnknownFocalConfig.model_validate(value)
    width, height = size
    return {
        "fx": float(width),
        "fy": float(width),
        "cx": 0.5 * (width - 1.0) if given.cx is None else given.cx,
        "cy": 0.5 * (height - 1.0) if given.cy is None else given.cy,
    }


def _check_rotation(rows: Any) -> Any:
    """Refuse a matrix that is no rotation."""
    if rows is not None:
        matrix = np.asarray(rows, dtype=float)
        defect = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if defect > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
            raise ValueError(
                "expected a rotation matrix (orthonormal rows, determinant +1), found "
                f"|R R^T - I| up to {defect:.3g} and determinant {np.linalg.det(matrix):.6g}"
            )
    return rows


RotationMatrix = Annotated[tuple[Row, Row, Row], AfterValidator(_check_rotation)]
RotationVector = tuple[Degrees, Degrees, Degrees]


def _rotation(matrix: RotationMatrix | None, vector_deg: RotationVector | None) -> Any:
    """Return the rotation matrix of either form; without both, the identity."""
    if matrix is not None:
        return np.asarray(matrix, dtype=float)
    return rotation_from_vector(np.deg2rad(vector_deg or (0.0, 0.0, 0.0)))


class MountConfig(Model):
    """How a body carries a camera (hand-eye): x_camera = rotation @ (x_body - center)."""

    center: Vector3 = parameter("optical centre in the body's axes", default=(0.0, 0.0, 0.0), unit="length")
    rotation_matrix: RotationMatrix | None = parameter("rows of the rotation from body to camera axes", default=None)
    rotation_vector_deg: RotationVector | None = parameter(
        "the same rotation as axis times angle", default=None, unit="degrees"
    )

    @model_validator(mode="after")
    def _one_rotation(self) -> MountConfig:
        if self.rotation_matrix is not None and self.rotation_vector_deg is not None:
            raise ValueError("expected one of rotation_matrix and rotation_vector_deg, found both")
        return self


class TrajectoryConfig(Model):
    """A trajectory that was read from its file, as outputs keep it."""

    file: str = parameter("name of the file that it was read from")
    poses: str = parameter("its poses, packed")

    @field_validator("poses")
    @classmethod
    def _unpacks(cls, text: str) -> str:
        unpack_poses(text)
        return text

    def build(self) -> BodyTrajectory:
        """Return the `BodyTrajectory`."""
        return unpack_poses(self.poses)


class PoseConfig(Model):
    """Pose of a camera: x_camera = rotation @ (x_world - center)."""

    center: Vector3 | None = parameter(
        "optical centre in the world; required without trajectory", default=None, unit="length"
    )
    rotation_matrix: RotationMatrix | None = parameter("rows of the rotation from world to camera axes", default=None)
    rotation_vector_deg: RotationVector | None = parameter(
        "the same rotation as axis times angle", default=None, unit="degrees"
    )
    velocity: Vector3 = parameter("velocity of the centre in the world", default=(0.0, 0.0, 0.0), unit="length/s")
    rotation_rate_deg_s: tuple[DegreesPerSecond, DegreesPerSecond, DegreesPerSecond] = parameter(
        "angular velocity about the camera's own axes", default=(0.0, 0.0, 0.0), unit="deg/s"
    )
    time_s: Time = parameter("time at which center and rotation hold, for a moving camera", default=0.0, unit="s")
    trajectory: str | TrajectoryConfig | None = parameter(
        "file of the known poses of a body that carries the camera, in place of all of the above: a table time_s, x, "
        "y, z, qw, qx, qy, qz or TUM text, on true time; a path is relative to the file that names it",
        default=None,
    )
    mount: MountConfig | None = parameter("how that body carries the camera; default: they are one", default=None)

    @model_validator(mode="after")
    def _one_form(self) -> PoseConfig:
        if self.rotation_matrix is not None and self.rotation_vector_deg is not None:
            raise ValueError("expected one of rotation_matrix and rotation_vector_deg, found both")
        if self.trajectory is None:
            if self.center is None:
                raise ValueError("expected center or trajectory, found neither")
            if self.mount is not None:
                raise ValueError("mount: expected a trajectory of the body that carries the camera, found none")
            return self
        others = {"center", "rotation_matrix", "rotation_vector_deg", "velocity", "rotation_rate_deg_s", "time_s"}
        defaults = {name: field.default for name, field in type(self).model_fields.items()}
        if stated := [name for name in sorted(others) if getattr(self, name) != defaults[name]]:
            raise ValueError(f"expected nothing but mount beside trajectory, found {', '.join(stated)}")
        return self

    @property
    def moves(self) -> bool:
        """Whether the camera moves."""
        return self.trajectory is not None or any(self.velocity) or any(self.rotation_rate_deg_s)

    def build(self) -> Pose:
        """Return the `Pose`; without a rotation the camera looks along the world's z axis."""
        if self.trajectory is not None:
            mount = self.mount or MountConfig()
            file = self.trajectory
            trajectory = read_trajectory(file) if isinstance(file, str) else file.build()
            rotation = _rotation(mount.rotation_matrix, mount.rotation_vector_deg)
            return Pose.following(MountedPath(trajectory, rotation, mount.center))
        assert self.center is not None
        return Pose(
            rotation=_rotation(self.rotation_matrix, self.rotation_vector_deg),
            center=np.asarray(self.center, dtype=float),
            velocity=np.asarray(self.velocity, dtype=float),
            rotation_rate=np.deg2rad(self.rotation_rate_deg_s),
            time_s=self.time_s,
        )


class DetectorConfig(Model):
    """The detector of a camera: noise, misses and false detections."""

    sigma_px: tuple[Sigma, Sigma] = parameter(
        "standard deviation of a detection along u and v",
        unit="px",
        advice="the spread of detections of an object that stands still. Errors of lens and pose count as noise.",
    )
    p_detect: PositiveFraction = parameter(
        "probability that an object in view is detected",
        advice="the share of frames in which an object in view is detected.",
    )
    clutter_per_frame: ClutterRate = parameter(
        "mean number of false detections a frame, uniform in the image",
        advice="false detections divided by frames; do not write 0 unless there are none.",
    )
    estimate: bool = parameter(
        "estimate these from the log, starting from the values given (track); see also detector", default=False
    )


# Where `detector: estimate` starts without values of its own: rather too noisy than too sure, so that the
# first pass loses no track.
UNKNOWN_DETECTOR = {"sigma_px": (3.0, 3.0), "p_detect": 0.9, "clutter_per_frame": 1.0, "estimate": True}


def _parse_detector(value: Any) -> Any:
    """Turn the short form ``estimate`` into values to start from."""
    if value == "estimate":
        return UNKNOWN_DETECTOR
    if isinstance(value, str):
        raise ValueError(f"expected estimate or sigma_px, p_detect and clutter_per_frame, found {value}")
    if isinstance(value, dict) and isinstance(value.get("sigma_px"), list):
        # behind a validator of our own pydantic no longer knows that lists are JSON's tuples
        return {**value, "sigma_px": tuple(value["sigma_px"])}
    return value


def _lenses() -> dict[str, Any]:
    return {name: model.settings for name, model in lens_models().items()}


Distortion = Annotated[Any, OneOf(_lenses, "model")]


class ClockConfig(Model):
    """Clock of a camera: true time = offset_s + rate * time in the log."""

    offset_s: Time = parameter("true time at time 0 of the log", default=0.0, unit="s")
    rate: ClockRate = parameter("true seconds in a second of the log", default=1.0)


class CameraConfig(Model):
    """One camera, as in ``cameras.yaml``."""

    image_size_px: tuple[ImageSize, ImageSize] = parameter("width and height", unit="px")
    intrinsics: Annotated[
        IntrinsicsConfig,
        BeforeValidator(_parse_intrinsics, json_schema_input_type=IntrinsicsConfig | UnknownFocalConfig),
    ] = parameter("pinhole intrinsics; focal: unknown starts at the width of the image (calibrate)", unit="px")
    pose: PoseConfig = parameter("where the camera stands and looks")
    detector: Annotated[
        DetectorConfig,
        BeforeValidator(_parse_detector, json_schema_input_type=DetectorConfig | Literal["estimate"]),
    ] = parameter("what its detector does, or estimate: all of it is estimated from the log (track)")
    distortion: Distortion = parameter("of the lens", default_factory=NoDistortion)
    frame_rate_hz: Rate | None = parameter(
        "frames per second (simulate)",
        default=None,
        unit="Hz",
        advice="needed by simulate only; logs carry their times.",
    )
    phase_s: Time = parameter("time of the first frame after the start (simulate)", default=0.0, unit="s")
    clock: ClockConfig = parameter("from the log's time to true time", default_factory=ClockConfig)
    readout_s: Readout = parameter(
        "rolling shutter: a detection in row v was made readout_s * v / height after the time of its frame, s; "
        "negative: read from the bottom up",
        default=0.0,
        advice="0 for a global shutter; of a rolling shutter at most the time between two frames.",
    )

    @model_validator(mode="after")
    def _readout_at_rest(self) -> CameraConfig:
        if self.readout_s != 0.0 and self.pose.moves:
            raise ValueError(f"readout_s: expected 0 of a camera that moves, found {self.readout_s:g}")
        return self

    def build(self, name: str) -> Camera:
        """Return the geometric `Camera` of this name."""
        values = asdict(self.distortion)
        model = values.pop("model")
        return Camera(
            name=name,
            width=self.image_size_px[0],
            height=self.image_size_px[1],
            fx=self.intrinsics.fx,
            fy=self.intrinsics.fy,
            cx=self.intrinsics.cx,
            cy=self.intrinsics.cy,
            pose=self.pose.build(),
            lens=Lens(model, **values),
            detector=Detector(
                sigma=self.detector.sigma_px,
                p_detect=self.detector.p_detect,
                clutter_per_frame=self.detector.clutter_per_frame,
            ),
            frame_rate_hz=self.frame_rate_hz,
            phase_s=self.phase_s,
            clock=Clock(self.clock.offset_s, self.clock.rate),
            readout_s=self.readout_s,
        )


class CamerasFile(Model):
    """A ``cameras.yaml`` file: the cameras, and the unit that their centres are in."""

    units: Units
    cameras: Annotated[dict[str, CameraConfig], Field(min_length=1)]
