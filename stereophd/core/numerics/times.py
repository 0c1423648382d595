"""Which times are one time: all of the package holds times, s, to the nanosecond."""

import math

# Times that the package computes (of simulated frames, of a grid of reports) are rounded to the nanosecond. Otherwise k
# / 30 and 2 k / 60 differ in the last bit, and cameras of 30 and 60 Hz would not share their common instants.
TIME_DECIMALS = 9

# Times nearer than this are one time: the last decimal, far below the period of any camera.
SAME_TIME_S = 1e-9

# Rounding errors of clock corrections, in units of the last place: these exceed a nanosecond beyond 1e6 s.
SAME_TIME_ULPS = 4.0


def same_time(time_s: float) -> float:
    """Return the distance, s, up to which another time is the same as `time_s`."""
    return max(SAME_TIME_S, SAME_TIME_ULPS * math.ulp(time_s))
