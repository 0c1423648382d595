"""The ``calibration`` section of a configuration: what is unknown, how well, and how it is found."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, create_model, model_validator

from stereophd.config.base import Model, NonNegative, Positive, Probability
from stereophd.core.calibration.quantities.base import Quantity
from stereophd.core.calibration.quantities.registry import quantities

Count = Annotated[int, Field(ge=1)]


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
    """Gaussian prior of what is unknown of one camera, about what the configuration or --cameras gives."""

    @model_validator(mode="after")
    def _something_unknown(self) -> PriorBase:
        if not any(_numbers(self.model_dump())):
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

    kind: Literal["baseline"] = Field(description="what fixes the scale")
    cameras: tuple[str, str] = Field(description="names of the two cameras")
    distance: Positive = Field(description="distance of their centres, length")
    std: Positive = Field(description="standard deviation of the distance, length")


class SpeedScale(Model):
    """The objects' speed is known."""

    kind: Literal["speed"] = Field(description="what fixes the scale")
    speed: Positive = Field(description="mean speed of every object, length/s")
    std: Positive = Field(description="standard deviation of the speed from object to object, length/s")


class LengthScale(Model):
    """Two objects keep a known distance, as the ends of a rod do."""

    kind: Literal["length"] = Field(description="what fixes the scale")
    length: Positive = Field(description="distance of the two objects, length")
    std: Positive = Field(description="standard deviation of the distance, length")


class NoScale(Model):
    """Nothing but the prior says how large the scene is."""

    kind: Literal["none"] = Field("none", description="what fixes the scale")


ScaleConfig = Annotated[NoScale | BaselineScale | SpeedScale | LengthScale, Field(discriminator="kind")]


class AnnealedConfig(Model):
    """Annealed alternation of tracking and bundle adjustment, from several starts."""

    starts: Count = Field(8, description="the prior mean and draws from the prior; at most this many")
    agreeing_starts: Count = Field(2, description="stop as soon as this many of the starts agree on the best")
    inflation: tuple[Annotated[float, Field(ge=1, allow_inf_nan=False)], ...] = Field(
        (7.0, 5.0, 3.5, 2.0, 1.4, 1.0),
        min_length=1,
        description="factors on the detector's sigma while tracking, pass by pass",
    )
    max_events: Count = Field(
        4000, description="frames used while tracking; of a longer log every n-th frame of each camera is"
    )
    min_detections: Annotated[int, Field(ge=4)] = Field(
        16, description="a track counts from this many detections in each of two cameras on"
    )
    min_tracked: Probability = Field(
        0.5,
        description="a start succeeds only if tracks that two cameras share explain this part of the detections "
        "that are not expected to be false",
    )


class SequentialConfig(Model):
    """Single-cluster PHD filter: camera particles, each with a filter of its own (paper VII-B)."""

    particles: Count = Field(1500, description="camera hypotheses")
    resample_below: Annotated[float, Field(gt=0, le=1)] = Field(
        0.75, description="resample when the effective sample size falls below this part of the particles"
    )
    roughening: NonNegative = Field(
        0.2, description="after resampling, jitter of this factor times range times particles^(-1/parameters)"
    )
    center_noise: NonNegative = Field(0.0, description="random walk of the camera's centre, length per sqrt(s)")
    rotation_noise_deg: NonNegative = Field(0.0, description="random walk of its rotation, degrees per sqrt(s)")
    likelihood: Literal["phd", "pmb"] = Field("phd", description="multi-object likelihood that weights the particles")
    samples: Annotated[int, Field(ge=16)] = Field(100, description="samples per Gaussian of the particle move")


class SmcConfig(Model):
    """Full posterior: particles about the modes found, tempered and moved by Metropolis-Hastings."""

    particles: Annotated[int, Field(ge=8)] = Field(200, description="camera hypotheses")
    evidence: Literal["pmb", "phd"] = Field("pmb", description="multi-object evidence that weights the particles")
    resample_below: Annotated[float, Field(gt=0, le=1)] = Field(
        0.5, description="a tempering step keeps the effective sample size at this part of the particles"
    )
    moves: Count = Field(3, description="Metropolis-Hastings moves after each tempering step")
    spread: Positive = Field(1.5, description="the first particles are drawn this much wider than the Laplace modes")
    max_events: Count = Field(4000, description="frames used; of a longer log every n-th frame of each camera is")


class CalibrationConfig(Model):
    """What `calibrate` estimates and how."""

    method: Literal["annealed", "sequential"] = Field("annealed", description="how the parameters are found")
    posterior: Literal["laplace", "smc"] = Field(
        "laplace", description="of method annealed: Gaussian at the optimum, or particles"
    )
    reference: str = Field(description="the camera whose pose is known and fixes the frame")
    priors: dict[str, CameraPrior] = Field(
        min_length=1, description="of the unknown cameras by name; a camera without a prior is known"
    )
    scale: ScaleConfig = Field(
        default_factory=NoScale, description="what fixes the scale, which moving objects do not show"
    )
    annealed: AnnealedConfig = Field(default_factory=AnnealedConfig, description="settings of this method")
    sequential: SequentialConfig = Field(default_factory=SequentialConfig, description="settings of this method")
    smc: SmcConfig = Field(default_factory=SmcConfig, description="settings of posterior smc")

    @model_validator(mode="after")
    def _reference_is_known(self) -> CalibrationConfig:
        prior = self.priors.get(self.reference)
        for quantity in quantities() if prior is not None else ():
            if quantity.of_the_frame and any(_numbers(getattr(prior, quantity.prior))):
                raise ValueError(
                    f"priors: expected no {quantity.prior} for the reference {self.reference}: it fixes the frame"
                )
        return self
