"""The motion models by name: `motion.model` in a configuration."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static

__all__ = ["MODELS", "ConstantVelocity", "Motion", "Static"]

MODELS: Mapping[str, type[Motion]] = MappingProxyType({model.name: model for model in (ConstantVelocity, Static)})
