"""``stereophd check``."""

from pathlib import Path
from typing import Annotated, Any

from stereophd.cli import options
from stereophd.cli.terminal import exit_if_strict, load, print_report
from stereophd.wording import counted

MARKS = {"ok": "ok", "warning": "WARNING", "not checked": "not checked"}


def check_command(
    session: options.Session,
    words: options.ConfigWords,
    log: Annotated[Path, options.argument("LOG", "Detection log (Parquet).")],
    strict: options.Strict = False,
) -> None:
    """Check whether a log fits the cameras and the settings; name likely causes and remedies."""
    loaded = load(words)
    from stereophd.commands.check import check

    report = check(loaded, log)
    print_report(session, report, lambda: _lines(report["checks"]))
    exit_if_strict(strict, report)


def _lines(checks: list[dict[str, Any]]) -> list[str]:
    """Return one or two lines a finding, warnings last, where they are seen."""
    lines = []
    for one in sorted(checks, key=lambda found: found["status"] == "warning"):
        lines.append(f"{MARKS[one['status']]:>11}  {one['name']}: {one['message']}")
        if one["remedy"] and one["status"] == "warning":
            lines.append(f"{'':>11}  remedy: {one['remedy']}")
    count = sum(one["status"] == "warning" for one in checks)
    return [*lines, f"{counted(len(checks), 'check')}, {counted(count, 'warning')}"]
