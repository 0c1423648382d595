"""Options that several commands share. Nothing heavy may be imported here: ``--help`` must be quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer


@dataclass
class Session:
    """Common options of a call of the command line."""

    json: bool = False
    quiet: bool = False
    verbosity: int = 0
    debug: bool = False
    printed: bool = False  # whether the one document of `json` is on stdout


def _set_json(context: typer.Context, value: bool) -> bool:
    context.ensure_object(Session).json = value
    return value


def _set_quiet(context: typer.Context, value: bool) -> bool:
    context.ensure_object(Session).quiet = value
    return value


def _set_verbosity(context: typer.Context, value: int) -> int:
    context.ensure_object(Session).verbosity = value
    return value


def _set_debug(context: typer.Context, value: bool) -> bool:
    context.ensure_object(Session).debug = value
    return value


Config = Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration (YAML).", show_default=False)]
Out = Annotated[
    Path,
    typer.Option("--out", metavar="DIR", help="Output folder; created if missing.", show_default=False),
]
Logs = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...", help="Detection logs (Parquet), or patterns such as 'day1/*.parquet'.", show_default=False
    ),
]
Jobs = Annotated[int, typer.Option("--jobs", metavar="N", min=1, help="Processes; the results do not depend on it.")]
Dask = Annotated[
    str | None,
    typer.Option(
        "--dask",
        metavar="ADDRESS",
        help="Run on the workers of a Dask cluster, such as tcp://host:8786.",
        show_default=False,
    ),
]
Cameras = Annotated[
    Path | None,
    typer.Option(
        "--cameras",
        metavar="FILE",
        help="Cameras (YAML) in place of the configuration's.",
        show_default=False,
    ),
]


def _complete_set(incomplete: str) -> list[str]:
    from stereophd.cli.completion import complete_set  # only here: completion alone reads the schema

    return complete_set(incomplete)


Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        autocompletion=_complete_set,
        metavar="KEY=VALUE",
        help="Change a value of the configuration, such as --set filter.birth.per_s=0.2 (repeatable).",
        show_default=False,
    ),
]
Seed = Annotated[
    int | None,
    typer.Option("--seed", metavar="N", help="Seed of the run.", show_default=False),
]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with code 1 if a check warns.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the outputs of an earlier run.")]
ForceSize = Annotated[bool, typer.Option("--force-size", help="Run even if that takes very long or much room.")]
# The values of the following four reach the session by their callbacks, and the commands through it.
Json = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON document.", callback=_set_json, is_eager=True),
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        help="No progress or messages, and no summary: only errors, and what --json prints.",
        callback=_set_quiet,
        is_eager=True,
    ),
]
Verbose = Annotated[
    int,
    typer.Option(
        "--verbose",
        "-v",
        count=True,
        metavar="",
        help="More messages (-vv: still more).",
        callback=_set_verbosity,
        is_eager=True,
        show_default=False,
    ),
]
Debug = Annotated[
    bool,
    typer.Option(
        "--debug",
        help="Show the traceback of an error.",
        callback=_set_debug,
        is_eager=True,
    ),
]
