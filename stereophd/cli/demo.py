"""``stereophd demo``."""

import shlex
from pathlib import Path
from typing import Annotated, Any

from stereophd.cli import options
from stereophd.cli.terminal import print_report, progress_bar
from stereophd.commands.options import Replacing
from stereophd.site import page


def demo_command(
    session: options.Session,
    folder: Annotated[Path, options.argument("DIR", "Folder of the demonstration; created if missing.")],
    replacing: Replacing,
) -> None:
    """Simulate, track and score a small scene, and write a page to open in a browser.

    Three cameras that are not synchronised watch a hall. The first run compiles the numerical kernels, which takes up
    to a minute.
    """
    from stereophd.commands.demo import demo

    with progress_bar(session, "demo") as progress:
        result = demo(folder, replacing.force, progress)
    print_report(session, result, lambda: _lines(folder, result))


def _lines(folder: Path, result: dict[str, Any]) -> list[str]:
    """Return what was found, and what to run next."""
    log, study = folder / "simulated" / "detections.parquet", folder / "study"
    commands = [
        ["stereophd", "init", str(study), "--log", str(log)],
        ["stereophd", "track", str(study / "config.yaml"), str(log), "--smooth", "--out", str(study / "tracks")],
    ]
    opened = (
        f"Open in a browser: {result['page']}"
        if result["page"]
        else "For a page to open in a browser: pip install plotly, then run this again with --force"
    )
    return [
        f"{result['tracks']} tracks; median error {100 * result['median_error_m']:.1f} cm, "
        f"mean OSPA {100 * result['ospa_m']:.1f} cm",
        opened,
        "Next, the same detections with settings that are estimated from them:",
        *(f"  {shlex.join(words)}" for words in commands),
        f"With your own recording: {page('start/import')}",
    ]
