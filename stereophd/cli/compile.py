"""``stereophd compile``."""

from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.terminal import print_report

Jobs = Annotated[int, typer.Option("--jobs", metavar="N", min=1, help="Processes; the results do not depend on it.")]


def compile_command(session: options.Session, jobs: Jobs = 1) -> None:
    """Compile the kernels of `track` and keep them: for images of containers and the cache of a CI job."""
    from stereophd.commands.compile import compile_kernels

    report = compile_kernels(jobs)
    print_report(session, report, lambda: f"kernels of {', '.join(report['filters'])}: kept in {report['folder']}")
