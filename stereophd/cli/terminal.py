"""What commands print: data on stdout, progress and messages on stderr."""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import typer

from stereophd.cli import interrupts
from stereophd.cli.flags import with_flags
from stereophd.cli.options import ConfigWords, SceneWords, Session
from stereophd.errors import GateError, InputError
from stereophd.wording import PROGRESS, Stages, counted, percent

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig

# 128 + SIGPIPE, as the shell reports a program that wrote into a closed pipe.
EXIT_BROKEN_PIPE = 141

# Seconds between two lines of progress where stderr is no terminal.
PACE_S = 10.0

# Upper bound on the memory of the libraries, the compiler of the kernels and the BLAS buffers of a few threads, bytes.
LEAST_ADDRESS_SPACE = 3 << 29

# Keys of a report that are for machines; the summary on the terminal leaves them out.
_NOT_IN_SUMMARY = frozenset({"provenance", "report_version"})


def begin(context: typer.Context, **words: Any) -> Session:
    """Return the session of a command with these `CommonWords`; the messages of the package go to stderr."""
    session = context.ensure_object(Session)
    vars(session).update(words, context=context)
    level = logging.ERROR if session.quiet else max(logging.WARNING - 10 * session.verbosity, logging.DEBUG)
    logger = logging.getLogger("stereophd")
    handler = logging.StreamHandler(sys.stderr)
    handler.format = _message_line  # type: ignore[method-assign]
    # Replaced, not added: several calls may happen in one process.
    logger.handlers = [handler]
    logger.setLevel(level)
    logger.propagate = False
    prepare_memory()
    return session


def prepare_memory() -> None:
    """Make too little address space (``ulimit -v``) an error at once, and no hang; InputError if it is too little.

    OpenBLAS asks the system for its buffer again and again, without end, where there is no memory left for it. Its
    buffers are therefore allocated before the work begins, and a limit below which they, and the libraries, do not fit
    is refused.
    """
    try:
        import resource
    except ImportError:  # not a POSIX system
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return
    if limit < LEAST_ADDRESS_SPACE:
        raise InputError(
            f"not enough memory: expected an address space of at least {LEAST_ADDRESS_SPACE >> 20} MiB, found a limit "
            f"of {limit >> 20} MiB (ulimit -v)"
        )
    import numpy as np
    from scipy.linalg.blas import dgemm

    square = np.ones((256, 256))
    square @ square
    dgemm(1.0, square, square)


def _message_line(record: logging.LogRecord) -> str:
    """Return a message as a line; one of an error looks as `stereophd.cli.app` prints the error that ends a command."""
    level = "error" if record.levelno >= logging.ERROR else record.levelname
    return f"{level}: {with_flags(record.getMessage())}"


def load(words: SceneWords) -> LoadedConfig:
    """Load the configuration of a command."""
    from stereophd.config.loading import load_config

    cameras = words.cameras if isinstance(words, ConfigWords) else None
    return load_config(words.config, words.overrides or (), words.seed, cameras)


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
    if not warned or "--set" not in _flags(session):
        return []
    return ["The same with these remedies:", f"  {again(session, dict.fromkeys(check['change'] for check in warned))}"]


def _flags(session: Session) -> set[str]:
    """Return the options of the command that runs."""
    return {flag for option in session.context.command.params for flag in option.opts} if session.context else set()


def again(session: Session, changes: Collection[str] = ()) -> str:
    """Return the command line again, so that it replaces its outputs, with changes (KEY=VALUE) of what it sets."""
    keys, words = tuple(f"{change.partition('=')[0]}=" for change in changes), list[str]()
    for word in session.words:
        if word.removeprefix("--set=").startswith(keys):
            words = words[:-1] if words[-1] == "--set" else words
        elif word != "--force":
            words.append(word)
    force = ["--force"] if "--force" in _flags(session) else []
    return shlex.join(["stereophd", *words, *force, *(word for change in changes for word in ("--set", change))])


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
    """Raise GateError, with the checks of a report that warn, if `strict` and there are any."""
    checks = report["checks"] if strict else ()
    if warned := [f"{check['name']}: {check['message']}" for check in checks if check["status"] == "warning"]:
        warn = "warns" if len(warned) == 1 else "warn"
        raise GateError(f"{counted(len(warned), 'check')} {warn}: {'; '.join(warned)} (--strict)")


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

    The bar names each stage that the run logs, and begins anew; without a terminal that is a line every `PACE_S`.
    """
    if session.quiet:
        yield lambda done, total: interrupts.check()
        return
    if not sys.stderr.isatty():
        with _lines_of_progress(session, label) as tell:
            yield tell
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

        def show(stage: str) -> None:
            bar.tasks[0].total = None
            bar.update(task, completed=0, description=f"{label}: {stage}")

        with stages_shown(session, show):
            yield advance


def _print_progress(line: str) -> None:
    """Print a line on stderr; a run goes on where that is closed or full."""
    with contextlib.suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


@contextlib.contextmanager
def stages_shown(session: Session, show: Callable[[str], None] | None = None) -> Iterator[None]:
    """Show the stages that a run logs (`PROGRESS`); with --verbose they are messages as all others.

    What must be known at once, that a run waits for the compiler, is a line on stderr, in a command without stages too.
    """
    if session.verbosity or session.quiet:
        yield
        return

    stages, at_once = Stages(show or (lambda stage: None)), Stages(_print_progress)
    stages.addFilter(lambda record: not hasattr(record, "at_once"))
    at_once.addFilter(lambda record: hasattr(record, "at_once"))
    before = PROGRESS.handlers, PROGRESS.propagate, PROGRESS.level
    PROGRESS.handlers, PROGRESS.propagate = [stages, at_once], False
    PROGRESS.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        PROGRESS.handlers, PROGRESS.propagate, level = before
        PROGRESS.setLevel(level)


@contextlib.contextmanager
def _lines_of_progress(session: Session, label: str) -> Iterator[Callable[[float, float], None]]:
    """Print the last stage and its share that is done on stderr every `PACE_S`, also while a step reports nothing."""
    began, ended, stage, share = time.monotonic(), threading.Event(), "", ""

    def show(text: str) -> None:
        nonlocal stage, share
        stage, share = text, ""

    def advance(done: float, total: float) -> None:
        nonlocal share
        interrupts.check()
        share = f"{percent(done / total)} done" if total else ""

    def watch() -> None:
        while not ended.wait(PACE_S):
            told = ", ".join(filter(None, (stage, share))) or "begun"
            _print_progress(f"{label}, {time.monotonic() - began:.0f} s: {told}")

    thread = threading.Thread(target=watch, name="progress", daemon=True)
    thread.start()
    try:
        with stages_shown(session, show):
            yield advance
    finally:
        ended.set()
        thread.join()
