"""The calibration quantities, found by name."""

from __future__ import annotations

from functools import cache
from importlib import import_module

from stereophd.core.calibration.unknowns.quantities.base import Quantity

# In the order of the values of a camera. Each name is a file of this folder with its `QUANTITY`.
NAMES = (
    "center",
    "rotation",
    "focal",
    "aspect",
    "principal_point",
    "distortion",
    "clock_offset",
    "clock_rate",
    "readout",
    "velocity",
    "rotation_rate",
    "mount_center",
    "mount_rotation",
)


@cache
def quantities() -> tuple[Quantity, ...]:
    """Return all quantities in the order of the values."""
    return tuple(import_module(f"{__package__}.{name}").QUANTITY for name in NAMES)


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
