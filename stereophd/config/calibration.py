"""The ``calibration`` section of a configuration: what is unknown, how well, and how it is found."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Interval, Len
from pydantic import Field, create_model, model_validator

from stereophd.config.base import Model
from stereophd.core.calibration.quantities.base import Quantity
from stereophd.core.calibration.quantities.registry import quantities
from stereophd.core.settings import (
    FINITE,
    LARGEST_COUNT,
    Count,
    DegreesSpread,
    Fraction,
    Length,
    NonNegative,
    PositiveFraction,
    PositiveLength,
    parameter,
)

# Narrower priors than this are those of a known axis: write 0.
NARROWEST = 1e-9


def _prior_field(quantity: Quantity) -> Any:
    """Type and description of the prior of a quantity."""
    size = len(quantity.components)
    if quantity.named:
        names: Any = {name: (NonNegative, Field(0.0, description=f"of {name}")) for name in quantity.components}
        named = create_model(f"{quantity.name.title()}Prior", __base__=Model, __doc__=quantity.description, **names)
        return (named | None, Field(None, description=quantity.description))
    one: Any = NonNegative
    spread = one if size == 1 else one | tuple.__class_getitem__((one,) * size)
    return (spread, Field(0.0, description=quantity.description))


class PriorBase(Model):
    """Gaussian prior of what is unknown of one camera, about what the configuration or a file of cameras gives."""

    @model_validator(mode="after")
    def _something_unknown(self) -> PriorBase:
        stds = list(_numbers(self.model_dump()))
        if narrow := [std for std in stds if 0.0 < std < NARROWEST]:
            raise ValueError(f"expected 0 or standard deviations of at least {NARROWEST:g}, found {narrow[0]:g}")
        if not any(stds):
            raise ValueError("expected a standard deviation above 0, found none: a known camera has no prior")
        return self


def _numbers(values: Any) -> Iterator[float]:
    """All numbers in nested values."""
    if isinstance(values, dict):
        values = values.values()
    elif not isinstance(values, (tuple, list)):
        values = () if values is None else (float(values),)
        yield from values
        return
    for value in values:
        yield from _numbers(value)


if TYPE_CHECKING:
    CameraPrior = PriorBase
else:
    CameraPrior = create_model(
        "CameraPrior", __base__=PriorBase, __doc__=PriorBase.__doc__,
        **{quantity.prior: _prior_field(quantity) for quantity in quantities()},
    )  # fmt: skip


class BaselineScale(Model):
    """The distance between two cameras is known."""

    kind: Literal["baseline"] = parameter("what fixes the scale")
    cameras: tuple[str, str] = parameter("names of the two cameras")
    distance: PositiveLength = parameter("distance of their centres", unit="length")
    std: PositiveLength = parameter("standard deviation of the distance", unit="length")


class SpeedScale(Model):
    """The objects' speed is known."""

    kind: Literal["speed"] = parameter("what fixes the scale")
    speed: PositiveLength = parameter("mean speed of every object", unit="length/s")
    std: PositiveLength = parameter("standard deviation of the speed from object to object", unit="length/s")


class LengthScale(Model):
    """Two objects keep a known distance, as the ends of a rod do."""

    kind: Literal["length"] = parameter("what fixes the scale")
    length: PositiveLength = parameter("distance of the two objects", unit="length")
    std: PositiveLength = parameter("standard deviation of the distance", unit="length")


class NoScale(Model):
    """Nothing but the prior says how large the scene is."""

    kind: Literal["none"] = parameter("what fixes the scale", default="none")


ScaleConfig = Annotated[NoScale | BaselineScale | SpeedScale | LengthScale, Field(discriminator="kind")]


