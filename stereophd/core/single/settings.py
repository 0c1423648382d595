"""What single-object estimators are chosen from, and their parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from stereophd.core.numerics.samples import MAX_NONLINEARITY, Method

Resampling = Literal["systematic", "stratified", "residual", "multinomial"]
Weights = Literal["logarithmic", "linear"]


@dataclass(frozen=True)
class DisparitySettings:
    """Gaussian on disparity space: the paper's Algorithm 2, or Algorithm 1 if `rectified`.

    Attributes
    ----------
    method : str
        How the Gaussian is carried from one disparity space to another (`stereophd.core.disparity.moments`).
    samples : int
        Samples of a move; the paper's experiments use 100 and 250.
    rectified : bool
        Algorithm 1: one disparity space for all cameras, which must be rectified.
    max_nonlinearity : float
        Of method ``adaptive``.
    """

    method: Method = "qmc"
    samples: int = 64
    rectified: bool = False
    max_nonlinearity: float = MAX_NONLINEARITY


@dataclass(frozen=True)
class ParticleSettings:
    """Particle filter in world space.

    Attributes
    ----------
    particles : int
    weights : {"logarithmic", "linear"}
        Linear weights underflow where the prior is poor, as those of the paper's Table II must have.
    resampling : {"systematic", "stratified", "residual", "multinomial"}
    resample_below : float
        Resample where the effective number of particles is below this fraction; 0 is never.
    regularised : bool
        Spread resampled particles by a Gaussian kernel of the optimal width (paper [37]).
    """

    particles: int = 1000
    weights: Weights = "logarithmic"
    resampling: Resampling = "systematic"
    resample_below: float = 0.5
    regularised: bool = False


@dataclass(frozen=True)
class InverseDepthSettings:
    """Extended Kalman filter on ray and inverse depth at the first camera (paper [7], [32])."""


@dataclass(frozen=True)
class CartesianSettings:
    """Kalman filter in world space.

    Attributes
    ----------
    rule : {"extended", "unscented"}
    """

    rule: Literal["extended", "unscented"] = "extended"


EstimatorSettings: TypeAlias = DisparitySettings | ParticleSettings | InverseDepthSettings | CartesianSettings
