"""``stereophd report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.terminal import print_report


def report_command(
    session: options.Session,
    folders: Annotated[
        list[Path], options.argument("DIR", "Output folders of track, calibrate, evaluate and simulate.")
    ],
    out: Annotated[Path, options.option("--out", "FILE", "The page (HTML).")],
    logs: Annotated[list[Path] | None, options.option("--log", "FILE", "Detection log elsewhere (repeatable).")] = None,
    truths: Annotated[list[Path] | None, options.option("--truth", "FILE", "Truth elsewhere (repeatable).")] = None,
    title: Annotated[str, typer.Option("--title", metavar="TEXT", help="Title of the page.")] = "stereophd report",
    force: options.Force = False,
) -> None:
    """Write one self-contained page (needs the extra 'report'): tracks, cameras, residuals, scores, settings."""
    from stereophd.commands.report import report

    made = report(folders, out, logs=logs or (), truths=truths or (), title=title, force=force)
    verdicts = [f"{run['name']}: {run['verdict']}" for run in made["runs"]]
    print_report(session, made, lambda: [*verdicts, f"{made['page']} ({made['bytes'] / 1e6:.1f} MB)"])
