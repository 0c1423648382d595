"""Configuration models: what a YAML file may say, with units, limits and defaults.

Lengths are in the unit that ``units.length`` names, times in seconds, pixels as floats with (0, 0)
at the centre of the top-left pixel; angles are in degrees where the key ends in ``_deg``. Unknown
keys are errors. Reading files, overrides and error messages live in `stereophd.config_loading`.
"""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, field_validator, model_validator

from stereophd.config_base import Finite, Model, NonNegative, Positive, Vector3
from stereophd.config_calibration import CalibrationConfig
from stereophd.config_experiment import ExperimentConfig
from stereophd.config_single import DisparityPrior, SingleConfig
from stereophd.geometry.camera import Camera, Clock, Detector
from stereophd.geometry.lens import Lens
from stereophd.geometry.pose import Pose, rotation_from_vector

# A rotation matrix typed by hand with six digits passes; a reflection or a scaled matrix does not.
ROTATION_TOLERANCE = 1e-5


class Units(Model):
    """Units of all files of a run."""

    length: Literal["mm", "cm", "m", "km"] = Field("m", description="unit of length of positions and baselines")


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


class CamerasFile(Model):
    """A ``cameras.yaml`` file: the cameras, and the unit that their centres are in."""

    units: Units
    cameras: Annotated[dict[str, CameraConfig], Field(min_length=1)]


class DisparityConfig(Model):
    """Disparity space of every camera (paper eq. 3): d = f * baseline / z."""

    baseline: Positive = Field(1.0, description="baseline of the abstract rectified companion, length")
    rectification: Literal["horizontal", "vertical"] = Field(
        "horizontal", description="whether the companion is beside (f = fx) or below (f = fy) the camera"
    )


class MotionConfig(Model):
    """How objects move between events."""

    model: Literal["constant_velocity", "static"] = Field("constant_velocity", description="static: nothing moves")
    acceleration_std: NonNegative | tuple[NonNegative, NonNegative, NonNegative] = Field(
        0.0,
        description="white acceleration in the world, one value or one per axis: standard deviation of the "
        "mean acceleration over 1 s, length/s^2 (spectral density acceleration_std^2 times 1 s)",
    )
    max_speed: Positive | None = Field(
        None, description="physical limit on speed, length/s; samples above it are scaled back to it"
    )


FEWEST_QMC_SAMPLES = 64


class MomentsConfig(Model):
    """How a Gaussian is carried from one disparity space to another (paper IV-B, V-B, VI-C)."""

    method: Literal["adaptive", "qmc", "particle", "unscented", "linear"] = Field(
        "qmc",
        description="qmc: scrambled Sobol points; particle: pseudo-random, as the paper has it; adaptive: a low-order "
        "rule for each component over which the map is nearly linear, Sobol points for the others; unscented, linear: "
        "low-order rules throughout",
    )
    samples: Annotated[int, Field(ge=16, le=65536)] = Field(
        64, description="samples per Gaussian (qmc, adaptive: a power of two, at least 64)"
    )
    max_nonlinearity: Positive = Field(
        0.03,
        description="adaptive: components are sampled above this curvature of one standard deviation, in standard "
        "deviations of the result",
    )

    @model_validator(mode="after")
    def _power_of_two(self) -> MomentsConfig:
        # mirrored points in twelve dimensions need 48 to have a covariance of full rank
        wanting = self.samples < FEWEST_QMC_SAMPLES or self.samples & (self.samples - 1)
        if self.method in ("qmc", "adaptive") and wanting:
            expected = f"a power of two of at least {FEWEST_QMC_SAMPLES} for method {self.method}"
            raise ValueError(f"samples: expected {expected}, found {self.samples}")
        return self


