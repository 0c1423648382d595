"""Settings of the estimators of one object, and the section ``filter`` with ``kind: single``."""

from typing import Annotated, Literal, TypeAlias

from annotated_types import Interval

from stereophd.core.disparity.prior import InitialPrior
from stereophd.core.settings import Fraction, parameter, settings

Resampling = Literal["systematic", "stratified", "residual", "multinomial"]
Weights = Literal["logarithmic", "linear"]


@settings
class DisparityChoice:
    """Gaussian on disparity space, moved by the method of ``moments`` (paper, Algorithm 2)."""

    kind: Literal["disparity"] = parameter("the estimator", default="disparity")


@settings
class RectifiedChoice:
    """The same for cameras that are rectified with one another (paper, Algorithm 1)."""

    kind: Literal["rectified"] = parameter("the estimator", default="rectified")


@settings
class ParticleSettings:
    """Particle filter in world space."""

    kind: Literal["particle"] = parameter("the estimator", default="particle")
    particles: Annotated[int, Interval(ge=2, le=10_000_000)] = parameter("number of particles", default=1000)
    weights: Weights = parameter("linear: weights underflow where the prior is poor", default="logarithmic")
    resampling: Resampling = parameter("how particles are drawn again by their weights", default="systematic")
    resample_below: Fraction = parameter(
        "resample below this effective fraction of the particles; 0: never", default=0.5
    )
    regularised: bool = parameter(
        "spread resampled particles by a Gaussian kernel of the optimal width (paper [37])", default=False
    )


@settings
class InverseDepthSettings:
    """Extended Kalman filter on ray and inverse depth at the first camera (paper [7], [32])."""

    kind: Literal["inverse_depth"] = parameter("the estimator", default="inverse_depth")


@settings
class CartesianSettings:
    """Kalman filter in world space."""

    kind: Literal["cartesian"] = parameter("the estimator", default="cartesian")
    rule: Literal["extended", "unscented"] = parameter(
        "how the observation is approximated: linearised, or by points", default="extended"
    )


EstimatorChoice: TypeAlias = (
    DisparityChoice | RectifiedChoice | ParticleSettings | InverseDepthSettings | CartesianSettings
)


@settings
class SingleSettings:
    """One object, seen at most once a frame: no clutter, no association."""

    kind: Literal["single"] = parameter("the filter", default="single")
    prior: InitialPrior = parameter("prior of the object at its first detection")
    estimator: EstimatorChoice = parameter("how it is estimated", default_factory=DisparityChoice, discriminator="kind")
    point: Literal["mean", "map"] = parameter(
        "what is written: the mean, or the state of greatest density", default="mean"
    )
