"""``stereophd info``, ``report`` and ``export``: commands about files that exist."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from stereophd.cli.options import Form, Session, argument, option
from stereophd.cli.terminal import print_report
from stereophd.commands.options import Replacing, ReportOptions
from stereophd.io.interchange.options import ExportOptions

Anything = Annotated[Path, argument("FILE|DIR", "Log, table, cameras, configuration or folder.")]
Folders = Annotated[list[Path], argument("DIR", "Output folders of track, calibrate, evaluate and simulate.")]
Page = Annotated[Path, option("--out", "FILE", "The page (HTML).")]
Source = Annotated[Path, argument("SOURCE", "Tracks (Parquet), cameras, or a folder of them.")]
Out = Annotated[Path, option("--out", "FILE", "File to write.")]


def info_command(session: Session, path: Anything) -> None:
    """Describe what a log, a table, a file of cameras or an output folder holds, and what made it."""
    from stereophd.commands.info import info
    from stereophd.report.inspection import info_text

    described = info(path)
    print_report(session, described, lambda: info_text(described))


def report_command(session: Session, folders: Folders, out: Page, options: ReportOptions) -> None:
    """Write one self-contained page (needs the extra 'report'): tracks, cameras, residuals, scores, settings."""
    from stereophd.commands.report import report

    made = report(folders, out, options=options)
    verdicts = [f"{run['name']}: {run['verdict']}" for run in made["runs"]]
    print_report(session, made, lambda: [*verdicts, f"{made['page']} ({made['bytes'] / 1e6:.1f} MB)"])


def export_command(
    session: Session, form: Form, source: Source, out: Out, options: ExportOptions, replacing: Replacing
) -> None:
    """Write tracks or cameras as a file of another program."""
    from stereophd.commands.export import export

    report = export(form, source, out, options, replacing.force)
    notes = [f"{note[:1].upper()}{note[1:]}." for note in report["notes"]]
    print_report(session, report, lambda: [*notes, f"Written: {out} ({report['what']})"])
