"""Summary and exit code of a command over many inputs."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from stereophd.cli.options import Session
from stereophd.cli.terminal import print_report
from stereophd.report.tables import SummaryTable, table_text

# Not in the table: the folder identifies the log, and messages are printed below the table.
_NOT_IN_TABLE = frozenset({"log", "message"})


def are_many(paths: Sequence[Path]) -> bool:
    """Return whether paths and patterns name several files, or none; the alternative is exactly one file."""
    from stereophd.pipeline.batch.names import expand

    return len(paths) > 1 or len(expand(paths)) > 1


def finish_batch(session: Session, found: Mapping[str, Any], strict: bool = False) -> None:
    """Print the summary that `run_batch` returns, and exit: 2 if an input failed; if `strict`, 1 if a check warns."""
    rows = found["logs"]
    print_report(session, found, lambda: table_text(_table(rows, found)))
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


def _table(rows: Sequence[Mapping[str, Any]], found: Mapping[str, Any]) -> SummaryTable:
    """Return a row for each input; below are the messages of those that failed."""
    names = tuple(name for name in rows[0] if name not in _NOT_IN_TABLE)
    messages = [f"{row['folder']}: {row['message']}" for row in rows if row["message"]]
    words = tuple(column for column, name in enumerate(names) if name in ("folder", "status"))
    cells = tuple(tuple(_text(row[name]) for name in names) for row in rows)
    return SummaryTable("", names, cells, (*messages, f"{found['done']} done, {found['failed']} failed"), words)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
