"""Cameras in a configuration: intrinsics, pose, lens, detector, clock; and the file that holds nothing else."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, field_validator, model_validator

from stereophd.config.base import Finite, Model, NonNegative, Positive, Units, Vector3
from stereophd.core.geometry.camera import Camera, Clock, Detector
from stereophd.core.geometry.lens import PARAMETERS, Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.errors import InputError

# A rotation matrix typed by hand with six digits passes; a reflection or a scaled matrix does not.
ROTATION_TOLERANCE = 1e-5


class IntrinsicsConfig(Model):
    """Pinhole intrinsics in pixels."""

    fx: Positive = Field(description="focal length along u, px")
    fy: Positive = Field(description="focal length along v, px")
    cx: Finite = Field(description="principal point, px from the centre of the top-left pixel")
    cy: Finite = Field(description="principal point, px from the centre of the top-left pixel")


class PoseConfig(Model):
    """Pose of a camera: x_camera = rotation @ (x_world - center)."""

    center: Vector3 = Field(description="optical centre in the world")
    rotation_matrix: tuple[Vector3, Vector3, Vector3] | None = Field(
        None, description="rows of the rotation from world to camera axes"
    )
    rotation_vector_deg: Vector3 | None = Field(None, description="the same rotation as axis times angle, degrees")
    velocity: Vector3 = Field((0.0, 0.0, 0.0), description="velocity of the centre in the world, length/s")
    rotation_rate_deg_s: Vector3 = Field(
        (0.0, 0.0, 0.0), description="angular velocity about the camera's own axes, deg/s"
    )
    time_s: Finite = Field(0.0, description="time at which center and rotation hold, for a moving camera")

    @field_validator("rotation_matrix")
    @classmethod
    def _is_rotation(cls, rows: Any) -> Any:
        if rows is not None:
            matrix = np.asarray(rows, dtype=float)
            defect = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
            if defect > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
                raise ValueError(
                    "expected a rotation matrix (orthonormal rows, determinant +1), found "
                    f"|R R^T - I| up to {defect:.3g} and determinant {np.linalg.det(matrix):.6g}"
                )
        return rows

    @model_validator(mode="after")
    def _one_rotation(self) -> PoseConfig:
        if self.rotation_matrix is not None and self.rotation_vector_deg is not None:
            raise ValueError("expected one of rotation_matrix and rotation_vector_deg, found both")
        return self

    def build(self) -> Pose:
        """Return the `Pose`; without a rotation the camera looks along the world's z axis."""
        if self.rotation_matrix is not None:
            rotation = np.asarray(self.rotation_matrix, dtype=float)
        else:
            rotation = rotation_from_vector(np.deg2rad(self.rotation_vector_deg or (0.0, 0.0, 0.0)))
        return Pose(
            rotation=rotation,
            center=np.asarray(self.center, dtype=float),
            velocity=np.asarray(self.velocity, dtype=float),
            rotation_rate=np.deg2rad(self.rotation_rate_deg_s),
            time_s=self.time_s,
        )


