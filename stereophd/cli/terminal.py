"""What commands print: data on stdout, progress and messages on stderr."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer

from stereophd.cli import interrupts, memory
from stereophd.cli.flags import with_flags
from stereophd.cli.options import ConfigWords, SceneWords, Session
from stereophd.errors import GateError

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig

# 128 + SIGPIPE, as the shell reports a program that wrote into a closed pipe.
EXIT_BROKEN_PIPE = 141

# Seconds between two lines of progress where stderr is no terminal.
PACE_S = 10.0

# Keys of a report that are for machines; the summary on the terminal leaves them out.
_NOT_IN_SUMMARY = frozenset({"provenance", "report_version"})


def begin(context: typer.Context) -> Session:
    """Return the session of a command, with the messages of the package going to stderr."""
    import logging

    session = context.ensure_object(Session)
    session.context = context
    level = logging.ERROR if session.quiet else max(logging.WARNING - 10 * session.verbosity, logging.DEBUG)
    logger = logging.getLogger("stereophd")
    handler = logging.StreamHandler(sys.stderr)
    formatter = logging.Formatter("%(levelname)s: %(message)s")
    # as the messages of errors: parameters become options
    handler.format = lambda record: with_flags(formatter.format(record))  # type: ignore[method-assign]
    # Replaced, not added: several calls may happen in one process.
    logger.handlers = [handler]
    logger.setLevel(level)
    logger.propagate = False
    memory.prepare()
    return session


def load(words: SceneWords, further: Sequence[str] = ()) -> LoadedConfig:
    """Load the configuration of a command; `further` overrides come after those of the command line."""
    from stereophd.config.loading import load_config

    cameras = words.cameras if isinstance(words, ConfigWords) else None
    return load_config(words.config, [*(words.overrides or ()), *further], words.seed, cameras)


def print_data(text: str) -> None:
    """Print data on stdout, which the reader may close before the end (``| head``)."""
    with quiet_pipe():
        print(text, flush=True)


@contextlib.contextmanager
def quiet_pipe() -> Iterator[None]:
    """End quietly where stdout is a pipe that was closed."""
    try:
        yield
    except BrokenPipeError:
        # Python flushes stdout once more when it exits, and that must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(EXIT_BROKEN_PIPE) from None


def to_json(report: Mapping[str, Any]) -> str:
    """Return a report as JSON; NaN and infinity become null, which JSON knows."""
    from stereophd.io.outputs.json_text import json_text

    return json_text(report, ascii_only=not (sys.stdout.encoding or "utf-8").lower().startswith("utf"))


def print_report(
    session: Session, report: Mapping[str, Any], text: Callable[[], str | Iterable[str]] | None = None
) -> None:
    """Print a report: one JSON document, or the text or lines that a function returns (a line for each value)."""
    if session.json:
        session.printed = True
        print_data(to_json(report))
    elif not session.quiet:
        from stereophd.io.outputs.json_text import plain

        shown = _lines(plain(report)) if text is None else text()
        lines = map(with_flags, [shown] if isinstance(shown, str) else shown)
        print_data("\n".join([*lines, *_remedied(session, report)]))


def _remedied(session: Session, report: Mapping[str, Any]) -> list[str]:
    """Return the command line again, with the changes that the warnings of its checks propose."""
    warned = [check for check in report.get("checks", ()) if check["status"] == "warning" and check["change"]]
    flags = {flag for option in session.context.command.params for flag in option.opts} if session.context else set()
    if not warned or "--set" not in flags:
        return []
    words = [word for word in session.words if word != "--force"]
    changes = [word for change in dict.fromkeys(check["change"] for check in warned) for word in ("--set", change)]
    force = ["--force"] if "--force" in flags else []
    return ["The same with these remedies:", f"  {shlex.join(['stereophd', *words, *force, *changes])}"]


def print_run(session: Session, report: Mapping[str, Any]) -> None:
    """Print the report of a run of track or calibrate: JSON, or a verdict and tables."""
    from stereophd.report.summaries import summary_text

    print_report(session, report, lambda: summary_text(report))


def print_scored(session: Session, run: Callable[[], Mapping[str, Any]], text: Callable[[Any], str]) -> dict[str, Any]:
    """Run a command and print its report; where a gate fails the run is done, and its report comes before the error."""
    try:
        report = run()
    except GateError as error:
        if (failed := error.report) is not None:
            print_report(session, failed, lambda: text(failed))
        raise
    print_report(session, report, lambda: text(report))
    return dict(report)


def exit_if_strict(strict: bool, report: Mapping[str, Any]) -> None:
    """Exit with code 1 if `strict` and a check of a report warns."""
    from stereophd.pipeline.checks.finding import count_warnings

    if strict and count_warnings(report):
        raise typer.Exit(1)


def _lines(report: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in report.items():
        if not prefix and key in _NOT_IN_SUMMARY:
            continue
        if isinstance(value, Mapping):
            yield from _lines(value, f"{prefix}{key}.")
        elif isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
            # A table: the file holds it, the summary counts its rows.
            yield f"{prefix}{key}: {len(value)}"
        elif value is None or (prefix == "input." and value == 0):
            # The summary leaves out what the run did not do or did not find; the file states it.
            continue
        elif isinstance(value, list):
            yield f"{prefix}{key}: {', '.join(map(str, value))}"
        else:
            yield f"{prefix}{key}: {value:.6g}" if isinstance(value, float) else f"{prefix}{key}: {value}"


@contextlib.contextmanager
def progress_bar(session: Session, label: str) -> Iterator[Callable[[float, float], None]]:
    """Yield a function (done, total) that moves a bar, with the time left and spent, on stderr if it is a terminal.

    The bar names the stages that the run logs; without a terminal one of them is a line every `PACE_S`.
    """
    if session.quiet:
        yield lambda done, total: interrupts.check()
        return
    if not sys.stderr.isatty():
        with _stages_shown(session, _paced(label)):
            yield lambda done, total: interrupts.check()
        return
    from rich.console import Console
    from rich.progress import Progress, TimeElapsedColumn

    with Progress(
        *Progress.get_default_columns(), TimeElapsedColumn(), console=Console(stderr=True), transient=True
    ) as bar:
        task = bar.add_task(label, total=None)

        def advance(done: float, total: float) -> None:
            interrupts.check()
            bar.update(task, completed=done, total=total)

        with _stages_shown(session, lambda stage: bar.update(task, description=f"{label}: {stage}")):
            yield advance


@contextlib.contextmanager
def _stages_shown(session: Session, show: Callable[[str], None]) -> Iterator[None]:
    """Show the stages that a run logs (`stereophd.progress`); with --verbose they are messages as all others."""
    import logging

    handler, logger = logging.Handler(), logging.getLogger("stereophd.progress")
    handler.emit = lambda record: show(record.getMessage())  # type: ignore[method-assign]
    if session.verbosity:
        yield
        return
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.handlers, logger.propagate = [], True
        logger.setLevel(logging.NOTSET)


def _paced(label: str) -> Callable[[str], None]:
    """Return a function that prints a stage on stderr if none was printed for `PACE_S`."""
    began = printed = time.monotonic()

    def show(stage: str) -> None:
        nonlocal printed
        if (now := time.monotonic()) - printed >= PACE_S:
            printed = now
            print(f"{label}, {now - began:.0f} s: {stage}", file=sys.stderr, flush=True)

    return show
