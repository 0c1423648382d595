"""Another unit of length for the settings of a configuration, where no length of the scene is known.

Depths, speeds and accelerations that a configuration states are lengths of its unit. Where nothing known fixes the
scale, the cameras that are found have the first baseline for their unit, and the settings follow: objects are expected
at the depths at which they were found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from stereophd.config.loading import variant

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig


# Sections whose lengths are settings. Those of cameras and of calibrations are made anew where cameras are found.
SECTIONS = ("disparity", "motion", "object", "region", "filter", "report", "evaluation")


def with_unit(loaded: LoadedConfig, unit: str, factor: float) -> LoadedConfig:
    """Return a configuration in another unit, in which its lengths have this many times their values."""
    changes: dict[str, Any] = {"units.length": unit}
    for section in SECTIONS:
        changes.update(_scaled(getattr(loaded.config, section), section, factor))
    return variant(loaded, [("unit of length", changes)])


def _scaled(value: Any, key: str, factor: float) -> Iterator[tuple[str, Any]]:
    """Key paths of the lengths in settings, and their scaled values."""
    if isinstance(value, BaseModel):
        units = {name: field.json_schema_extra for name, field in type(value).model_fields.items()}
    elif is_dataclass(value):
        units = {field.name: field.metadata.get("json_schema_extra") for field in fields(value)}
    else:
        return
    for name, extra in units.items():
        inner, unit = getattr(value, name), extra.get("unit", "") if isinstance(extra, dict) else ""
        if isinstance(inner, BaseModel) or is_dataclass(inner):
            yield from _scaled(inner, f"{key}.{name}", factor)
        elif str(unit).startswith("length") and inner is not None and not isinstance(inner, str):
            yield f"{key}.{name}", [factor * part for part in inner] if isinstance(inner, tuple) else factor * inner
