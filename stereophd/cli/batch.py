"""Summary and exit code of a command over many inputs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from stereophd.cli.flags import with_flags
from stereophd.cli.options import Session
from stereophd.cli.terminal import print_data, quiet_pipe, to_json

if TYPE_CHECKING:
    from rich.table import Table

# Not in the table: the folder identifies the log, and messages are printed below the table.
_NOT_IN_TABLE = frozenset({"log", "message"})

# Characters of a line of the table where no terminal limits it.
_PIPED_WIDTH = 180


def are_many(paths: Sequence[Path]) -> bool:
    """Return whether paths and patterns name several files, or none; the alternative is exactly one file."""
    from stereophd.pipeline.batch.names import expand

    return len(paths) > 1 or len(expand(paths)) > 1


def finish_batch(session: Session, found: Mapping[str, Any], strict: bool = False) -> None:
    """Print the summary of a batch, and exit with its code: 2 where an input failed.

    Parameters
    ----------
    session : Session
    found : mapping
        What `stereophd.pipeline.batch.run.run_batch` returns.
    strict : bool
        Whether the exit code is 1 if a check warns.
    """
    rows = found["logs"]
    if session.json:
        print_data(to_json(found))
    elif not session.quiet:
        _print_table(rows, found)
    code = found["exit_code"]
    if code == 0 and strict and any(row.get("warnings") for row in rows):
        code = 1
    if code:
        raise typer.Exit(code)


def say_what_is_kept(out: Path) -> None:
    """Report that an interrupted command can be continued, if it can."""
    from stereophd.pipeline.runs.unfinished import can_resume

    if can_resume(out) or any(out.glob("*/report.json")):
        print(f"finished parts are kept in {out}; --resume continues", file=sys.stderr)


def _print_table(rows: Sequence[Mapping[str, Any]], found: Mapping[str, Any]) -> None:
    """Print a row for each input, and the messages of those that failed."""
    from rich.console import Console
    from rich.markup import escape

    console = Console(width=None if sys.stdout.isatty() else _PIPED_WIDTH)
    with quiet_pipe():
        console.print(_table(rows))
        for row in rows:
            if row["message"]:
                console.print(f"{escape(row['folder'])}: {escape(with_flags(row['message']))}", highlight=False)
        console.print(f"{found['done']} done, {found['failed']} failed", highlight=False)


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    names = [name for name in rows[0] if name not in _NOT_IN_TABLE]
    for name in names:
        words = name in ("folder", "status")
        table.add_column(name, justify="left" if words else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(escape(_text(row[name])) for name in names))
    return table


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
