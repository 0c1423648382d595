"""``stereophd export``."""

from pathlib import Path
from typing import Annotated

from stereophd.cli.flags import with_flags
from stereophd.cli.options import Form, Session, argument, option
from stereophd.cli.terminal import print_report
from stereophd.commands.options import Replacing
from stereophd.io.interchange.options import ExportOptions

Source = Annotated[Path, argument("SOURCE", "Tracks (Parquet), cameras, or a folder of them.")]
Out = Annotated[Path, option("--out", "FILE", "File to write.")]


def export_command(
    session: Session, form: Form, source: Source, out: Out, options: ExportOptions, replacing: Replacing
) -> None:
    """Write tracks or cameras as a file of another program."""
    from stereophd.commands.export import export

    report = export(form, source, out, options, replacing.force)
    notes = [with_flags(f"{note[:1].upper()}{note[1:]}.") for note in report["notes"]]
    print_report(session, report, lambda: [*notes, f"Written: {out} ({report['what']})"])
