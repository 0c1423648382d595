"""The scene that `simulate` makes, in a configuration."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from stereophd.config.base import Finite, Model, NonNegative, Positive, Range3, Vector3


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
