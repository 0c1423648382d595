"""The console script ``stereophd``: its commands, and what becomes of errors.

Exit codes: 0 done; 1 ran, but a gate failed; 2 usage, configuration or input error; 3 internal error;
130 interrupted (128 + the signal that ended the run). Errors carry their code (`stereophd.errors`).
"""

import errno
import io
import os
import signal
import sys
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Any

import typer
import typer.main

import stereophd
from stereophd.cli import calibrate, config, evaluate, finished, interrupts, preparing, scenes, track
from stereophd.cli.flags import with_flags
from stereophd.cli.options import PlainCommand, PlainGroup, Session
from stereophd.cli.parameters import command
from stereophd.errors import GateError, InputError, StereophdError
from stereophd.site import SITE

EXIT_USAGE = 2
EXIT_INTERNAL = 3
EXIT_INTERRUPTED = 128 + signal.SIGINT

# The base of all usage errors, wherever this version of typer keeps it.
_ClickException = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")

app = typer.Typer(
    name="stereophd",
    cls=PlainGroup,
    help="3-D tracks from the detection logs of several cameras.",
    epilog=f"""Start here:
  stereophd demo out
Your own recording:
  stereophd import csv points.csv --cameras calib.yml --fps 60 --out rec
  stereophd init study --log rec/detections.parquet
  stereophd track study/config.yaml rec/detections.parquet --out study/tracks
  stereophd report rec study/tracks --out report.html
Documentation: {SITE}""",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    # Plain help: rich's panels would double the time that --help takes.
    rich_markup_mode=None,
    context_settings={"help_option_names": ["--help", "-h"]},
)
# In the order of the work: the command, one line short enough for a terminal of 80 columns, and examples.
for _name, _command, _purpose, *_examples in (
    ("demo", scenes.demo_command, "Simulate, track and score a small scene: start here.", "demo out"),
    (
        "import", preparing.import_command, "Convert detections and cameras of another program.",
        "import csv points.csv --cameras calib.yml --fps 60 --out rec",
        "import dltdv xy.csv dlt.csv --fps 60 --image-size 1280x720 --out rec",
    ),
    (
        "init", preparing.init_command, "Write a configuration with values estimated from a log.",
        "init study --log rec/detections.parquet",
    ),
    ("info", finished.info_command, "Describe a log, a table, cameras or an output folder.", "info study/tracks"),
    (
        "check", preparing.check_command, "Check whether a log fits cameras and settings.",
        "check study/config.yaml rec/detections.parquet --strict",
    ),
    (
        "simulate", scenes.simulate_command, "Simulate scenes and their detection logs.",
        "simulate out/config.yaml --seed 3 --out scene",
    ),
    (
        "track", track.track_command, "Estimate 3-D tracks from detection logs.",
        "track study/config.yaml rec/detections.parquet --smooth --out tracks",
        "track study/config.yaml 'day1/*.parquet' --jobs 4 --out tracks",
    ),
    (
        "watch", track.watch_command, "Show a run that is still going on in a browser.",
        "watch tcp://127.0.0.1:5556",
    ),
    (
        "calibrate", calibrate.calibrate_command, "Estimate cameras from the log of moving objects.",
        "calibrate config.yaml log.parquet --cameras guess.yaml --out found",
    ),
    (
        "align", finished.align_command, "Bring cameras and tracks into a world frame.",
        "align found --to floor --out up",
    ),
    (
        "evaluate", evaluate.evaluate_command, "Score tracks against the truth.",
        "evaluate tracks/tracks.parquet truth.parquet --cutoff 1 --out scores",
        "evaluate tracks.parquet truth.parquet --fail-above ospa.mean=0.05",
    ),
    (
        "evaluate-cameras", evaluate.evaluate_cameras_command, "Score calibrated cameras against true ones.",
        "evaluate-cameras found/cameras.yaml scene/cameras.yaml",
    ),
    (
        "report", finished.report_command, "Write one page (HTML) about runs and their scores.",
        "report rec tracks scores --out report.html",
    ),
    (
        "export", finished.export_command, "Write tracks or cameras as a file of another program.",
        "export trc tracks --rate 60 --out tracks.trc",
    ),
    (
        "experiment", scenes.experiment_command, "Compare methods over many runs of a scenario.",
        "experiment sweep.yaml --jobs 4 --out sweep",
    ),
    (
        "compile", track.compile_command, "Compile the kernels ahead, for containers and CI jobs.",
        "compile --jobs 2",
    ),
):  # fmt: skip
    _shown = "\n".join(["Examples:" if len(_examples) > 1 else "Example:", *(f"  stereophd {x}" for x in _examples)])
    app.command(_name, cls=PlainCommand, short_help=_purpose, epilog=_shown)(command(_command))
app.add_typer(config.app, name="config", help="Show or check a configuration, or print its JSON schema.")