class AnnealedConfig(Model):
    """Annealed alternation of tracking and bundle adjustment, from several starts."""

    starts: Count = parameter("the prior mean and draws from the prior; at most this many", default=8)
    agreeing_starts: Count = parameter("stop as soon as this many of the starts agree on the best", default=2)
    inflation: Annotated[tuple[Annotated[float, Interval(ge=1, le=1e6), FINITE], ...], Len(1, 1000)] = parameter(
        "factors on the detector's sigma while tracking, pass by pass", default=(7.0, 5.0, 3.5, 2.0, 1.4, 1.0)
    )
    max_events: Count = parameter(
        "frames used while tracking; of a longer log every n-th frame of each camera is", default=4000
    )
    min_detections: Annotated[int, Interval(ge=4, le=LARGEST_COUNT)] = parameter(
        "a track counts from this many detections in each of two cameras on", default=16
    )
    min_tracked: Fraction = parameter(
        "a start succeeds only if tracks that two cameras share explain this part of the detections that are not "
        "expected to be false",
        default=0.5,
    )


class SequentialConfig(Model):
    """Single-cluster PHD filter: camera particles, each with a filter of its own (paper VII-B)."""

    particles: Count = parameter("camera hypotheses", default=1500)
    resample_below: PositiveFraction = parameter(
        "resample when the effective sample size falls below this part of the particles", default=0.75
    )
    roughening: Annotated[float, Interval(ge=0, le=1e3), FINITE] = parameter(
        "after resampling, jitter of this factor times range times particles^(-1/parameters)", default=0.2
    )
    center_noise: Length = parameter("random walk of the camera's centre", default=0.0, unit="length per sqrt(s)")
    rotation_noise_deg: DegreesSpread = parameter(
        "random walk of its rotation", default=0.0, unit="degrees per sqrt(s)"
    )
    likelihood: Literal["phd", "pmb"] = parameter("multi-object likelihood that weights the particles", default="phd")
    samples: Annotated[int, Interval(ge=16, le=65536)] = parameter(
        "samples per Gaussian of the particle move", default=100
    )


class SmcConfig(Model):
    """Full posterior: particles about the modes found, tempered and moved by Metropolis-Hastings."""

    particles: Annotated[int, Interval(ge=8, le=LARGEST_COUNT)] = parameter("camera hypotheses", default=200)
    evidence: Literal["pmb", "phd"] = parameter("multi-object evidence that weights the particles", default="pmb")
    resample_below: PositiveFraction = parameter(
        "a tempering step keeps the effective sample size at this part of the particles", default=0.5
    )
    moves: Count = parameter("Metropolis-Hastings moves after each tempering step", default=3)
    spread: Annotated[float, Interval(ge=0.1, le=1e3), FINITE] = parameter(
        "the first particles are drawn this much wider than the Laplace modes", default=1.5
    )
    max_events: Count = parameter("frames used; of a longer log every n-th frame of each camera is", default=4000)


class CalibrationConfig(Model):
    """What `calibrate` estimates and how."""

    method: Literal["annealed", "sequential"] = parameter("how the parameters are found", default="annealed")
    posterior: Literal["laplace", "smc"] = parameter(
        "of method annealed: Gaussian at the optimum, or particles", default="laplace"
    )
    reference: str = parameter("the camera whose pose is known and fixes the frame")
    priors: Annotated[dict[str, CameraPrior], Len(1)] = parameter(
        "of the unknown cameras by name; a camera without a prior is known"
    )
    scale: ScaleConfig = parameter("what fixes the scale, which moving objects do not show", default_factory=NoScale)
    annealed: AnnealedConfig = parameter("settings of this method", default_factory=AnnealedConfig)
    sequential: SequentialConfig = parameter("settings of this method", default_factory=SequentialConfig)
    smc: SmcConfig = parameter("settings of posterior smc", default_factory=SmcConfig)

    @model_validator(mode="after")
    def _reference_is_known(self) -> CalibrationConfig:
        prior = self.priors.get(self.reference)
        for quantity in quantities() if prior is not None else ():
            if quantity.of_the_frame and any(_numbers(getattr(prior, quantity.prior))):
                raise ValueError(
                    f"priors: expected no {quantity.prior} for the reference {self.reference}: it fixes the frame"
                )
        return self
