"""Options that several commands share. Nothing heavy may be imported here: ``--help`` must be quick."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from stereophd.site import page


@dataclass
class CommonWords:
    """Options that every command has."""

    json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only, and the document of --json.")] = False
    verbosity: Annotated[
        int,
        typer.Option(
            "--verbose", "-v", help="More messages (-vv: still more).", count=True, metavar="", show_default=False
        ),
    ] = 0
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False


@dataclass
class Session(CommonWords):
    """A call of the command line."""

    printed: bool = False  # whether the one document of `json` is on stdout
    words: tuple[str, ...] = ()  # of the command line
    context: typer.Context | None = None  # of the command that runs


#: Heading in the help -> options below it, if a command has several of them; all others come first.
GROUPS = {
    "Configuration": ("--cameras", "--set", "--seed"),
    "Outputs": ("--out", "--force", "--plots", "--title", "--realtime", "--ignore-size-limit"),
    "Distances": ("--order", "--cutoff", "--base", "--match-distance", "--switch-cost", "--ospa2-window", "--plane"),
    "What is scored": (
        "--from", "--to", "--at", "--max-gap", "--seen-by", "--seen-within", "--log", "--region", "--tentative",
    ),
    "Alignment": ("--align", "--align-clock"),
    "Frames and times": ("--fps", "--offset", "--recorded-frames", "--fill-missing-frames", "--time-unit"),
    "Pixels and boxes": (
        "--image-size", "--pixel-origin", "--rows-from", "--box-point", "--min-score", "--pixels-undistorted",
    ),
    "Detectors": ("--sigma-px", "--p-detect", "--clutter"),
    "Gates": ("--strict", "--require-status", "--fail-above", "--fail-below"),
    "Many or long logs": ("--runs", "--jobs", "--dask", "--threads", "--pieces", "--overlap", "--resume"),
    "Running recordings": ("--follow", "--listen", "--record"),
    "Common options": ("--json", "--quiet", "--verbose", "--debug", "--help"),
}  # fmt: skip


class _Examples:
    """The end of a help page: examples, printed as they are."""

    epilog: str | None

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples: lines that must not be wrapped."""
        if self.epilog:
            formatter.write(f"\n{self.epilog}\n")


class PlainGroup(_Examples, typer.core.TyperGroup):
    """A group of commands whose help ends with examples."""


class PlainCommand(_Examples, typer.core.TyperCommand):
    """A command whose help names arguments by their words alone, and options by groups."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Keep the words, which --help would end before they are parsed."""
        ctx.meta["words"] = list(args)
        return list(super().parse_args(ctx, args))

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        """Write what the command does, and of `import FORMAT --help` what the format holds."""
        super().format_help_text(ctx, formatter)
        word = next(iter(ctx.meta["words"]), "-")
        if not word.startswith("-") and any(parameter.name == "form" for parameter in self.params):
            from stereophd.cli.flags import with_flags  # only here: both import what the commands need
            from stereophd.io.interchange.registry import description

            formatter.write_paragraph()
            with formatter.indentation():
                formatter.write_text(with_flags(description(word)).replace("``", ""))

    def format_usage(self, ctx: Any, formatter: Any) -> None:
        """Write the usage line: words in capitals, optional ones in brackets, dots after those that repeat."""
        pieces = [_shown_argument(parameter) for parameter in self.get_params(ctx) if _is_argument(parameter)]
        formatter.write_usage(ctx.command_path, " ".join([*pieces, "[OPTIONS]"]))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, and the options by groups."""
        known = {flag for parameter in self.get_params(ctx) for flag in parameter.opts}
        groups = {heading: known.intersection(flags) for heading, flags in GROUPS.items()}
        heading_of = {flag: heading for heading, flags in groups.items() for flag in flags if len(flags) > 1}
        sections: dict[str, list[tuple[str, str]]] = {heading: [] for heading in ("Arguments", "Options", *GROUPS)}
        for parameter in self.get_params(ctx):
            if _is_argument(parameter):
                text = vars(parameter)["help"] or ""
                sections["Arguments"].append((_name_of_argument(parameter), text))
            elif (record := parameter.get_help_record(ctx)) is not None:
                flags = [heading_of[flag] for flag in parameter.opts if flag in heading_of]
                sections[flags[0] if flags else "Options"].append(record)
        for heading, rows in sections.items():
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)


def _is_argument(parameter: Any) -> bool:
    return bool(parameter.param_type_name == "argument")


def _name_of_argument(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper()).removesuffix("...")


def _shown_argument(parameter: Any) -> str:
    name = _name_of_argument(parameter) + ("..." if parameter.nargs != 1 else "")
    return name if parameter.required else f"[{name}]"


def argument(metavar: str, text: str) -> Any:
    """Return an argument, whose help does not show the default."""
    return typer.Argument(metavar=metavar, help=text, show_default=False)


def option(name: str, metavar: str, text: str, **more: Any) -> Any:
    """Return an option with a value, whose help does not show the default."""
    return typer.Option(name, metavar=metavar, help=text, show_default=False, **more)


Form = Annotated[
    str, argument("FORMAT", f"Format; csv --help, for one, describes csv. All: {page('reference/interchange')}")
]
Config = Annotated[Path, argument("CONFIG", "Configuration (YAML), or its folder.")]
Out = Annotated[Path, option("--out", "DIR", "Output folder; created if missing.")]
Logs = Annotated[list[Path], argument("LOG", "Detection logs (Parquet), or patterns such as 'day1/*.parquet'.")]
Cameras = Annotated[
    Path | None,
    option(
        "--cameras", "FILE", "Cameras (YAML) in place of the configuration's, but for detectors that it does not state."
    ),
]
Set = Annotated[
    list[str] | None,
    option(
        "--set", "KEY=VALUE", "Change a value of the configuration, such as --set filter.birth.per_s=0.2 (repeatable)."
    ),
]
Seed = Annotated[int | None, option("--seed", "N", "Seed of the random numbers, in place of the configuration's.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with code 1 if a check warns.")]


@dataclass(frozen=True)
class SceneWords:
    """A configuration with the cameras that it names, and what replaces its values."""

    config: Config
    overrides: Set = None
    seed: Seed = None


@dataclass(frozen=True)
class ConfigWords(SceneWords):
    """A configuration, and cameras that replace those that it names."""

    cameras: Cameras = None
