"""The motion models that code names directly; a configuration finds all of them by `settings.motion_models`."""

from __future__ import annotations

from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static

__all__ = ["ConstantVelocity", "Motion", "Static"]
