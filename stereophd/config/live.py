"""Section ``live`` of a configuration: how a recording that is still running is tracked."""

from __future__ import annotations

from stereophd.core.settings import Duration, PositiveDuration, parameter
from stereophd.validated import Model


class LiveConfig(Model):
    """How frames that arrive late are taken in."""

    wait_s: Duration = parameter(
        "longest time for which a frame waits for earlier frames of other cameras, in the time of the recording and in "
        "that of the clock on the wall",
        unit="s",
        default=0.0,
        advice="0: every frame is worked as it comes, and a late one takes the filter back; more: fewer rows are "
        "revised, and all come later.",
    )
    span_s: PositiveDuration = parameter(
        "a frame may be this much older than the newest one: the filter goes back to the state before it and works "
        "what followed again, exactly; an older frame is too late",
        unit="s",
        default=2.0,
        advice="the longest delay of a camera; states of this span are kept in memory.",
    )
    recalibrate: bool = parameter(
        "solve the pose of a camera that was knocked anew from the frames since, as calibrate does; until the data "
        "determine it, its frames are recorded and not tracked",
        default=False,
    )
