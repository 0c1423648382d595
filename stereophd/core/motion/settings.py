"""What the settings of every motion model hold, and where they are found: one module of this package each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from stereophd.core.motion.models import Motion
from stereophd.core.settings import members

# The model of a configuration that names none.
DEFAULT = "constant_velocity"


class MotionSettings(Protocol):
    """Settings of a motion model (`SETTINGS` of its module, whose name is the word ``motion.model``)."""

    @property
    def model(self) -> str:
        """The word that names the model."""

    def build(self) -> Motion:
        """Return the motion model."""


def motion_models() -> Mapping[str, type[MotionSettings]]:
    """Return the settings of every motion model by its name."""
    return members("stereophd.core.motion")
