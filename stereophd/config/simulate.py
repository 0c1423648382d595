"""The scene that `simulate` makes, in a configuration."""

from typing import Annotated, Any, Literal, Self

import numpy as np
from annotated_types import Interval, Len
from pydantic import ValidationInfo, field_validator, model_validator

from stereophd.core.motion.settings import DEFAULT, ESTIMATE, MotionSettings, motion_models
from stereophd.core.settings import (
    FINITE,
    LARGEST_COUNT,
    DegreesSpread,
    Fraction,
    Length,
    PositiveDuration,
    PositiveLength,
    Rate,
    Time,
    Vector3,
    parameter,
)
from stereophd.validated import Model, OneOf, Range3, ascending

Motion = Annotated[MotionSettings, OneOf(motion_models, "model", DEFAULT)]


# A float bound: typing keeps one of two annotations that are equal, and 1e9 is printed unlike 1000000000.
BirthsPerSecond = Annotated[float, Interval(ge=0, le=float(LARGEST_COUNT)), FINITE]


class GivenObject(Model):
    """An object whose start and velocity are given."""

    position: Vector3 = parameter("position at birth_s", unit="length")
    velocity: Vector3 = parameter("velocity at birth_s", default=(0.0, 0.0, 0.0), unit="length/s")
    birth_s: Time | None = parameter("first time; by default the start of the run", default=None, unit="s")
    death_s: Time | None = parameter("last time; by default the end of the run", default=None, unit="s")


class DrawnObjects(Model):
    """Objects drawn at random in a box."""

    count: Annotated[int, Interval(ge=0, le=LARGEST_COUNT)] = parameter("objects alive at the start")
    box: Range3 = parameter("positions at the start are uniform in this box")
    velocity_std: Length = parameter("standard deviation of each component of velocity", unit="length/s")
    stay_in_view: Literal["all", "any", "none"] = parameter(
        "draw again until the object is in view of all (any of the) cameras throughout its life", default="all"
    )
    births_per_s: BirthsPerSecond = parameter("further objects appear at this rate", default=0.0, unit="1/s")
    mean_lifetime_s: PositiveDuration | None = parameter(
        "mean of the exponential lifetime; by default objects live until the end of the run", default=None, unit="s"
    )


class WalkersConfig(Model):
    """People who walk between places on the ground, keep clear of one another, and stop to meet (object.ground)."""

    count: Annotated[int, Interval(ge=1, le=100_000)] = parameter("walkers, present from the start to the end")
    area: Range3 = parameter("where they walk: the ground within this box")
    speed: PositiveLength = parameter("mean speed; each walker has its own within a quarter of it", unit="length/s")
    spacing: PositiveLength = parameter("distance that walkers keep from each other", unit="length")
    rest_s: PositiveDuration = parameter("mean time that a walker rests at a place", default=2.0, unit="s")
    meet: Fraction = parameter("probability that the next place is beside another walker", default=0.5)


class GivenBody(Model):
    """A rigid body that sways and turns, as a board of corners in a hand does."""

    points: Annotated[tuple[Vector3, ...], Len(1)] = parameter(
        "objects that move with it, in its own axes", unit="length"
    )
    center: Vector3 = parameter("mean position of the origin of its axes", unit="length")
    rotation_vector_deg: Vector3 = parameter(
        "mean rotation from its axes to the world's", default=(0.0, 0.0, 0.0), unit="degrees"
    )
    center_std: tuple[Length, Length, Length] = parameter(
        "standard deviation over time of its position", default=(0.0, 0.0, 0.0), unit="length"
    )
    rotation_std_deg: tuple[DegreesSpread, DegreesSpread, DegreesSpread] = parameter(
        "standard deviation over time of its rotation vector, in the axes of the world",
        default=(0.0, 0.0, 0.0),
        unit="degrees",
    )
    period_s: Annotated[tuple[PositiveDuration, PositiveDuration], ascending("shortest <= longest")] = parameter(
        "shortest and longest period of the harmonics of its motion", default=(3.0, 12.0), unit="s"
    )


class SimulateConfig(Model):
    """The scene that `simulate` makes."""

    duration_s: PositiveDuration = parameter("frames lie in [start_s, start_s + duration_s)", unit="s")
    start_s: Time = parameter("true time of the start", default=0.0, unit="s")
    frame_rate_hz: Rate = parameter("frame rate of the cameras that state none", default=1.0, unit="Hz")
    objects: DrawnObjects | None = parameter("objects drawn at random", default=None)
    given: tuple[GivenObject, ...] = parameter("objects whose paths are given", default=())
    bodies: tuple[GivenBody, ...] = parameter("rigid bodies, each with several objects", default=())
    walkers: WalkersConfig | None = parameter("people who walk on the ground", default=None)
    acceleration_std: Length | tuple[Length, Length, Length] = parameter(
        "process noise of objects and given, as motion.acceleration_std", default=0.0, unit="length/s^2"
    )
    motion: Motion | None = parameter(
        "how objects and given move; by default as the model of the section motion, with the noise acceleration_std "
        "in place of its own (models static and constant_velocity)",
        default=None,
    )
    truth_rate_hz: Rate | None = parameter(
        "rate of the rows of truth.parquet; by default they are at every distinct frame time", default=None, unit="Hz"
    )
    object_id: bool = parameter("write the true object_id of each detection (-1 clutter) into the log", default=False)

    @field_validator("acceleration_std", "motion")
    @classmethod
    def _something_moves(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse a motion that moves no object: bodies have paths of their own. It is asked of stated keys only."""
        if "objects" not in info.data or "given" not in info.data:
            # one of them is refused itself, and pydantic leaves out what it refused
            return value
        others = info.data["objects"] is not None or info.data["given"]
        states = value is not None if info.field_name == "motion" else np.any(value)
        immovable = [name for name in ("bodies", "walkers") if info.data.get(name)]
        if states and immovable and not others:
            raise ValueError(
                "expected objects or given, which it moves (bodies sway by center_std and rotation_std_deg), found "
                f"{' and '.join(immovable)} only"
            )
        return value

    @field_validator("motion")
    @classmethod
    def _acts(cls, value: Any) -> Any:
        """Refuse keys of a motion that only a filter has a use for."""
        limit = getattr(value, "max_speed", None)
        if limit is not None:
            raise ValueError(f"expected no max_speed, which limits the samples of a filter only, found {limit:g}")
        if getattr(value, "acceleration_std", None) == ESTIMATE:
            raise ValueError(f"expected a number as acceleration_std, which only track estimates, found {ESTIMATE}")
        return value

    @model_validator(mode="after")
    def _some_objects(self) -> Self:
        if self.objects is None and not self.given and not self.bodies and self.walkers is None:
            raise ValueError("expected objects, given, bodies or walkers, found none of them")
        if self.motion is not None and np.any(self.acceleration_std):
            raise ValueError("expected motion or acceleration_std, which is that of motion, found both")
        return self
