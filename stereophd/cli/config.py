"""``stereophd config show|check|schema``."""

from __future__ import annotations

import typer

from stereophd.cli import options
from stereophd.cli.terminal import begin, load, print_data, to_json

app = typer.Typer(help="Show or check a configuration, or print its JSON schema.", no_args_is_help=True)


@app.command("show")
def show_command(
    context: typer.Context,
    config: options.Config,
    cameras: options.Cameras = None,
    overrides: options.Set = None,
    seed: options.Seed = None,
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Print the complete configuration: defaults, overrides and cameras filled in."""
    session = begin(context)
    loaded = load(config, overrides, seed, cameras)
    if session.json:
        print_data(to_json(loaded.resolved))
        return
    import yaml

    text = yaml.safe_dump(loaded.resolved, sort_keys=False, default_flow_style=None, width=100)
    print_data(f"# sha256 {loaded.sha256}\n{text.rstrip()}")


@app.command("check")
def check_command(
    context: typer.Context,
    config: options.Config,
    cameras: options.Cameras = None,
    overrides: options.Set = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Check a configuration: says ok, or every fault with its file, line and key."""
    session = begin(context)
    loaded = load(config, overrides, seed, cameras)
    if loaded.config.experiment is not None:
        from stereophd.experiments.engine.plan import check_experiment

        check_experiment(loaded)
    if session.json:
        print_data(to_json({"ok": True, "cameras": list(loaded.cameras), "config_sha256": loaded.sha256}))
    elif not session.quiet:
        cameras_text = ", ".join(loaded.cameras) or "none"
        print_data(f"{config}: ok (cameras: {cameras_text}; length in {loaded.config.units.length})")


@app.command("schema")
def schema_command(json: options.Json = False, debug: options.Debug = False) -> None:
    """Print the JSON schema of a configuration, which editors use (with or without --json)."""
    from stereophd.config.loading import schema_text

    print_data(schema_text().rstrip("\n"))
