"""``stereophd export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.flags import with_flags
from stereophd.cli.import_options import Form
from stereophd.cli.terminal import print_report


def export_command(
    session: options.Session,
    form: Form,
    source: Annotated[Path, options.argument("SOURCE", "Tracks (Parquet), cameras, or a folder of them.")],
    out: Annotated[Path, options.option("--out", "FILE", "File to write.")],
    track: Annotated[list[int] | None, options.option("--track", "ID", "Write this track only (repeatable).")] = None,
    rate: Annotated[float | None, options.option("--rate", "HZ", "Resample the tracks to this rate.", min=1e-9)] = None,
    tentative: Annotated[
        bool, typer.Option("--tentative", help="Write tentative estimates too, not only confirmed ones.")
    ] = False,
    force: options.Force = False,
) -> None:
    """Write tracks or cameras as a file of another program."""
    from stereophd.commands.export import export
    from stereophd.io.interchange.base import ExportOptions

    report = export(form, source, out, ExportOptions(track, rate, tentative), force)
    notes = [with_flags(f"{note[:1].upper()}{note[1:]}.") for note in report["notes"]]
    print_report(session, report, lambda: [*notes, f"Written: {out} ({report['what']})"])
