"""How numbers are written in messages."""

from __future__ import annotations

import math

import pytest

from stereophd.wording import instant


@pytest.mark.parametrize(
    ("time_s", "text"),
    [
        (0.0, "0"),
        (0.08, "0.08"),
        (1.0 / 30.0, "0.0333333"),
        (12.3456789, "12.3457"),
        (-86400.0335, "-86400.034"),
        (1732545000.0214, "1732545000.021"),
        (math.inf, "inf"),
    ],
)
def test_a_time_shows_the_frame(time_s: float, text: str) -> None:
    assert instant(time_s) == text
