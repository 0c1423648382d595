"""One of every motion model, found by its word: a new model needs an entry here, and then runs through all tests.

Units are those of `tests.core.disparity.cases`: lengths some 100, intervals some 0.5 s.
"""

from __future__ import annotations

from stereophd.core.motion.base import Motion
from stereophd.core.motion.settings import motion_models

SETTINGS: dict[str, dict[str, object]] = {
    "constant_velocity": {"acceleration_std": (0.2, 0.1, 0.3), "max_speed": 12.0},
    "static": {},
    "damped_velocity": {"time_constant_s": 2.0, "acceleration_std": (0.8, 0.5, 1.0), "max_speed": 12.0},
    "ballistic": {"gravity": (0.1, 0.6, -0.2), "acceleration_std": (0.1, 0.1, 0.2), "max_speed": 30.0},
}
WORDS = sorted(motion_models())
MOVING = [word for word in WORDS if word != "static"]


def example(word: str, **changes: object) -> Motion:
    """Return the model of this word."""
    return motion_models()[word](**{**SETTINGS[word], **changes}).build()
