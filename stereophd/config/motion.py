"""How objects move, in a configuration: the settings of one of the motion models."""

from __future__ import annotations

from typing import Annotated

from stereophd.core.motion.settings import DEFAULT, MotionSettings, motion_models
from stereophd.validated import OneOf

Motion = Annotated[MotionSettings, OneOf(motion_models, "model", DEFAULT)]
