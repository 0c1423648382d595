"""``stereophd report``."""

from pathlib import Path
from typing import Annotated

from stereophd.cli.options import Session, argument, option
from stereophd.cli.terminal import print_report
from stereophd.commands.options import ReportOptions

Folders = Annotated[list[Path], argument("DIR", "Output folders of track, calibrate, evaluate and simulate.")]
Out = Annotated[Path, option("--out", "FILE", "The page (HTML).")]


def report_command(session: Session, folders: Folders, out: Out, options: ReportOptions) -> None:
    """Write one self-contained page (needs the extra 'report'): tracks, cameras, residuals, scores, settings."""
    from stereophd.commands.report import report

    made = report(folders, out, options=options)
    verdicts = [f"{run['name']}: {run['verdict']}" for run in made["runs"]]
    print_report(session, made, lambda: [*verdicts, f"{made['page']} ({made['bytes'] / 1e6:.1f} MB)"])
