"""The error of a computation that went beyond the precision of the arithmetic."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from stereophd.errors import InputError


@contextmanager
def within_arithmetic(place: str) -> Iterator[None]:
    """Turn a failure of the arithmetic in this block into an error of the configuration.

    Keys have bounds, but values that are each possible may be too far apart to compute with. Raises InputError, at a
    place (the file and the section), if a matrix has no inverse or no factor, or a number overflows.
    """
    try:
        yield
    except (np.linalg.LinAlgError, OverflowError, FloatingPointError) as error:
        raise InputError(
            f"{place}: expected values that the arithmetic can combine, found some too far apart ({error}); check the "
            "units of lengths, times and standard deviations"
        ) from error
