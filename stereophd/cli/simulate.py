"""``stereophd simulate``."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli.options import ConfigWords, Session
from stereophd.cli.options import option as shared_option
from stereophd.cli.terminal import load, print_report, progress_bar
from stereophd.cli.unused_options import refuse
from stereophd.commands.options import SimulateOptions
from stereophd.errors import InputError

Out = Annotated[Path | None, shared_option("--out", "DIR", "Output folder; created if missing.")]
RealTime = Annotated[
    bool,
    typer.Option(
        "--realtime", help="Write no files: each frame goes to standard output as a line of JSON, at its time."
    ),
]


def simulate_command(
    session: Session, words: ConfigWords, options: SimulateOptions, out: Out = None, realtime: RealTime = False
) -> None:
    """Simulate a scene: detections.parquet, truth.parquet and cameras.yaml.

    If the configuration has a section calibration, guess.yaml is written too: wrong cameras for calibrate.
    """
    if options.runs is None:
        refuse(session, ("jobs",), "with --runs N, found one run")
    loaded = load(words)
    if realtime:
        refuse(session, ("out", "runs", "force_size"), "without --realtime")
        from stereophd.commands.simulate import play_frames

        for line in play_frames(loaded):
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
        return
    if out is None:
        raise InputError("--out: expected a folder, found none (see 'stereophd simulate --help')")
    from stereophd.commands.simulate import simulate

    with progress_bar(session, "simulate") as progress:
        summary = simulate(loaded, out, options=options, progress=progress)
    print_report(session, summary)
