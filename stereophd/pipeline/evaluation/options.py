"""Options of `stereophd.commands.evaluate`, and what is wrong with them."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from stereophd.errors import InputError
from stereophd.options import option, options

# The region that is that of the tracks' configuration.
OF_TRACKS: Literal["tracks"] = "tracks"

# The use in which only objects count that the log shows.
SEEN = "objects that are seen"


def normal_of(flag: str, words: Sequence[str]) -> tuple[float, float, float] | None:
    """Return the normal X,Y,Z of an option; InputError if there are several words, or not three numbers."""
    if not words:
        return None
    try:
        x, y, z = map(float, ",".join(words).split(","))
    except ValueError:
        raise InputError(f"{flag}: expected X,Y,Z once, such as 0,0,1, found {' '.join(words)}") from None
    return x, y, z


def limits_by_axis(flag: str, words: Sequence[str]) -> dict[str, tuple[float, float]] | Literal["tracks"] | None:
    """Return {axis: (from, to)} of words AXIS=FROM:TO, or the word tracks; InputError for others or a repeated axis."""
    if list(words) == [OF_TRACKS]:
        return OF_TRACKS
    limits: dict[str, tuple[float, float]] = {}
    for word in words:
        axis, _, values = word.partition("=")
        try:
            low, high = map(float, values.split(":"))
        except ValueError:
            raise InputError(f"{flag} {word}: expected AXIS=FROM:TO, such as x=0:5, or {OF_TRACKS}") from None
        if axis in limits:
            raise InputError(f"{flag} {word}: expected each axis once, found {axis} again")
        limits[axis] = low, high
    return limits or None


@options
class ScoreOptions:
    """How tracks are scored."""

    order: float = option("Order of OSPA and GOSPA.", default=2.0, metavar="P", least=1.0)
    cutoff: float | None = option(
        "Cutoff of OSPA and GOSPA: the largest error at which an object still counts as found, in the unit of length "
        "(base mahalanobis: in standard deviations). Default: evaluation.cutoff of the configuration of the tracks; "
        "without it 20 where lengths are in cm and for the base mahalanobis, and no default for other units.",
        default=None,
        metavar="C",
        above=0.0,
    )
    base: Literal["euclidean", "mahalanobis"] = option(
        "Base distance of OSPA and GOSPA: euclidean, or mahalanobis with the covariance of the estimate (paper "
        "VIII-C).",
        default="euclidean",
    )
    from_s: float | None = option("First time that is scored, s.", default=None, metavar="T", flag="from")
    to_s: float | None = option("Last time that is scored, s.", default=None, metavar="T", flag="to")
    max_gap_s: float | None = option(
        "Never interpolate the truth across a longer gap, s: times in it are counted but not scored; default: 1.5 "
        "median steps.",
        default=None,
        metavar="S",
        flag="max-gap",
        least=0.0,
    )
    at: Literal["times", "events"] = option(
        "Score each time once, after its last event, or every event.", default="times"
    )
    seen_by: int | None = option(
        "Score only objects that N cameras detected in the last seconds (seen-within) according to the log, by its "
        "object_id; without one, any detection counts.",
        default=None,
        metavar="N",
        least=1,
        use=SEEN,
    )
    within_s: float | None = option(
        "Time span of seen-by, s.", default=None, metavar="S", flag="seen-within", least=0.0, use=SEEN
    )
    ospa2_window: int = option("Scored scans in a window of OSPA(2).", default=10, metavar="SCANS", least=1)
    tentative: bool = option("Score tentative estimates too, not only confirmed ones.", default=False)
    align: Literal["none", "rigid", "similarity"] = option(
        "Before scoring, align the tracks with the truth by a rigid motion (and a scale): for calibrated cameras whose "
        "frame differs from that of the truth.",
        default="none",
    )
    align_clock: bool = option(
        "Score the tracks after a change of their clock's offset and rate, found with the alignment.", default=False
    )
    match_distance: float | None = option(
        "Match tracks and objects nearer than this, for all figures but OSPA, GOSPA and HOTA, in the unit of length; "
        "default: the cutoff. Choose it below the distance between objects: else a match may be wrong from the first "
        "time on and yet be kept.",
        default=None,
        metavar="D",
        above=0.0,
    )
    plane: tuple[float, float, float] | None = option(
        "Compare positions on the plane of this normal, such as 0,0,1 for the ground: figures are then of two "
        "dimensions, without NEES.",
        default=None,
        metavar="X,Y,Z",
        parse=normal_of,
    )
    region: Mapping[str, tuple[float, float]] | Literal["tracks"] | None = option(
        "Score only objects between two values of an axis, such as x=0:5 (repeatable), or in the box and the polygon "
        "that the configuration of the tracks states (tracks). Objects outside are left out with the estimates "
        "assigned to them, and so are estimates outside that are assigned to no object.",
        default=None,
        metavar="AXIS=FROM:TO",
        parse=limits_by_axis,
    )
    switch_cost: float | None = option(
        "Add the trajectory GOSPA distance with this cost of a switch of tracks, in the unit of length.",
        default=None,
        metavar="G",
        above=0.0,
    )

    @property
    def known_cutoff(self) -> float:
        """The cutoff, once it is known."""
        assert self.cutoff is not None
        return self.cutoff


def check_options(stated: ScoreOptions, log_path: Path | str | None) -> None:
    """Raise InputError for options that do not go together, and a plane or a region that cannot be."""
    if stated.from_s is not None and stated.to_s is not None and stated.from_s > stated.to_s:
        raise InputError(f"`from_s`: expected a time not after `to_s`, found {stated.from_s} > {stated.to_s}")
    together = (stated.seen_by, stated.within_s, log_path)
    if any(value is None for value in together) and together != (None, None, None):
        raise InputError("`seen_by`: expected `seen_by`, `within_s` and `log_path` together, found only some of them")
    if stated.plane is not None and not (all(map(math.isfinite, stated.plane)) and any(stated.plane)):
        raise InputError(f"`plane`: expected a normal of three finite numbers, not all 0, found {stated.plane}")
    limits = {} if stated.region is None or isinstance(stated.region, str) else stated.region
    if isinstance(stated.region, str) and stated.region != OF_TRACKS:
        raise InputError(f"`region`: expected limits by axis or {OF_TRACKS}, found {stated.region}")
    for axis, (low, high) in limits.items():
        if axis not in ("x", "y", "z") or not low < high:
            raise InputError(f"`region`: expected x, y or z with least < greatest, found {axis} from {low} to {high}")
    for name in ("plane", "region"):
        if getattr(stated, name) is not None and stated.base == "mahalanobis":
            raise InputError(f"`{name}`: expected `base` euclidean, found mahalanobis")
