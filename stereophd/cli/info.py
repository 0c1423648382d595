"""``stereophd info``."""

from pathlib import Path
from typing import Annotated

from stereophd.cli import options
from stereophd.cli.terminal import print_report


def info_command(
    session: options.Session,
    path: Annotated[Path, options.argument("FILE|DIR", "Log, table, cameras, configuration or folder.")],
) -> None:
    """Describe what a log, a table, a file of cameras or an output folder holds, and what made it."""
    from stereophd.commands.info import info
    from stereophd.report.inspection import info_text

    described = info(path)
    print_report(session, described, lambda: info_text(described))
