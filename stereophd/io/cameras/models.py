"""Cameras in a configuration: intrinsics, pose, lens, detector, clock; and the file that holds nothing else."""

from dataclasses import asdict
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from annotated_types import Interval
from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.registry import component_names
from stereophd.core.geometry.camera import BOX_NOISE, Camera, Clock, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.lenses import lens_models
from stereophd.core.geometry.lenses.none import NoDistortion
from stereophd.core.geometry.pose import Pose
from stereophd.core.settings import (
    FINITE,
    LARGEST_SIGMA_PX,
    SMALLEST_SIGMA_PX,
    Pixel,
    PositiveFraction,
    PositivePixels,
    Rate,
    Time,
    parameter,
)
from stereophd.io.cameras.poses import LaterPoseConfig, PoseConfig, parse_pose, with_tuples
from stereophd.validated import Model, OneOf, Units

ImageSize = Annotated[int, Interval(ge=1, le=1_000_000)]
Sigma = Annotated[float, Interval(ge=SMALLEST_SIGMA_PX, le=LARGEST_SIGMA_PX), FINITE]
ClutterRate = Annotated[float, Interval(ge=0, le=1e6), FINITE]
# Logs whose times are nanoseconds have a rate of 1e-9.
ClockRate = Annotated[float, Interval(ge=1e-12, le=1e12), FINITE]
Readout = Annotated[float, Interval(ge=-1e3, le=1e3), FINITE]


class IntrinsicsConfig(Model):
    """Pinhole intrinsics in pixels."""

    fx: PositivePixels = parameter("focal length along u", unit="px")
    fy: PositivePixels = parameter("focal length along v", unit="px")
    cx: Pixel = parameter("principal point along u, from the centre of the top-left pixel", unit="px")
    cy: Pixel = parameter("principal point along v, from the centre of the top-left pixel", unit="px")
    unknown: bool = parameter("the focal length is a guess (focal: unknown)", default=False)


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
        "unknown": True,
    }


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
        "mean number of false detections per frame, uniform in the image",
        advice="false detections divided by frames; do not write 0 unless there are none.",
    )
    box_noise: tuple[PositiveFraction, PositiveFraction, PositiveFraction, PositiveFraction] | None = parameter(
        "standard deviations of the middle u, the top, the bottom and the width of a box, as parts of its height, "
        f"beside 3 px; default: {', '.join(f'{part:g}' for part in BOX_NOISE)}",
        default=None,
        advice="measured for detectors of people; only where object.shape is ellipsoid, in place of sigma_px.",
    )
    estimate: bool = parameter("estimate these from the log (track); see also detector", default=False)


# Where `detector: estimate` starts without values of its own: rather too noisy than too sure, so that the
# first pass loses no track.
UNKNOWN_DETECTOR = {"sigma_px": (3.0, 3.0), "p_detect": 0.9, "clutter_per_frame": 1.0, "estimate": True}


def _parse_detector(value: Any) -> Any:
    """Turn the short form ``estimate`` into values to start from."""
    if value == "estimate":
        return UNKNOWN_DETECTOR
    if isinstance(value, str):
        raise ValueError(f"expected estimate or sigma_px, p_detect and clutter_per_frame, found {value}")
    return with_tuples(value)


Distortion = Annotated[Any, OneOf(lambda: {word: lens.settings for word, lens in lens_models().items()}, "model")]


class ClockConfig(Model):
    """Clock of a camera: true time = offset_s + rate * time in the log."""

    offset_s: Time = parameter("true time at time 0 of the log", default=0.0, unit="s")
    rate: ClockRate = parameter("true seconds in a second of the log", default=1.0)
    unknown: bool = parameter("the offset is unknown (offset_s: unknown)", default=False)


class UnknownClockConfig(Model):
    """A clock of which nothing is known: calibrate finds its offset from the tracks alone."""

    offset_s: Literal["unknown"] = parameter("true time at time 0 of the log")
    rate: ClockRate = parameter("true seconds in a second of the log, about which calibrate looks", default=1.0)


def _parse_clock(value: Any) -> Any:
    """Turn an unknown offset into a clock to start from."""
    if not isinstance(value, dict) or not isinstance(value.get("offset_s"), str):
        return value
    return {"offset_s": 0.0, "rate": UnknownClockConfig.model_validate(value).rate, "unknown": True}