def _show_version(value: bool) -> None:
    if value:
        print(f"stereophd {stereophd.__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    """3-D tracks from the detection logs of several cameras."""


@cache
def command_line() -> Any:
    """Return the commands and their parameters, built once in a process that runs several."""
    return typer.main.get_command(app)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, by default with the words after the name of this process, and return its exit code."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    # a word that cannot be parsed ends the parsing before these are met
    session = Session(json="--json" in words, debug="--debug" in words, words=tuple(words))
    try:
        _check_environment()
        result = command_line()(args=words, prog_name="stereophd", standalone_mode=False, obj=session)
        code = result if isinstance(result, int) else 0
        if code == EXIT_INTERRUPTED:
            return _interrupted(session)
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted(session)
    except SystemExit as error:
        if (interrupted := interrupts.exit_code()) is not None:
            return _interrupted(session, interrupted)
        return error.code if isinstance(error.code, int) else EXIT_INTERNAL
    except Exception as error:
        if session.debug:
            import traceback

            traceback.print_exc()
        interrupted = interrupts.exit_code()
        if interrupted is not None:
            # Compiled code may turn the exception of a signal into one of its own.
            return _interrupted(session, interrupted)
        return _explain(error, session)
    return code


def _check_environment() -> None:
    """Refuse a misspelt target: results would depend on the processor without a word."""
    target = os.environ.get("STEREOPHD_TARGET", "")
    if target not in ("", "portable"):
        raise InputError(f"environment variable STEREOPHD_TARGET: expected portable or nothing, found {target!r}")


def _interrupted(session: Session | None = None, code: int = EXIT_INTERRUPTED) -> int:
    _report_error("interrupted; no output is left half written", "interrupted", code, session)
    return code


def _report_error(text: str, kind: str, code: int, session: Session | None, message: str | None = None) -> None:
    """Print an error on stderr, and with --json as a document on stdout unless a report is there already.

    `text` is the line for stderr, `message` the sentence of the document (default `text`). The kind is `usage`,
    `input`, `gate`, `interrupted` or `internal`.
    """
    try:
        print(text, file=sys.stderr)
    except OSError:  # a full disk: the exit code says it
        sys.stderr = None
    if session is not None and session.json and not session.printed:
        from stereophd.cli.error_document import error_document
        from stereophd.cli.terminal import print_report

        print_report(session, error_document(text if message is None else message, kind, code))


def _explain(error: Exception, session: Session) -> int:
    """Print one clear message for an error, and return the exit code."""
    if isinstance(error, _ClickException):
        return _explain_usage(error, session)
    kind, code, message = "input", EXIT_USAGE, ""
    if isinstance(error, StereophdError):
        kind = "gate" if isinstance(error, GateError) else "input" if isinstance(error, InputError) else "internal"
        code, message = error.exit_code, with_flags(str(error))
    elif isinstance(error, OSError) and error.filename is None and error.errno == errno.ENOSPC:
        message = "standard output: no space left on device"
    elif isinstance(error, OSError) and _is_users(error):
        message = f"{error.filename}: {error.strerror}"
    elif isinstance(error, MemoryError):
        message = "not enough memory" + (f": {error}" if str(error) else "")
    else:
        text = " ".join(str(error).split()) or "no details"
        message = f"{type(error).__name__}: {text} (run with --debug for the traceback)"
        _report_error(f"internal error: {message}", "internal", EXIT_INTERNAL, session, message)
        return EXIT_INTERNAL
    _report_error(f"error: {message}", kind, code, session, message)
    return code


def _explain_usage(error: Exception, session: Session) -> int:
    """Print what is wrong with the words of the command line; without any, print the help."""
    context = getattr(error, "ctx", None)
    if context is not None and type(error).__name__ == "NoArgsIsHelpError":
        print(context.get_help(), file=sys.stderr)
        return EXIT_USAGE
    name = "stereophd" if context is None else context.command_path
    message = error.format_message().rstrip(".").replace("Value error, ", "")  # type: ignore[attr-defined]
    message = f"{message} (see '{name} --help')"
    _report_error(f"error: {message}", "usage", EXIT_USAGE, session, message)
    return EXIT_USAGE


def _is_users(error: OSError) -> bool:
    """Whether an error of the operating system is about a file or folder that the user named."""
    from stereophd.io.outputs.disk import USER_ERRNOS

    return error.filename is not None and (error.errno in USER_ERRNOS or error.errno == errno.ENOENT)


def main() -> None:
    """Console script."""
    try:
        interrupts.install()
        _prepare_streams()
        _quieten_warnings()
        code = run()
        interrupts.late()
    except KeyboardInterrupt:
        code = _interrupted()
        interrupts.late()
    sys.exit(code)


def _prepare_streams() -> None:
    """Open closed streams on nothing, before a file takes their place; print names that the encoding does not have."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _quieten_warnings() -> None:
    """Send warnings of libraries to the log (-vv shows them), and drop those of worker processes."""
    import warnings

    if sys.warnoptions:
        return
    os.environ["PYTHONWARNINGS"] = "ignore"

    warnings.showwarning = _log_warning


def _log_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: Any, **__: Any
) -> None:
    import logging

    logging.getLogger("stereophd").debug("%s:%d: %s: %s", filename, lineno, category.__name__, message)
