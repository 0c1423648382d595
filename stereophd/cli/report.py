"""``stereophd report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.terminal import print_data, print_report


def report_command(
    session: options.Session,
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR", help="Output folders of track, calibrate, evaluate and simulate.", show_default=False
        ),
    ],
    out: Annotated[Path, options.option("--out", "FILE", "The page (HTML).")],
    logs: Annotated[list[Path] | None, options.option("--log", "FILE", "Detection log elsewhere (repeatable).")] = None,
    truths: Annotated[list[Path] | None, options.option("--truth", "FILE", "Truth elsewhere (repeatable).")] = None,
    title: Annotated[str, typer.Option("--title", metavar="TEXT", help="Title of the page.")] = "stereophd report",
    force: options.Force = False,
) -> None:
    """Write one self-contained page (needs the extra 'report'): tracks, cameras, residuals, scores, settings."""
    from stereophd.commands.report import report

    found = report(folders, out, logs=logs or (), truths=truths or (), title=title, force=force)
    if session.json:
        print_report(session, found)
    elif not session.quiet:
        for run in found["runs"]:
            print_data(f"{run['name']}: {run['verdict']}")
        print_data(f"{found['page']} ({found['bytes'] / 1e6:.1f} MB)")
