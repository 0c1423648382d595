"""Whether plots can be drawn: matplotlib is an extra, and costly to import."""

from importlib.util import find_spec

from stereophd.errors import InputError


def can_draw() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def whether_to_draw(wanted: bool | None) -> bool:
    """Return whether to draw plots: as wanted, by default if matplotlib is installed.

    Raises InputError when plots are wanted, and matplotlib is not installed.
    """
    if wanted and not can_draw():
        raise InputError("plots need matplotlib, which is not installed: pip install matplotlib")
    return can_draw() if wanted is None else wanted
