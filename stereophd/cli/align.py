"""``stereophd align``."""

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.terminal import print_data, print_report
from stereophd.cli.unused_options import report as report_unused
from stereophd.commands.options import AlignOptions


def align_command(
    session: options.Session,
    cameras: Annotated[
        list[Path],
        typer.Argument(
            metavar="CAMERAS", help="cameras.yaml, or folders of calibrate or track that hold them.", show_default=False
        ),
    ],
    to: Annotated[
        str,
        options.option(
            "--to",
            "WORLD",
            "Control track (time_s, x, y, z) or points (camera, u_px, v_px, x, y, z), Parquet or CSV; floor, gravity, "
            "or a camera's name.",
        ),
    ],
    words: AlignOptions,
    out: Annotated[
        Path | None, options.option("--out", "DIR", "Folder of the cameras and tables in the world.")
    ] = None,
) -> None:
    """Bring cameras and their tracks into a world frame: scale, rotation, place and clock, with uncertainties."""
    if out is None:
        report_unused(session, ("force",), "with --out DIR")
    from stereophd.commands.align import align
    from stereophd.report.alignments import alignments_text

    found = align(cameras, to, out, options=words)
    if session.json:
        print_report(session, found)
    elif not session.quiet:
        print_data(alignments_text(found))