class BirthConfig(Model):
    """Observation-driven birth (paper VI-B): every detection may be a new object."""

    per_frame: Positive = Field(0.1, description="expected number of new objects a frame, uniform over the image")
    disparity: DisparityPrior | None = Field(None, description="prior of the disparity, px at the baseline")
    depth_range: tuple[Positive, Positive] | None = Field(
        None, description="near and far depth, length: two standard deviations either side in disparity"
    )
    velocity_std: Positive = Field(description="standard deviation of each component of velocity, length/s")

    @model_validator(mode="after")
    def _one_prior(self) -> BirthConfig:
        if (self.disparity is None) == (self.depth_range is None):
            raise ValueError("expected exactly one of disparity and depth_range")
        if self.depth_range is not None and self.depth_range[0] >= self.depth_range[1]:
            raise ValueError(f"depth_range: expected near < far, found {list(self.depth_range)}")
        return self


class ExtractionConfig(Model):
    """Which components are reported as objects, with hysteresis."""

    confirm: Annotated[float, Field(gt=0)] = Field(0.8, description="reported from this weight or existence on")
    release: Annotated[float, Field(gt=0)] = Field(
        0.001, description="a reported object stays reported until its weight or existence falls below this"
    )

    @model_validator(mode="after")
    def _order(self) -> ExtractionConfig:
        if self.release > self.confirm:
            raise ValueError(f"expected release <= confirm, found {self.release} > {self.confirm}")
        return self


class Range3(Model):
    """An axis-aligned box in the world."""

    x: tuple[Finite, Finite] = Field(description="from and to, length")
    y: tuple[Finite, Finite] = Field(description="from and to, length")
    z: tuple[Finite, Finite] = Field(description="from and to, length")

    @model_validator(mode="after")
    def _order(self) -> Range3:
        for axis in ("x", "y", "z"):
            low, high = getattr(self, axis)
            if low > high:
                raise ValueError(f"{axis}: expected low <= high, found [{low}, {high}]")
        return self


class RegionConfig(Model):
    """Where objects can be: a box in the world, a range of depth before the cameras, or both."""

    box: Range3 | None = Field(None, description="in the world")
    depth: tuple[NonNegative, Positive] | None = Field(
        None, description="nearest and farthest depth before the camera that saw the object last, length"
    )

    @model_validator(mode="after")
    def _order(self) -> RegionConfig:
        if self.depth is not None and self.depth[0] >= self.depth[1]:
            raise ValueError(f"depth: expected near < far, found {list(self.depth)}")
        return self


class PhdConfig(Model):
    """Gaussian-mixture PHD filter (paper VI, Table III)."""

    kind: Literal["phd"] = Field(description="the filter")
    survival_per_s: Annotated[float, Field(gt=0, le=1)] = Field(
        0.99, description="probability that an object survives one second"
    )
    birth: BirthConfig = Field(description="prior of new objects")
    prune_weight: Positive = Field(1e-6, description="components below this weight are dropped")
    merge_distance: NonNegative = Field(7.0, description="squared Mahalanobis distance below which components merge")
    merge_rule: Literal["mutual", "vo_ma"] = Field(
        "mutual",
        description="mutual: near in the covariances of both; vo_ma: in that of the lighter one only (textbook)",
    )
    max_components: Annotated[int, Field(ge=1)] = Field(1000, description="the heaviest components are kept")
    missed: Literal["split", "keep"] = Field(
        "split",
        description="what a miss says of a component that is partly in view. split: the part in view becomes less "
        "probable (paper VI-C); keep: the component keeps its shape and becomes less probable as a whole: real "
        "detectors miss an occluded object for many frames in a row, and each would squeeze the shape",
    )
    extraction: ExtractionConfig = Field(default_factory=ExtractionConfig, description="what is reported as an object")


class PmbExtractionConfig(ExtractionConfig):
    """Thresholds of existence between which a track is reported."""

    confirm: Annotated[float, Field(gt=0, le=1)] = Field(0.98, description="reported from this existence on")
    release: Annotated[float, Field(gt=0, le=1)] = Field(
        0.01, description="a reported track stays reported until its existence falls below this"
    )


