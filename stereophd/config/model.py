"""Configuration models: the keys that a YAML file may hold, with units, limits and defaults.

Lengths are in the unit that ``units.length`` names, times in seconds, pixels as floats with (0, 0)
at the centre of the top-left pixel; angles are in degrees where the key ends in ``_deg``. Unknown
keys are errors. Reading files, overrides and error messages live in `stereophd.config.loading`.
"""

from typing import Annotated, Literal, Self

from annotated_types import Interval
from pydantic import Field, model_validator

from stereophd.config.calibration import CalibrationConfig
from stereophd.config.experiment import ExperimentConfig
from stereophd.config.report import EvaluationConfig, InputConfig, ReportConfig
from stereophd.config.simulate import Motion, SimulateConfig
from stereophd.config.tracking import DisparityConfig, Filter, LiveConfig, RegionConfig, Shape
from stereophd.core.bodies.shapes.point import PointSettings
from stereophd.core.motion.constant_velocity import ConstantVelocitySettings
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.numerics.samples import MomentsSettings
from stereophd.io.cameras.models import CameraConfig, CovarianceRows, covariance_of
from stereophd.validated import Model, Units


class Config(Model):
    """A stereophd configuration."""

    units: Units = Field(default_factory=Units, description="units of all files of a run")
    seed: Annotated[int, Interval(ge=0, le=2**63 - 1)] = Field(0, description="seed of all random numbers of a run")
    cameras: Annotated[dict[str, CameraConfig], Field(min_length=1)] | str | None = Field(
        None, description="the cameras, or the path of a cameras.yaml, relative to this file"
    )
    cameras_covariance: CovarianceRows | None = Field(
        None,
        description="what the cameras leave uncertain, in rows of a lower triangle by camera.component: the covariance "
        "that calibrate writes into cameras.yaml; the covariances of tracks count it (track)",
    )
    detector: Literal["given", "estimate"] = Field(
        "given",
        description="estimate: noise, probability of detection and clutter of every camera are estimated from the log "
        "(track)",
    )
    disparity: DisparityConfig = Field(default_factory=DisparityConfig, description="disparity space of the cameras")
    motion: Motion = Field(default_factory=ConstantVelocitySettings, description="how objects move (track)")
    moments: MomentsSettings = Field(
        default_factory=MomentsSettings, description="how Gaussians are carried over (track)"
    )
    object: Shape = Field(default_factory=PointSettings, description="the shape of the objects (track)")
    region: RegionConfig | None = Field(None, description="where objects can be (track)")
    filter: Filter | None = Field(None, description="the filter (track)")
    input: InputConfig = Field(default_factory=InputConfig, description="how a log is read (track)")
    report: ReportConfig = Field(default_factory=ReportConfig, description="which estimates are written (track)")
    live: LiveConfig = Field(
        default_factory=LiveConfig, description="how a recording that is still running is tracked (track)"
    )
    evaluation: EvaluationConfig = Field(
        default_factory=EvaluationConfig, description="how tracks are scored (evaluate)"
    )
    simulate: SimulateConfig | None = Field(None, description="the scenario (simulate)")
    calibration: CalibrationConfig | None = Field(None, description="what calibrate estimates")
    experiment: ExperimentConfig | None = Field(None, description="Monte Carlo runs of a scenario (experiment)")

    @model_validator(mode="after")
    def _covariance_of_cameras(self) -> Self:
        """Refuse a covariance that is none of these cameras."""
        if self.cameras_covariance and isinstance(self.cameras, dict):
            covariance_of(self.cameras_covariance, tuple(self.cameras))
        return self

    @model_validator(mode="after")
    def _depth_of_points(self) -> Self:
        """Refuse births of points without a prior of their depth."""
        if isinstance(self.object, PointSettings) and isinstance(self.filter, FilterSettings):
            birth = self.filter.birth
            if not birth.has_depth:
                raise ValueError("filter.birth: expected exactly one of disparity and depth_range, found none")
        return self
