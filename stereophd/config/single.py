"""The ``filter`` section for one object without clutter (``kind: single``)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from stereophd.config.base import Model, Positive


class DisparityPrior(Model):
    """Gaussian prior of the disparity of a new object."""

    mean_px: Positive = Field(description="mean, px at the baseline")
    std_px: Positive = Field(description="standard deviation, px at the baseline")


class SinglePriorConfig(Model):
    """What is known of the object when a camera first sees it (paper V-A)."""

    disparity: DisparityPrior | None = Field(None, description="prior of the disparity, px at the baseline")
    depth_range: tuple[Positive, Positive] | None = Field(
        None, description="near and far depth, length: two standard deviations either side in disparity"
    )
    velocity_std: Positive | None = Field(
        None, description="standard deviation of each component of velocity in the world, length/s"
    )
    disparity_velocity_std_px_s: tuple[Positive, Positive, Positive] | None = Field(
        None, description="instead, standard deviations of the rates of u, v and d, px/s"
    )

    @model_validator(mode="after")
    def _one_prior(self) -> SinglePriorConfig:
        if (self.disparity is None) == (self.depth_range is None):
            raise ValueError("expected exactly one of disparity and depth_range")
        if self.depth_range is not None and self.depth_range[0] >= self.depth_range[1]:
            raise ValueError(f"depth_range: expected near < far, found {list(self.depth_range)}")
        if self.velocity_std is not None and self.disparity_velocity_std_px_s is not None:
            raise ValueError("expected one of velocity_std and disparity_velocity_std_px_s, found both")
        return self


class DisparityEstimatorConfig(Model):
    """Gaussian on disparity space, carried as ``moments`` says (paper, Algorithm 2)."""

    kind: Literal["disparity"] = Field("disparity", description="the estimator")


class RectifiedEstimatorConfig(Model):
    """The same for cameras that are rectified with one another (paper, Algorithm 1)."""

    kind: Literal["rectified"] = Field(description="the estimator")


class ParticleEstimatorConfig(Model):
    """Particle filter in world space."""

    kind: Literal["particle"] = Field(description="the estimator")
    particles: Annotated[int, Field(ge=2, le=10_000_000)] = Field(1000, description="number of particles")
    weights: Literal["logarithmic", "linear"] = Field(
        "logarithmic", description="linear: weights underflow where the prior is poor"
    )
    resampling: Literal["systematic", "stratified", "residual", "multinomial"] = Field(
        "systematic", description="how particles are drawn again by their weights"
    )
    resample_below: Annotated[float, Field(ge=0, le=1)] = Field(
        0.5, description="resample below this effective fraction of the particles; 0: never"
    )
    regularised: bool = Field(False, description="spread resampled particles by a Gaussian kernel")


class InverseDepthEstimatorConfig(Model):
    """Extended Kalman filter on ray and inverse depth."""

    kind: Literal["inverse_depth"] = Field(description="the estimator")


class CartesianEstimatorConfig(Model):
    """Kalman filter in world space."""

    kind: Literal["cartesian"] = Field(description="the estimator")
    rule: Literal["extended", "unscented"] = Field(
        "extended", description="of the observation: linearised, or by points"
    )


EstimatorConfig = Annotated[
    DisparityEstimatorConfig
    | RectifiedEstimatorConfig
    | ParticleEstimatorConfig
    | InverseDepthEstimatorConfig
    | CartesianEstimatorConfig,
    Field(discriminator="kind"),
]


class SingleConfig(Model):
    """One object, seen at most once a frame: no clutter, no association."""

    kind: Literal["single"] = Field(description="the filter")
    prior: SinglePriorConfig = Field(description="of the object at its first detection")
    estimator: EstimatorConfig = Field(default_factory=DisparityEstimatorConfig, description="how it is estimated")
    point: Literal["mean", "map"] = Field(
        "mean", description="what is written: the mean, or the state of greatest density"
    )
