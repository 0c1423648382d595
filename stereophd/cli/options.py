"""Options that several commands share. Nothing heavy may be imported here: ``--help`` must be quick."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core


@dataclass
class Session:
    """Common options of a call of the command line."""

    json: bool = False
    quiet: bool = False
    verbosity: int = 0
    debug: bool = False
    printed: bool = False  # whether the one document of `json` is on stdout
    context: typer.Context | None = None  # of the command that runs


class PlainCommand(typer.core.TyperCommand):
    """A command whose help names arguments by their words alone, without the types of Python."""

    def get_params(self, ctx: typer.Context) -> list[Any]:  # type: ignore[override]
        """Return arguments and options."""
        parameters = super().get_params(ctx)
        for parameter in parameters:
            if parameter.param_type_name == "argument":
                vars(parameter)["display_type_rich"] = lambda ctx: None
        return parameters


def option(name: str, metavar: str, text: str, **more: Any) -> Any:
    """Return an option with a value, whose help does not show the default."""
    return typer.Option(name, metavar=metavar, help=text, show_default=False, **more)


def _to_session(name: str) -> Callable[[typer.Context, Any], Any]:
    """Return a callback that puts the value of an option into the session."""

    def keep(context: typer.Context, value: Any) -> Any:
        setattr(context.ensure_object(Session), name, value)
        return value

    return keep


Config = Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration (YAML).", show_default=False)]
Out = Annotated[Path, option("--out", "DIR", "Output folder; created if missing.")]
Logs = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG", help="Detection logs (Parquet), or patterns such as 'day1/*.parquet'.", show_default=False
    ),
]
Cameras = Annotated[Path | None, option("--cameras", "FILE", "Cameras (YAML) in place of the configuration's.")]


def _complete_set(incomplete: str) -> list[str]:
    from stereophd.cli.completion import complete_set  # only here: completion alone reads the schema

    return complete_set(incomplete)


Set = Annotated[
    list[str] | None,
    option(
        "--set",
        "KEY=VALUE",
        "Change a value of the configuration, such as --set filter.birth.per_s=0.2 (repeatable).",
        autocompletion=_complete_set,
    ),
]
Seed = Annotated[int | None, option("--seed", "N", "Seed of the run.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with code 1 if a check warns.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the outputs of an earlier run.")]
# The callbacks of Json, Quiet, Verbose and Debug put their values into the session, where the commands read them.
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON document.", callback=_to_session("json"), is_eager=True)
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        help="Print errors only, and the document of --json.",
        callback=_to_session("quiet"),
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
        callback=_to_session("verbosity"),
        is_eager=True,
        show_default=False,
    ),
]
Debug = Annotated[
    bool,
    typer.Option(
        "--debug",
        help="Show the traceback of an error.",
        callback=_to_session("debug"),
        is_eager=True,
    ),
]


@dataclass(frozen=True)
class ConfigWords:
    """A configuration, its cameras, and what replaces its values."""

    config: Config
    cameras: Cameras = None
    overrides: Set = None
    seed: Seed = None


@dataclass(frozen=True)
class SceneWords:
    """A configuration with the cameras that it names."""

    config: Config
    overrides: Set = None
    seed: Seed = None
