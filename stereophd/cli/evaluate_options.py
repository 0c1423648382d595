"""Options of ``stereophd evaluate``."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from stereophd.errors import InputError


class Base(StrEnum):
    """Base distance of OSPA and GOSPA."""

    EUCLIDEAN = "euclidean"
    MAHALANOBIS = "mahalanobis"


class At(StrEnum):
    """What is scored once."""

    TIMES = "times"
    EVENTS = "events"


class Alignment(StrEnum):
    """What of the tracks' frame may be changed."""

    NONE = "none"
    RIGID = "rigid"
    SIMILARITY = "similarity"


Tracks = Annotated[
    Path | None, typer.Argument(metavar="TRACKS", help="tracks.parquet, or a folder of runs.", show_default=False)
]
Truth = Annotated[
    Path | None, typer.Argument(metavar="TRUTH", help="truth.parquet, or a folder of truths.", show_default=False)
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder of report.json, per_scan.parquet and plots.",
        show_default=False,
    ),
]
Order = Annotated[float, typer.Option("--order", metavar="P", help="Order of OSPA.")]
Cutoff = Annotated[
    float | None,
    typer.Option(
        "--cutoff",
        metavar="C",
        help="Cutoff of OSPA, in the unit of length; default: evaluation.cutoff of the tracks' configuration, else 20 "
        "for files in centimetres.",
        show_default=False,
    ),
]
BaseDistance = Annotated[Base, typer.Option("--base", help="Base distance.")]
From = Annotated[
    float | None,
    typer.Option("--from", metavar="T", help="First time, s.", show_default=False),
]
To = Annotated[
    float | None,
    typer.Option("--to", metavar="T", help="Last time, s.", show_default=False),
]
MaxGap = Annotated[
    float | None,
    typer.Option(
        "--max-gap",
        metavar="S",
        help="Never interpolate the truth across a longer gap, s; default 1.5 median steps.",
        show_default=False,
    ),
]
ScoredAt = Annotated[
    At,
    typer.Option("--at", help="Score each time once, after its last event, or every event."),
]
Log = Annotated[
    Path | None,
    typer.Option(
        "--log",
        metavar="FILE",
        help="Detection log, for --seen-by.",
        show_default=False,
    ),
]
SeenBy = Annotated[
    int | None,
    typer.Option(
        "--seen-by",
        metavar="N",
        min=1,
        help="Score only objects that N cameras detected within --within seconds.",
        show_default=False,
    ),
]
Within = Annotated[
    float | None,
    typer.Option("--within", metavar="S", help="Seconds of --seen-by.", show_default=False),
]
Ospa2Window = Annotated[
    int,
    typer.Option("--ospa2-window", metavar="SCANS", min=1, help="Scored scans in a window of OSPA(2)."),
]
Tentative = Annotated[
    bool,
    typer.Option("--tentative", help="Score tentative estimates beside the confirmed ones."),
]
Align = Annotated[
    Alignment,
    typer.Option(
        "--align",
        help="Score the tracks after the motion (and the scale) that brings them nearest to the truth: for cameras "
        "that calibrated themselves.",
    ),
]
AlignClock = Annotated[
    bool,
    typer.Option(
        "--align-clock", help="Score the tracks after a change of their clock's offset and rate, found with --align."
    ),
]
Cameras = Annotated[
    Path | None,
    typer.Option(
        "--cameras",
        metavar="FILE",
        help="Cameras (YAML): the clocks of --log, the cameras in the plots; with --true-cameras, what is scored.",
        show_default=False,
    ),
]
TrueCameras = Annotated[
    Path | None,
    typer.Option(
        "--true-cameras",
        metavar="FILE",
        help="True cameras (YAML): score the calibration in --cameras instead of tracks.",
        show_default=False,
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="CONFIG",
        help="With --true-cameras: simulated scenario and priors whose Cramer-Rao bound is reported.",
        show_default=False,
    ),
]
FailAbove = Annotated[
    list[str] | None,
    typer.Option(
        "--fail-above",
        metavar="KEY=VALUE",
        help="Exit with 1 if a figure is above a limit, such as ospa.mean=0.8 (repeatable).",
        show_default=False,
    ),
]
FailBelow = Annotated[
    list[str] | None,
    typer.Option(
        "--fail-below",
        metavar="KEY=VALUE",
        help="Exit with 1 if a figure is below a limit, such as completeness.mean=0.9 (repeatable).",
        show_default=False,
    ),
]
Plots = Annotated[
    bool | None,
    typer.Option(
        "--plots/--no-plots",
        help="Make plots (needs the extra 'plot'); default: if it is installed.",
        show_default=False,
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
