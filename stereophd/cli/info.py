"""``stereophd info``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.terminal import print_data, print_report


def info_command(
    session: options.Session,
    path: Annotated[
        Path,
        typer.Argument(metavar="FILE|DIR", help="Log, table, cameras, configuration or folder.", show_default=False),
    ],
) -> None:
    """Describe what a log, a table, a file of cameras or an output folder holds, and what made it."""
    from stereophd.commands.info import info
    from stereophd.report.inspection import info_text

    found = info(path)
    if session.json:
        print_report(session, found)
    elif not session.quiet:
        print_data(info_text(found))
