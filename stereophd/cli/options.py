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


def argument(metavar: str, text: str) -> Any:
    """Return an argument, whose help does not show the default."""
    return typer.Argument(metavar=metavar, help=text, show_default=False)


def option(name: str, metavar: str, text: str, **more: Any) -> Any:
    """Return an option with a value, whose help does not show the default."""
    return typer.Option(name, metavar=metavar, help=text, show_default=False, **more)


def _to_session(name: str) -> Callable[[typer.Context, Any], Any]:
    """Return a callback that puts the value of an option into the session."""

    def keep(context: typer.Context, value: Any) -> Any:
        setattr(context.ensure_object(Session), name, value)
        return value

    return keep


Config = Annotated[Path, argument("CONFIG", "Configuration (YAML).")]
Out = Annotated[Path, option("--out", "DIR", "Output folder; created if missing.")]
Logs = Annotated[list[Path], argument("LOG", "Detection logs (Parquet), or patterns such as 'day1/*.parquet'.")]
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


def _common(name: str, *words: str, text: str, **more: Any) -> Any:
    """Return an option of every command; its callback puts the value into the session, where the commands read it."""
    return typer.Option(*words, help=text, callback=_to_session(name), is_eager=True, **more)


Json = Annotated[bool, _common("json", "--json", text="Print one JSON document.")]
Quiet = Annotated[bool, _common("quiet", "--quiet", "-q", text="Print errors only, and the document of --json.")]
Verbose = Annotated[
    int,
    _common(
        "verbosity", "--verbose", "-v", text="More messages (-vv: still more).", count=True, metavar="",
        show_default=False,
    ),
]  # fmt: skip
Debug = Annotated[bool, _common("debug", "--debug", text="Show the traceback of an error.")]


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
