"""The ``calibration`` section of a configuration: what is unknown, how well, and how it is found."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from annotated_types import Interval
from pydantic import BeforeValidator, Field, create_model, model_validator

from stereophd.core.calibration.settings import AnnealedSettings, SequentialSettings, TemperedSettings
from stereophd.core.calibration.unknowns.quantities.base import Quantity
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.settings import FINITE, PositiveLength, parameter
from stereophd.validated import Model

# Narrower priors than this are those of a known axis: write 0.
NARROWEST = 1e-9


def _prior_field(quantity: Quantity) -> Any:
    size = len(quantity.components)
    one: Any = Annotated[float, Interval(ge=0, le=quantity.largest_std), FINITE]
    if quantity.named:
        names: Any = {
            name: (one, Field(0.0, description=f"standard deviation of {name}")) for name in quantity.components
        }
        named = create_model(f"{quantity.name.title()}Prior", __base__=Model, __doc__=quantity.description, **names)
        return (named | None, Field(None, description=quantity.description))
    spread = one if size == 1 else one | tuple.__class_getitem__((one,) * size)
    return (spread, Field(0.0, description=quantity.description))


class PriorBase(Model):
    """Gaussian prior of what is unknown of one camera, about what the configuration or a file of cameras gives."""

    @model_validator(mode="after")
    def _something_unknown(self) -> Self:
        stds = list(_numbers(self.model_dump()))
        if narrow := [std for std in stds if 0.0 < std < NARROWEST]:
            raise ValueError(f"expected 0 or standard deviations of at least {NARROWEST:g}, found {narrow[0]:g}")
        if not any(stds):
            raise ValueError("expected a standard deviation above 0, found none: a known camera has no prior")
        return self


def _numbers(values: Any) -> Iterator[float]:
    if isinstance(values, (dict, tuple, list)):
        for value in values.values() if isinstance(values, dict) else values:
            yield from _numbers(value)
    elif values is not None:
        yield float(values)


if TYPE_CHECKING:
    CameraPrior = PriorBase
else:
    CameraPrior = create_model(
        "CameraPrior", __base__=PriorBase, __doc__=PriorBase.__doc__,
        **{quantity.prior: _prior_field(quantity) for quantity in quantities()},
    )  # fmt: skip


# A length, or a speed, that is known better than this part of itself: rounding errors are larger.
LEAST_KNOWN_SHARE = 1e-9


class KnownScale(Model):
    """Base of what fixes the scale: a positive number, and its standard deviation."""

    @model_validator(mode="after")
    def _not_too_sure(self) -> Self:
        known, std = (float(getattr(self, name)) for name in (self._known(), "std"))
        if std < LEAST_KNOWN_SHARE * known:
            raise ValueError(f"std: expected at least {LEAST_KNOWN_SHARE:g} of {self._known()}, found {std:g}")
        return self

    def _known(self) -> str:
        """Return the name of the key that holds the number."""
        return next(name for name in ("distance", "speed", "length") if name in type(self).model_fields)


class BaselineScale(KnownScale):
    """The distance between two cameras is known."""

    kind: Literal["baseline"] = parameter("what fixes the scale")
    cameras: tuple[str, str] = parameter("names of the two cameras")
    distance: PositiveLength = parameter("distance of their centres", unit="length")
    std: PositiveLength = parameter("standard deviation of the distance", unit="length")


class SpeedScale(KnownScale):
    """The objects' speed is known."""

    kind: Literal["speed"] = parameter("what fixes the scale")
    speed: PositiveLength = parameter("mean speed of most objects", unit="length/s")
    std: PositiveLength = parameter("standard deviation of the speed from object to object", unit="length/s")


class LengthScale(KnownScale):
    """Objects keep a known distance, as the ends of a rod or neighbouring corners of a board do."""

    kind: Literal["length"] = parameter("what fixes the scale")
    length: PositiveLength = parameter(
        "distance of two objects; among many pairs the most probable distance that the priors allow", unit="length"
    )
    std: PositiveLength = parameter("standard deviation of the distance", unit="length")


class NoScale(Model):
    """Only the prior determines the scale of the scene."""

    kind: Literal["none"] = parameter("what fixes the scale", default="none")


class ControlConfig(Model):
    """What is known of places in the world: a track or points."""

    track: str | None = parameter(
        "Parquet or CSV table of time_s, x, y, z (or latitude_deg, longitude_deg, altitude_m) of one of the objects, "
        "on a clock of its own; relative to this file, else to the working folder",
        default=None,
    )
    points: str | None = parameter(
        "Parquet or CSV table of camera, u_px, v_px, x, y, z: points of known place in the images", default=None
    )

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if (self.track is None) == (self.points is None):
            raise ValueError("expected track or points")
        return self

    @property
    def file(self) -> str:
        """The one file."""
        return self.track or self.points or ""


def _parse_control(value: Any) -> Any:
    """Turn the name of a file into that of a track; the columns of the file decide whether it holds points."""
    return {"track": value} if isinstance(value, str) else value


ScaleConfig = Annotated[NoScale | BaselineScale | SpeedScale | LengthScale, Field(discriminator="kind")]


class CalibrationConfig(Model):
    """The unknowns of `calibrate` and its methods."""

    method: Literal["annealed", "sequential"] = parameter("how the parameters are found", default="annealed")
    posterior: Literal["laplace", "smc"] = parameter(
        "posterior of method annealed: a Gaussian at the optimum, or particles", default="laplace"
    )
    reference: str = parameter("the camera whose pose is known and fixes the frame")
    priors: dict[str, CameraPrior] = parameter(
        "priors of the unknown cameras by name; a camera without a prior is known, or found where its pose is unknown",
        default_factory=dict,
    )
    shared: list[list[str]] = parameter(
        "groups of cameras with one lens and one set of intrinsics, such as [[cam0, cam1]]", default_factory=list
    )
    model: Literal["as_stated", "lenses", "free"] = parameter(
        "what is estimated although it is stated as known, where the data contradict it: nothing; images as makers "
        "state them (also where the data do not show them to be exact), and lenses, clocks and readouts of which "
        "nothing is stated; all of these where they are stated, too",
        default="lenses",
    )
    scale: ScaleConfig = parameter("what fixes the scale, which moving objects do not show", default_factory=NoScale)
    control: Annotated[
        ControlConfig | None, BeforeValidator(_parse_control, json_schema_input_type=ControlConfig | str | None)
    ] = parameter("what fixes scale and frame: a control track, which fixes the clock too, or points", default=None)
    annealed: AnnealedSettings = parameter("settings of this method", default_factory=AnnealedSettings)
    sequential: SequentialSettings = parameter("settings of this method", default_factory=SequentialSettings)
    smc: TemperedSettings = parameter("settings of posterior smc", default_factory=TemperedSettings)

    @model_validator(mode="after")
    def _reference_is_known(self) -> Self:
        if self.control is not None and (self.method != "annealed" or self.posterior != "laplace"):
            raise ValueError("control: expected method annealed and posterior laplace, found others")
        names = [name for group in self.shared for name in group]
        if any(len(group) < 2 for group in self.shared) or len(set(names)) < len(names):
            raise ValueError("shared: expected groups of two or more cameras, each camera in one group")
        prior = self.priors.get(self.reference)
        for quantity in quantities() if prior is not None else ():
            if quantity.of_the_frame and any(_numbers(getattr(prior, quantity.prior))):
                raise ValueError(
                    f"priors: expected no {quantity.prior} for the reference {self.reference}: it fixes the frame"
                )
        return self
