"""``stereophd simulate``."""

from __future__ import annotations

from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.terminal import begin, load, print_report, progress_bar
from stereophd.cli.unused_options import refuse


def simulate_command(
    context: typer.Context,
    config: options.Config,
    out: options.Out,
    cameras: options.Cameras = None,
    runs: Annotated[int | None, options.option("--runs", "N", "Make N runs, in folders run-0000, ...", min=1)] = None,
    jobs: Annotated[int, typer.Option("--jobs", metavar="N", min=1, help="Processes for --runs.")] = 1,
    overrides: options.Set = None,
    seed: options.Seed = None,
    force: options.Force = False,
    force_size: options.ForceSize = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
    debug: options.Debug = False,
) -> None:
    """Simulate a scene: detections.parquet, truth.parquet and cameras.yaml.

    If the configuration has a section calibration, guess.yaml is written too: wrong cameras for calibrate.
    """
    session = begin(context)
    if runs is None:
        refuse(context, ("jobs",), "with --runs N, found one run")
    loaded = load(config, overrides, seed, cameras)
    from stereophd.commands.simulate import simulate

    with progress_bar(session, "simulate") as progress:
        summary = simulate(loaded, out, runs=runs, force=force, jobs=jobs, progress=progress, force_size=force_size)
    print_report(session, summary)
