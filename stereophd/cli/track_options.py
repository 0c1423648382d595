"""Options of ``stereophd track``."""

from __future__ import annotations

from typing import Annotated

import typer

from stereophd.cli.options import option

Jobs = Annotated[
    int,
    typer.Option(
        "--jobs",
        metavar="N",
        min=1,
        help="Processes for several logs, or for the pieces of one; the results do not depend on it.",
    ),
]
Threads = Annotated[
    int, typer.Option("--threads", metavar="N", min=1, help="Threads; the outputs do not depend on it.")
]
Pieces = Annotated[
    float | None,
    option(
        "--pieces",
        "S",
        "Cut the log into pieces of S seconds, track them independently, and join their tracks. The last piece is "
        "shorter, or longer by up to the overlap.",
    ),
]
Overlap = Annotated[
    float | None,
    option("--overlap", "S", "Seconds before its own span that each piece also tracks [60]."),
]
Resume = Annotated[bool, typer.Option("--resume", help="Continue an interrupted run; keep what is finished.")]
Smooth = Annotated[bool, typer.Option("--smooth", help="Smooth every track over the whole log (report.smooth).")]
Associations = Annotated[
    bool, typer.Option("--associations", help="Write which detection belongs to which track (report.associations).")
]
Plots = Annotated[
    bool,
    typer.Option("--plots", help="Draw views, timelines, residuals (needs the extra 'plot'; adds --associations)."),
]
