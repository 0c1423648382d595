"""Shared parts of the configuration models: their base, sections of several kinds, units and boxes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Tag,
)

from stereophd.core.settings import Coordinate, parameter


class Model(BaseModel):
    """Base of all models: unknown keys are errors, instances are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


@dataclass(frozen=True)
class OneOf:
    """Annotation of a section that exists in several kinds: the settings of one of them, chosen by a word."""

    members: Callable[[], Mapping[str, Any]]  # Returns the settings of every kind by its word: a registry of `core`
    key: str  # The field that holds the word
    default: str | None = None  # The word of a section that names none; without it the word is required

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        """Validate as the union of the kinds (called by pydantic)."""
        tagged = tuple(Annotated[kind, Tag(word)] for word, kind in self.members().items())

        def word_of(value: Any) -> Any:
            if isinstance(value, dict):
                return value.get(self.key, self.default)
            return getattr(value, self.key, self.default)

        # pydantic names the function in its errors, `stereophd.config.errors` the key
        word_of.__name__ = self.key
        union = Annotated[Union[tagged], Discriminator(word_of)]  # type: ignore[valid-type]  # noqa: UP007
        return handler.generate_schema(union)

    def __get_pydantic_json_schema__(self, core_schema: Any, handler: GetJsonSchemaHandler) -> Any:
        """Return the JSON schema, in which every kind but the default requires its word (called by pydantic)."""
        schema = handler(core_schema)
        mapping = dict(zip(self.members(), (branch["$ref"] for branch in schema["oneOf"]), strict=True))
        for word, reference in mapping.items():
            if word != self.default:
                kind = handler.resolve_ref_schema({"$ref": reference})
                kind["properties"][self.key].pop("default", None)
                kind["required"] = [self.key, *(key for key in kind.get("required", ()) if key != self.key)]
        return {**schema, "discriminator": {"propertyName": self.key, "mapping": mapping}}


# The unit of length where no length is known: the distance of two cameras.
NO_LENGTH = "baseline"


# Metres in a unit of length.
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}


class Units(Model):
    """Units of all files of a run."""

    length: Literal["mm", "cm", "m", "km", "baseline"] = parameter(
        "unit of length of positions and baselines; baseline: that of two cameras, where calibrate knows no length",
        default="m",
    )


def ascending(expected: str, is_strict: bool = False) -> AfterValidator:
    """Return a check that the second of two limits is not below the first, or, if `is_strict`, is above it."""

    def check(limits: tuple[float, float]) -> tuple[float, float]:
        low, high = limits
        if low > high or (is_strict and low == high):
            raise ValueError(f"expected {expected}, found {list(limits)}")
        return limits

    return AfterValidator(check)


Limits = Annotated[tuple[Coordinate, Coordinate], ascending("low <= high")]


class Range3(Model):
    """An axis-aligned box in the world."""

    x: Limits = parameter("least and greatest x", unit="length")
    y: Limits = parameter("least and greatest y", unit="length")
    z: Limits = parameter("least and greatest z", unit="length")
