"""Options of `stereophd.commands.evaluate`, and what is wrong with them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from stereophd.core.metrics.truth.places import AXES
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
    plane: tuple[float, float, float] | None = None  # Normal of the plane on which distances are measured
    region: Mapping[str, tuple[float, float]] | None = None  # Least and greatest value of some axes
    switch_cost: float | None = None  # Of the trajectory GOSPA distance; None: it is not computed


def check_options(options: Options, log_path: Path | str | None) -> None:
    """Raise InputError for options out of range or that do not go together."""
    if not (math.isfinite(options.cutoff) and options.cutoff > 0.0):
        raise InputError(f"`cutoff`: expected a finite number above 0, found {options.cutoff}")
    distance = options.match_distance
    if distance is not None and not (math.isfinite(distance) and distance > 0.0):
        raise InputError(f"`match_distance`: expected a finite number above 0, found {distance}")
    _check_places(options)
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


def _check_places(options: Options) -> None:
    """Raise InputError for a plane, a region or a cost of switches that cannot be."""
    cost = options.switch_cost
    if cost is not None and not (math.isfinite(cost) and cost > 0.0):
        raise InputError(f"`switch_cost`: expected a finite number above 0, found {cost}")
    if options.plane is not None and not (all(map(math.isfinite, options.plane)) and any(options.plane)):
        raise InputError(f"`plane`: expected a normal of three finite numbers, not all 0, found {options.plane}")
    for axis, (low, high) in (options.region or {}).items():
        if axis not in AXES or not low < high:
            raise InputError(f"`region`: expected x, y or z with least < greatest, found {axis} from {low} to {high}")
    for name in ("plane", "region"):
        if getattr(options, name) is not None and options.base == "mahalanobis":
            raise InputError(f"`{name}`: expected `base` euclidean, found mahalanobis")
