"""``stereophd compile``."""

from __future__ import annotations

import typer

from stereophd.cli import options
from stereophd.cli.terminal import begin, print_data, print_report


def compile_command(
    context: typer.Context,
    jobs: options.Jobs = 1,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
    debug: options.Debug = False,
) -> None:
    """Compile the kernels of `track` and keep them: for images of containers and the cache of a CI job."""
    session = begin(context)
    from stereophd.commands.compile import compile_kernels

    report = compile_kernels(jobs)
    if session.json:
        print_report(session, report)
    elif not session.quiet:
        print_data(f"kernels of {', '.join(report['filters'])}: kept in {report['folder']}")
