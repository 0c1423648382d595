"""What the configuration models share: their base, the usual kinds of numbers, units and boxes."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector2 = tuple[Finite, Finite]
Vector3 = tuple[Finite, Finite, Finite]


class Model(BaseModel):
    """Base of all models: unknown keys are errors, instances are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Units(Model):
    """Units of all files of a run."""

    length: Literal["mm", "cm", "m", "km"] = Field("m", description="unit of length of positions and baselines")


class Range3(Model):
    """An axis-aligned box in the world."""

    x: tuple[Finite, Finite] = Field(description="from and to, length")
    y: tuple[Finite, Finite] = Field(description="from and to, length")
    z: tuple[Finite, Finite] = Field(description="from and to, length")

    @model_validator(mode="after")
    def _order(self) -> Range3:
        for axis in ("x", "y", "z"):
            low, high = getattr(self, axis)
            if low > high:
                raise ValueError(f"{axis}: expected low <= high, found [{low}, {high}]")
        return self