class PmbConfig(Model):
    """Poisson multi-Bernoulli filter (Williams 2015): labelled tracks."""

    kind: Literal["pmb"] = Field(description="the filter")
    survival_per_s: Annotated[float, Field(gt=0, le=1)] = Field(
        0.99, description="probability that an object survives one second"
    )
    birth: BirthConfig = Field(description="prior of new objects")
    recycle_below: Positive = Field(
        1e-3, description="tracks of a smaller existence join the intensity of undetected objects"
    )
    prune_weight: Positive = Field(1e-4, description="components of that intensity below this weight are dropped")
    merge_distance: NonNegative = Field(
        4.0, description="squared Mahalanobis distance, in both covariances, below which two tracks are one"
    )
    max_components: Annotated[int, Field(ge=1)] = Field(1000, description="the most probable tracks are kept")
    hypothesis_distance: Annotated[float, Field(ge=0)] = Field(
        4.0,
        description="squared Mahalanobis distance, in both covariances, below which two hypotheses of one track merge; "
        ".inf: one Gaussian a track",
    )
    least_share: Annotated[float, Field(ge=0, lt=1)] = Field(
        1e-3, description="hypotheses of a smaller share of their track are dropped"
    )
    missed: Literal["split", "keep"] = Field(
        "keep",
        description="what a miss says of a component that is partly in view. split: the part in view becomes less "
        "probable (paper VI-C); keep: the component keeps its shape and becomes less probable as a whole: real "
        "detectors miss an occluded object for many frames in a row, and each would squeeze the shape",
    )
    extraction: PmbExtractionConfig = Field(
        default_factory=PmbExtractionConfig, description="which tracks are reported"
    )


FilterConfig = Annotated[PhdConfig | PmbConfig | SingleConfig, Field(discriminator="kind")]


class SmoothConfig(Model):
    """Fixed-interval smoothing (``track --smooth``)."""

    max_gap_s: NonNegative = Field(
        1.0, description="tracks that end and begin within this time, and fit, are stitched into one"
    )


class CameraTimes(Model):
    """Estimates after every frame of one camera."""

    camera: str = Field(description="name of the camera")


class GridTimes(Model):
    """Estimates on a fixed grid of times."""

    grid: Positive = Field(description="step of the grid, s: its times are the multiples of it")


# A finer grid would repeat times that are written to the nanosecond, and fill the disk.
SHORTEST_GRID_S = 1e-6


def _parse_times(value: Any) -> Any:
    """Turn the short forms ``camera NAME`` and ``grid DT`` into mappings; refuse what is neither, in a sentence."""
    if value == "events":
        return value
    found = value
    if isinstance(value, str):
        kind, _, rest = value.partition(" ")
        value = {kind: rest.strip()}
        if kind == "grid":
            with suppress(ValueError):
                value = {kind: float(rest)}
    if isinstance(value, dict) and len(value) == 1:
        camera, grid = value.get("camera"), value.get("grid")
        if isinstance(camera, str) and camera:
            return value
        if isinstance(grid, int | float) and not isinstance(grid, bool):
            if SHORTEST_GRID_S <= grid < np.inf:
                return value
            raise ValueError(f"expected a grid of at least {SHORTEST_GRID_S:g} s, found {grid:g}")
    raise ValueError(f"expected events, camera NAME or grid DT (in seconds), found {json.dumps(found)}")


ReportTimes = Annotated[
    Literal["events"] | CameraTimes | GridTimes,
    BeforeValidator(
        _parse_times,
        json_schema_input_type=Literal["events"]
        | Annotated[str, Field(pattern=r"^(camera|grid) +\S")]
        | CameraTimes
        | GridTimes,
    ),
]


class ReportConfig(Model):
    """Which estimates are written."""

    times: ReportTimes = Field(
        "events",
        description="when estimates are written: events (after every event), camera NAME (after every frame of that "
        "camera) or grid DT (at the multiples of DT seconds, predicted from the last event before each)",
    )
    max_position_std: Positive | None = Field(
        None,
        description="leave out estimates whose position is less certain (square root of the trace of its "
        "covariance), length: depth is not seen while one camera alone sees an object",
    )
    smooth: SmoothConfig | None = Field(
        None, description="smooth every track over the whole log, which is then held in memory; default off"
    )


