"""``stereophd config show|check|schema``."""

from typing import Annotated, Literal

import typer

from stereophd.cli import options
from stereophd.cli.parameters import command
from stereophd.cli.terminal import load, print_data, print_report, to_json

app = typer.Typer(help="Show or check a configuration, or print its JSON schema.", no_args_is_help=True)


@app.command("show", cls=options.PlainCommand, epilog="Example:\n  stereophd config show study/config.yaml")
@command
def show_command(session: options.Session, words: options.ConfigWords) -> None:
    """Print the complete configuration.

    Defaults, overrides and cameras are filled in.
    """
    loaded = load(words)
    if session.json:
        print_data(to_json(loaded.resolved))
        return
    import yaml

    text = yaml.safe_dump(loaded.config.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=100)
    print_data(f"# sha256 {loaded.sha256}\n{text.rstrip()}")


@app.command(
    "check", cls=options.PlainCommand, epilog="Example:\n  stereophd config check study/config.yaml --for track"
)
@command
def check_command(
    session: options.Session,
    words: options.ConfigWords,
    for_command: Annotated[
        Literal["track", "calibrate", "simulate", "experiment"] | None,
        typer.Option("--for", help="Check also what this command needs.", show_default=False),
    ] = None,
) -> None:
    """Check a configuration, and print every fault.

    Each fault is printed with its file, line and key; a configuration without a fault is ok.
    """
    loaded = load(words)
    from stereophd.commands.check import check_config

    check_config(loaded, for_command)
    valid = {"ok": True, "cameras": list(loaded.cameras), "config_sha256": loaded.sha256}
    cameras_text, unit = ", ".join(loaded.cameras) or "none", loaded.config.units.length
    print_report(session, valid, lambda: f"{words.config}: ok (cameras: {cameras_text}; length in {unit})")


@app.command("schema", cls=options.PlainCommand, epilog="Example:\n  stereophd config schema > schema.json")
@command
def schema_command(session: options.Session) -> None:
    """Print the JSON schema, which editors use."""
    from stereophd.config.loading import schema_text

    print_data(schema_text().rstrip("\n"))
