"""Options of ``stereophd evaluate``."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli.options import option
from stereophd.errors import InputError


class Base(StrEnum):
    """Base distance of OSPA and GOSPA."""

    EUCLIDEAN = "euclidean"
    MAHALANOBIS = "mahalanobis"


class Alignment(StrEnum):
    """What of the tracks' frame may be changed."""

    NONE = "none"
    RIGID = "rigid"
    SIMILARITY = "similarity"


class At(StrEnum):
    """Unit that is scored once."""

    TIMES = "times"
    EVENTS = "events"


Tracks = Annotated[
    Path | None, typer.Argument(metavar="TRACKS", help="tracks.parquet, or a folder of runs.", show_default=False)
]
Truth = Annotated[
    Path | None, typer.Argument(metavar="TRUTH", help="truth.parquet, or a folder of truths.", show_default=False)
]
Out = Annotated[Path | None, option("--out", "DIR", "Folder of report.json, per_scan.parquet and plots.")]
Order = Annotated[float, typer.Option("--order", metavar="P", help="Order of OSPA.")]
Cutoff = Annotated[
    float | None,
    option(
        "--cutoff",
        "C",
        "Cutoff of OSPA, in the unit of length; default: evaluation.cutoff of the tracks' configuration, else 20 "
        "for files in centimetres.",
    ),
]
BaseDistance = Annotated[Base, typer.Option("--base", help="Base distance of OSPA and GOSPA.")]
From = Annotated[float | None, option("--from", "T", "First time, s.")]
To = Annotated[float | None, option("--to", "T", "Last time, s.")]
MaxGap = Annotated[
    float | None,
    option("--max-gap", "S", "Never interpolate the truth across a longer gap, s; default 1.5 median steps."),
]
ScoredAt = Annotated[At, typer.Option("--at", help="Score each time once, after its last event, or every event.")]
Log = Annotated[Path | None, option("--log", "FILE", "Detection log, for --seen-by.")]
SeenBy = Annotated[
    int | None,
    option("--seen-by", "N", "Score only objects that N cameras detected in the last --within seconds.", min=1),
]
Within = Annotated[float | None, option("--within", "S", "Time span of --seen-by, s.")]
Ospa2Window = Annotated[
    int, typer.Option("--ospa2-window", metavar="SCANS", min=1, help="Scored scans in a window of OSPA(2).")
]
Tentative = Annotated[bool, typer.Option("--tentative", help="Score tentative estimates too, not only confirmed ones.")]
Align = Annotated[
    Alignment,
    typer.Option(
        "--align",
        help="Before scoring, align the tracks with the truth by a rigid motion (and a scale): for calibrated cameras "
        "whose frame differs from that of the truth.",
    ),
]
AlignClock = Annotated[
    bool,
    typer.Option(
        "--align-clock", help="Score the tracks after a change of their clock's offset and rate, found with --align."
    ),
]
MatchDistance = Annotated[
    float | None,
    option(
        "--match-distance",
        "D",
        "Match tracks and objects nearer than this, for all figures but OSPA, GOSPA and HOTA, in the unit of length; "
        "default: the cutoff. Choose it below the distance between objects.",
    ),
]
Plane = Annotated[
    str | None,
    option("--plane", "X,Y,Z", "Compare positions on the plane of this normal, such as 0,0,1 for the ground."),
]
Region = Annotated[
    str | None,
    option("--region", "AXIS=FROM:TO,...", "Score only objects in this region, such as x=0:5,y=0:4."),
]
SwitchCost = Annotated[
    float | None,
    option(
        "--switch-cost", "G", "Add the trajectory GOSPA distance with this cost of a switch, in the unit of length."
    ),
]
Cameras = Annotated[
    Path | None,
    option(
        "--cameras",
        "FILE",
        "Cameras (YAML): the clocks of --log, the cameras in the plots; with --true-cameras, what is scored.",
    ),
]
TrueCameras = Annotated[
    Path | None,
    option("--true-cameras", "FILE", "True cameras (YAML): score the calibration in --cameras instead of tracks."),
]
Config = Annotated[
    Path | None,
    option(
        "--config", "CONFIG", "With --true-cameras: simulated scenario and priors whose Cramer-Rao bound is reported."
    ),
]
FailAbove = Annotated[
    list[str] | None,
    option(
        "--fail-above", "KEY=VALUE", "Exit with 1 if a figure is above a limit, such as ospa.mean=0.8 (repeatable)."
    ),
]
FailBelow = Annotated[
    list[str] | None,
    option(
        "--fail-below",
        "KEY=VALUE",
        "Exit with 1 if a figure is below a limit, such as completeness.mean=0.9 (repeatable).",
    ),
]


def parse_limits(option: str, texts: list[str]) -> dict[str, float]:
    """Return {key: limit} of the words KEY=VALUE of an option, such as ``--fail-above``."""
    limits: dict[str, float] = {}
    for text in texts:
        key, separator, value = text.partition("=")
        try:
            limit = float(value)
        except ValueError:
            limit = math.nan
        if not key or not separator or not math.isfinite(limit):
            raise InputError(f"{option} {text}: expected KEY=NUMBER, such as ospa.mean=0.8")
        if key in limits:
            raise InputError(f"{option} {text}: expected each key once, found {key} again")
        limits[key] = limit
    return limits


def parse_plane(text: str | None) -> tuple[float, float, float] | None:
    """Return the normal X,Y,Z of ``--plane``."""
    if text is None:
        return None
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise InputError(f"--plane {text}: expected X,Y,Z, such as 0,0,1") from None
    return x, y, z


def parse_region(text: str | None) -> dict[str, tuple[float, float]] | None:
    """Return {axis: (from, to)} of the words AXIS=FROM:TO of ``--region``."""
    if text is None:
        return None
    region: dict[str, tuple[float, float]] = {}
    for word in text.split(","):
        axis, _, limits = word.partition("=")
        try:
            low, high = map(float, limits.split(":"))
        except ValueError:
            raise InputError(f"--region {text}: expected AXIS=FROM:TO,..., such as x=0:5,y=0:4") from None
        region[axis.strip()] = low, high
    return region