class InputConfig(Model):
    """How a detection log is read."""

    on_bad_row: Literal["error", "drop"] = Field(
        "error",
        description="error: the first bad row ends the run; drop: bad rows are dropped, counted and reported",
    )
    image_margin_px: NonNegative = Field(
        10.0,
        description="a detection further than this outside the image is a bad row (noise may reach over the edge)",
    )


class GivenObject(Model):
    """An object whose start and velocity are given."""

    position: Vector3 = Field(description="position at birth_s")
    velocity: Vector3 = Field((0.0, 0.0, 0.0), description="velocity at birth_s, length/s")
    birth_s: Finite | None = Field(None, description="first time; default the start of the run")
    death_s: Finite | None = Field(None, description="last time; default the end of the run")


class DrawnObjects(Model):
    """Objects drawn at random in a box."""

    count: Annotated[int, Field(ge=0)] = Field(description="objects alive at the start")
    box: Range3 = Field(description="positions at the start are uniform in this box")
    velocity_std: NonNegative = Field(description="standard deviation of each component of velocity, length/s")
    stay_in_view: Literal["all", "any", "none"] = Field(
        "all",
        description="draw again until the object is in view of all (any of the) cameras throughout its life",
    )
    births_per_s: NonNegative = Field(0.0, description="further objects appear at this rate")
    mean_lifetime_s: Positive | None = Field(None, description="exponential lifetime; default to the end of the run")


class SimulateConfig(Model):
    """What `simulate` makes."""

    duration_s: Positive = Field(description="frames lie in [start_s, start_s + duration_s)")
    start_s: Finite = Field(0.0, description="true time of the start")
    frame_rate_hz: Positive = Field(1.0, description="of cameras that state none")
    objects: DrawnObjects | None = Field(None, description="objects drawn at random")
    given: tuple[GivenObject, ...] = Field((), description="objects whose paths are given")
    acceleration_std: NonNegative | Vector3 = Field(0.0, description="process noise, as motion.acceleration_std")
    truth_rate_hz: Positive | None = Field(None, description="of truth.parquet; default every distinct frame time")
    object_id: bool = Field(False, description="write the true object_id of each detection (-1 clutter) into the log")

    @model_validator(mode="after")
    def _some_objects(self) -> SimulateConfig:
        if self.objects is None and not self.given:
            raise ValueError("expected objects or given, found neither")
        return self


class Config(Model):
    """A stereophd configuration."""

    units: Units = Field(default_factory=Units, description="of all files of a run")
    seed: Annotated[int, Field(ge=0)] = Field(0, description="of all random numbers of a run")
    cameras: Annotated[dict[str, CameraConfig], Field(min_length=1)] | str | None = Field(
        None, description="the cameras, or the path of a cameras.yaml beside this file"
    )
    detector: Literal["given", "estimate"] = Field(
        "given",
        description="estimate: noise, probability of detection and clutter of every camera are estimated from the log, "
        "starting from the cameras' own values (track)",
    )
    disparity: DisparityConfig = Field(default_factory=DisparityConfig, description="disparity space of the cameras")
    motion: MotionConfig = Field(default_factory=MotionConfig, description="how objects move (track)")
    moments: MomentsConfig = Field(default_factory=MomentsConfig, description="how Gaussians are carried over (track)")
    region: RegionConfig | None = Field(None, description="where objects can be (track)")
    filter: FilterConfig | None = Field(None, description="the filter (track)")
    input: InputConfig = Field(default_factory=InputConfig, description="how a log is read (track)")
    report: ReportConfig = Field(default_factory=ReportConfig, description="which estimates are written (track)")
    simulate: SimulateConfig | None = Field(None, description="the scenario (simulate)")
    calibration: CalibrationConfig | None = Field(None, description="what calibrate estimates")
    experiment: ExperimentConfig | None = Field(None, description="Monte Carlo runs of a scenario (experiment)")
