"""The calibration quantities, found by name."""

from functools import cache

from stereophd.core.calibration.unknowns.quantities.base import Quantity
from stereophd.core.calibration.unknowns.quantities.intrinsics import Aspect, Distortion, Focal, PrincipalPoint
from stereophd.core.calibration.unknowns.quantities.mount import MountCenter, MountRotation
from stereophd.core.calibration.unknowns.quantities.pose import Center, Rotation, RotationRate, Velocity
from stereophd.core.calibration.unknowns.quantities.timing import ClockOffset, ClockRate, Readout


@cache
def quantities() -> tuple[Quantity, ...]:
    """Return all quantities in the order of the values of a camera."""
    return (
        Center(), Rotation(), Focal(), Aspect(), PrincipalPoint(), Distortion(), ClockOffset(), ClockRate(), Readout(),
        Velocity(), RotationRate(), MountCenter(), MountRotation(),
    )  # fmt: skip


@cache
def quantity_of(component: str) -> Quantity:
    """Return the quantity that has a component; raises KeyError where none has it."""
    for quantity in quantities():
        if component in quantity.components:
            return quantity
    raise KeyError(component)


def component_names() -> tuple[str, ...]:
    """Return the components of all quantities in the order of the values."""
    return tuple(component for quantity in quantities() for component in quantity.components)
