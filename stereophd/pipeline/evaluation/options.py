"""Options of `stereophd.commands.evaluate`, and what is wrong with them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from stereophd.errors import InputError

# What may be changed of the tracks before they are scored: nothing, their frame, their frame and scale.
ALIGNMENTS = ("none", "rigid", "similarity")


@dataclass(frozen=True)
class Options:
    """How tracks are scored; see `evaluate`."""

    order: float
    cutoff: float
    base: Literal["euclidean", "mahalanobis"]
    from_s: float | None
    to_s: float | None
    max_gap_s: float | None
    at: Literal["times", "events"]
    seen_by: int | None
    within_s: float | None
    ospa2_window: int
    tentative: bool
    align: Literal["none", "rigid", "similarity"] = "none"
    align_clock: bool = False
    match_distance: float | None = None


def check_options(options: Options, log_path: Path | str | None) -> None:
    """Raise InputError for options out of range or that do not go together."""
    if not (math.isfinite(options.cutoff) and options.cutoff > 0.0):
        raise InputError(f"`cutoff`: expected a finite number above 0, found {options.cutoff}")
    distance = options.match_distance
    if distance is not None and not (math.isfinite(distance) and distance > 0.0):
        raise InputError(f"`match_distance`: expected a finite number above 0, found {distance}")
    for name, low in (("order", 1.0), ("max_gap_s", 0.0), ("within_s", 0.0)):
        value = getattr(options, name)
        if value is not None and not (math.isfinite(value) and value >= low):
            raise InputError(f"`{name}`: expected a finite number of at least {low:g}, found {value}")
    for name, choices in (("base", ("euclidean", "mahalanobis")), ("at", ("times", "events")), ("align", ALIGNMENTS)):
        if getattr(options, name) not in choices:
            raise InputError(f"`{name}`: expected {' or '.join(choices)}, found {getattr(options, name)}")
    for name in ("from_s", "to_s"):
        value = getattr(options, name)
        if value is not None and not math.isfinite(value):
            raise InputError(f"`{name}`: expected a finite time in seconds, found {value}")
    if options.from_s is not None and options.to_s is not None and options.from_s > options.to_s:
        raise InputError(f"`from_s`: expected a time not after `to_s`, found {options.from_s} > {options.to_s}")
    together = (options.seen_by, options.within_s, log_path)
    if any(value is None for value in together) and together != (None, None, None):
        raise InputError("`seen_by`: expected `seen_by`, `within_s` and `log_path` together, found only some of them")
    if options.seen_by is not None and options.seen_by < 1:
        raise InputError(f"`seen_by`: expected at least one camera, found {options.seen_by}")
    if options.ospa2_window < 1:
        raise InputError(f"`ospa2_window`: expected at least one scan, found {options.ospa2_window}")