class DetectorConfig(Model):
    """What the detector of a camera does: noise, misses and false detections."""

    sigma_px: tuple[Positive, Positive] = Field(description="standard deviation of a detection along u and v, px")
    p_detect: Annotated[float, Field(gt=0, le=1)] = Field(description="probability that an object in view is detected")
    clutter_per_frame: NonNegative = Field(description="mean number of false detections a frame, uniform in the image")
    estimate: bool = Field(
        False, description="estimate these from the log, starting from the values given (track); see also detector"
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


class NoDistortion(Model):
    """No lens distortion."""

    model: Literal["none"] = Field("none", description="the lens model")


class RadialDistortion(Model):
    """One-parameter radial distortion: x_distorted = x (1 + k1 r^2)."""

    model: Literal["radial"] = Field(description="the lens model")
    k1: Finite = Field(description="of r^2, r the distance from the axis at depth 1")


class BrownConradyDistortion(Model):
    """OpenCV's rational model: k1..k6 radial, p1, p2 tangential."""

    model: Literal["brown_conrady"] = Field(description="the lens model")
    k1: Finite = Field(0.0, description="radial, of r^2 in the numerator")
    k2: Finite = Field(0.0, description="radial, of r^4 in the numerator")
    p1: Finite = Field(0.0, description="tangential")
    p2: Finite = Field(0.0, description="tangential")
    k3: Finite = Field(0.0, description="radial, of r^6 in the numerator")
    k4: Finite = Field(0.0, description="radial, of r^2 in the denominator")
    k5: Finite = Field(0.0, description="radial, of r^4 in the denominator")
    k6: Finite = Field(0.0, description="radial, of r^6 in the denominator")


class FisheyeDistortion(Model):
    """OpenCV's fisheye model: theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8)."""

    model: Literal["fisheye"] = Field(description="the lens model")
    k1: Finite = Field(0.0, description="of theta^2, theta the angle from the axis")
    k2: Finite = Field(0.0, description="of theta^4")
    k3: Finite = Field(0.0, description="of theta^6")
    k4: Finite = Field(0.0, description="of theta^8")


Distortion = Annotated[
    NoDistortion | RadialDistortion | BrownConradyDistortion | FisheyeDistortion,
    Field(discriminator="model"),
]


class ClockConfig(Model):
    """Clock of a camera: true time = offset_s + rate * time in the log."""

    offset_s: Finite = Field(0.0, description="true time at time 0 of the log, s")
    rate: Positive = Field(1.0, description="true seconds in a second of the log")


class CameraConfig(Model):
    """One camera, as in ``cameras.yaml``."""

    image_size_px: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] = Field(
        description="width and height, px"
    )
    intrinsics: IntrinsicsConfig = Field(description="pinhole intrinsics, px")
    pose: PoseConfig = Field(description="where the camera stands and looks")
    detector: Annotated[
        DetectorConfig,
        BeforeValidator(_parse_detector, json_schema_input_type=DetectorConfig | Literal["estimate"]),
    ] = Field(description="what its detector does, or estimate: all of it is estimated from the log (track)")
    distortion: Distortion = Field(default_factory=NoDistortion, description="of the lens")
    frame_rate_hz: Positive | None = Field(None, description="frames per second (simulate)")
    phase_s: Finite = Field(0.0, description="time of the first frame after the start (simulate)")
    clock: ClockConfig = Field(default_factory=ClockConfig, description="from the log's time to true time")
    readout_s: Finite = Field(
        0.0,
        description="rolling shutter: a detection in row v was made readout_s * v / height after the time of its "
        "frame, s; negative: read from the bottom up",
    )

    @model_validator(mode="after")
    def _readout_at_rest(self) -> CameraConfig:
        if self.readout_s != 0.0 and (any(self.pose.velocity) or any(self.pose.rotation_rate_deg_s)):
            raise ValueError(f"readout_s: expected 0 of a camera that moves, found {self.readout_s:g}")
        return self

    def build(self, name: str) -> Camera:
        """Return the geometric `Camera` of this name."""
        values = self.distortion.model_dump()
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


def camera_config(camera: Camera) -> CameraConfig:
    """Return the configuration that builds a camera.

    Raises
    ------
    InputError
        A value lies outside what a configuration allows.
    """
    lens = {name: getattr(camera.lens, name) for name in PARAMETERS[camera.lens.model]}
    pose = camera.pose
    values = {
        "image_size_px": [camera.width, camera.height],
        "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        "pose": {
            "center": pose.center.tolist(),
            "rotation_matrix": pose.rotation.tolist(),
            "velocity": pose.velocity.tolist(),
            "rotation_rate_deg_s": np.degrees(pose.rotation_rate).tolist(),
            "time_s": pose.time_s,
        },
        "detector": {
            "sigma_px": camera.detector.sigma.tolist(),
            "p_detect": camera.detector.p_detect,
            "clutter_per_frame": camera.detector.clutter_per_frame,
        },
        "distortion": {"model": camera.lens.model, **lens},
        "frame_rate_hz": camera.frame_rate_hz,
        "phase_s": camera.phase_s,
        "clock": {"offset_s": camera.clock.offset_s, "rate": camera.clock.rate},
        "readout_s": camera.readout_s,
    }
    try:
        return CameraConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"camera {camera.name}: {where}: {first['msg']}") from None


class CamerasFile(Model):
    """A ``cameras.yaml`` file: the cameras, and the unit that their centres are in."""

    units: Units
    cameras: Annotated[dict[str, CameraConfig], Field(min_length=1)]
