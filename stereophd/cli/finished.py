"""``stereophd info``, ``align``, ``report`` and ``export``: commands about files that exist."""

from pathlib import Path
from typing import Annotated

from stereophd.cli.options import Form, Session, argument, option
from stereophd.cli.terminal import print_report
from stereophd.cli.unused_options import report as report_unused
from stereophd.commands.options import AlignOptions, Replacing, ReportOptions
from stereophd.io.interchange.options import ExportOptions

Anything = Annotated[Path, argument("FILE|DIR", "Log, table, cameras, configuration or folder.")]
CameraFiles = Annotated[
    list[Path], argument("CAMERAS", "cameras.yaml, or folders of calibrate or track that hold them.")
]
World = Annotated[
    str,
    option(
        "--to",
        "WORLD",
        "Control track (time_s, x, y, z) or points (camera, u_px, v_px, x, y, z), Parquet or CSV; floor, gravity, "
        "or a camera's name.",
    ),
]
Moved = Annotated[Path | None, option("--out", "DIR", "Folder of the cameras and tables in the world.")]
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


def align_command(session: Session, cameras: CameraFiles, to: World, words: AlignOptions, out: Moved = None) -> None:
    """Bring cameras and their tracks into a world frame: scale, rotation, place and clock, with uncertainties."""
    if out is None:
        report_unused(session, ("force",), "with --out DIR")
    from stereophd.commands.align import align
    from stereophd.report.camera_scores import alignments_text

    found = align(cameras, to, out, options=words)
    print_report(session, found, lambda: alignments_text(found))


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
