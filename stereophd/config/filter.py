"""Tracking in a configuration: disparity space, motion, moments, region, and the filter."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from stereophd.config.base import Model, NonNegative, Positive, Range3
from stereophd.config.single import DisparityPrior, SingleConfig


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