class CameraConfig(Model):
    """One camera, as in ``cameras.yaml``."""

    image_size_px: tuple[ImageSize, ImageSize] = parameter("width and height", unit="px")
    intrinsics: Annotated[
        IntrinsicsConfig,
        BeforeValidator(_parse_intrinsics, json_schema_input_type=IntrinsicsConfig | UnknownFocalConfig),
    ] = parameter("pinhole intrinsics; focal: unknown starts at the width of the image (calibrate)", unit="px")
    pose: Annotated[PoseConfig, BeforeValidator(parse_pose, json_schema_input_type=PoseConfig | Literal["unknown"])] = (
        parameter("where the camera stands and looks, or unknown: calibrate finds it from the tracks alone")
    )
    poses: tuple[LaterPoseConfig, ...] = parameter(
        "poses that hold from a time on, in place of the one before: of a camera that was knocked, or put elsewhere",
        default=(),
    )
    detector: Annotated[
        DetectorConfig, BeforeValidator(_parse_detector, json_schema_input_type=DetectorConfig | Literal["estimate"])
    ] = parameter(
        "what its detector does, or estimate: all of it is estimated from the log (init, track)",
        default_factory=lambda: DetectorConfig(**UNKNOWN_DETECTOR),
    )
    distortion: Distortion = parameter("the distortion of the lens", default_factory=NoDistortion)
    frame_rate_hz: Rate | None = parameter(
        "frames per second (simulate)",
        default=None,
        unit="Hz",
        advice="needed by simulate only; logs carry their times.",
    )
    phase_s: Time = parameter("time of the first frame after the start (simulate)", default=0.0, unit="s")
    clock: Annotated[
        ClockConfig, BeforeValidator(_parse_clock, json_schema_input_type=ClockConfig | UnknownClockConfig)
    ] = parameter("how the times of the log become true times", default_factory=ClockConfig)
    readout_s: Readout = parameter(
        "rolling shutter: a detection in row v was made readout_s * v / height after the time of its frame, s; "
        "negative: read from the bottom up",
        default=0.0,
        advice="0 for a global shutter; for a rolling shutter at most the time between two frames.",
    )

    @model_validator(mode="after")
    def _poses_rise(self) -> Self:
        times = [pose.from_s for pose in self.poses]
        if any(after <= before for before, after in pairwise(times)):
            raise ValueError(f"poses: expected rising from_s, found {', '.join(f'{time_s:g}' for time_s in times)}")
        if self.poses and (self.pose.unknown or not self.pose.build().is_static):
            raise ValueError("poses: expected a known pose that stands still before them, found another")
        return self

    @property
    def must_be_found(self) -> bool:
        """Whether its pose or its clock is unknown, so that `calibrate` searches for the poses of all cameras."""
        return self.pose.unknown or self.clock.unknown

    @property
    def unknown_key(self) -> str | None:
        """The key of a value that is unknown, so that nothing but `calibrate` can use the camera; None: it is known."""
        unknown = {
            "pose": self.pose.unknown, "clock.offset_s": self.clock.unknown, "intrinsics.focal": self.intrinsics.unknown
        }  # fmt: skip
        return next((key for key, is_unknown in unknown.items() if is_unknown), None)

    def build(self, name: str) -> Camera:
        """Return the geometric `Camera` of this name; an unknown pose is the origin, and an unknown offset 0."""
        values = asdict(self.distortion)
        model, pose = values.pop("model"), self.pose.build()
        return Camera(
            name=name,
            width=self.image_size_px[0],
            height=self.image_size_px[1],
            fx=self.intrinsics.fx,
            fy=self.intrinsics.fy,
            cx=self.intrinsics.cx,
            cy=self.intrinsics.cy,
            pose=Pose.in_steps(pose, [(each.from_s, each.build()) for each in self.poses]) if self.poses else pose,
            lens=Lens(model, **values),
            detector=Detector(
                sigma=np.array(self.detector.sigma_px),
                p_detect=self.detector.p_detect,
                clutter_per_frame=self.detector.clutter_per_frame,
                box_noise=self.detector.box_noise or BOX_NOISE,
            ),
            frame_rate_hz=self.frame_rate_hz,
            phase_s=self.phase_s,
            clock=Clock(self.clock.offset_s, self.clock.rate),
            readout_s=self.readout_s,
        )


# ``camera.component`` -> its covariances with the values before it and with itself: rows of a lower triangle.
CovarianceRows = dict[str, list[Annotated[float, FINITE]]]


def covariance_of(rows: CovarianceRows, cameras: tuple[str, ...]) -> Array:
    """Return the covariance (m, m) of such rows; ValueError if they are no covariance of components of the cameras."""
    matrix = np.zeros((len(rows), len(rows)))
    for number, (name, row) in enumerate(rows.items()):
        camera, _, component = name.rpartition(".")
        if camera not in cameras or component not in component_names():
            raise ValueError(f"covariance: expected CAMERA.COMPONENT, such as {cameras[0]}.center_x, found {name}")
        if len(row) != number + 1 or not row[-1] > 0.0:
            raise ValueError(f"covariance.{name}: expected {number + 1} numbers, the last above 0, found {row}")
        matrix[number, : number + 1] = matrix[: number + 1, number] = row
    std = np.sqrt(np.diag(matrix))
    if len(rows) and np.linalg.eigvalsh(matrix / np.outer(std, std))[0] < -1e-6:
        raise ValueError("covariance: expected a matrix without negative eigenvalues, found one with them")
    return matrix


class CamerasFile(Model):
    """A ``cameras.yaml`` file: the cameras, and the unit that their centres are in."""

    units: Units
    cameras: Annotated[dict[str, CameraConfig], Field(min_length=1)]
    covariance: CovarianceRows | None = None

    @model_validator(mode="after")
    def _has_covariance(self) -> Self:
        covariance_of(self.covariance or {}, tuple(self.cameras))
        return self
