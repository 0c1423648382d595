"""``stereophd simulate``."""

from __future__ import annotations

from stereophd.cli.options import ConfigWords, Out, Session
from stereophd.cli.terminal import load, print_report, progress_bar
from stereophd.cli.unused_options import refuse
from stereophd.commands.options import SimulateOptions


def simulate_command(session: Session, words: ConfigWords, out: Out, options: SimulateOptions) -> None:
    """Simulate a scene: detections.parquet, truth.parquet and cameras.yaml.

    If the configuration has a section calibration, guess.yaml is written too: wrong cameras for calibrate.
    """
    if options.runs is None:
        refuse(session, ("jobs",), "with --runs N, found one run")
    loaded = load(words)
    from stereophd.commands.simulate import simulate

    with progress_bar(session, "simulate") as progress:
        summary = simulate(loaded, out, options=options, progress=progress)
    print_report(session, summary)
