"""Common settings of motion models, and the search for the models: one module of this package each."""

from collections.abc import Mapping
from typing import Any, Literal, Protocol

from stereophd.core.motion.base import Motion
from stereophd.core.settings import Length, members, parameter
from stereophd.errors import InputError

# The model of a configuration that names none.
DEFAULT = "constant_velocity"

PerAxis = tuple[Length, Length, Length]
# None: not stated. Nothing is assumed in its place, for with 0 every track breaks where its object turns.
Acceleration = Length | PerAxis | Literal["estimate"] | None
# The word with which `track` estimates the acceleration from the log.
ESTIMATE: Literal["estimate"] = "estimate"


def acceleration_parameter() -> Any:
    """Declare `acceleration_std` of a model."""
    return parameter(
        "white acceleration in the world, one value or one per axis: standard deviation of the mean acceleration "
        "over 1 s (spectral density acceleration_std^2 times 1 s); track and calibrate need it; estimate: from the log "
        "(track)",
        default=None,
        unit="length/s^2",
        advice="estimate, or by how much the velocity of an object changes within a second: configs/drone.yaml has "
        "2.5 m/s^2. Too small: tracks break where objects turn. Too large: depth and velocity settle late.",
    )


def stated(acceleration_std: Acceleration) -> Length | PerAxis:
    """Return the acceleration of a model whose objects move.

    Raises InputError if none is stated, or it is still to be estimated.
    """
    if acceleration_std == ESTIMATE:
        raise InputError(
            "motion.acceleration_std: expected a number (length/s^2; only track estimates it, and init writes it), "
            "found estimate"
        )
    if acceleration_std is None:
        raise InputError(
            "motion.acceleration_std: expected by how much the velocity of objects changes in a second (length/s^2; "
            "0 only for objects that never turn), found none"
        )
    return acceleration_std


def speed_parameter() -> Any:
    """Declare `max_speed` of a model."""
    return parameter(
        "physical limit on speed; samples above it are scaled back to it",
        default=None,
        unit="length/s",
        advice="above the fastest object; state it wherever it is known: it removes tracks that fly away while only "
        "one camera sees them.",
    )


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
