"""``stereophd evaluate``."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from stereophd.cli import options
from stereophd.cli.options import Session
from stereophd.cli.terminal import begin, load, print_report, quiet_pipe
from stereophd.errors import GateError, InputError


class Base(StrEnum):
    """Base distance of OSPA and GOSPA."""

    EUCLIDEAN = "euclidean"
    MAHALANOBIS = "mahalanobis"


class At(StrEnum):
    """What is scored once."""

    TIMES = "times"
    EVENTS = "events"


def evaluate_command(
    context: typer.Context,
    tracks: Annotated[Path | None, typer.Argument(metavar="TRACKS", help="tracks.parquet.", show_default=False)] = None,
    truth: Annotated[Path | None, typer.Argument(metavar="TRUTH", help="truth.parquet.", show_default=False)] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Folder of report.json, per_scan.parquet and plots.",
            show_default=False,
        ),
    ] = None,
    order: Annotated[float, typer.Option("--order", metavar="P", help="Order of OSPA.")] = 2.0,
    cutoff: Annotated[
        float | None,
        typer.Option(
            "--cutoff", metavar="C", help="Cutoff of OSPA, in the unit of length; default 20.", show_default=False
        ),
    ] = None,
    base: Annotated[Base, typer.Option("--base", help="Base distance.")] = Base.EUCLIDEAN,
    from_s: Annotated[
        float | None,
        typer.Option("--from", metavar="T", help="First time, s.", show_default=False),
    ] = None,
    to_s: Annotated[
        float | None,
        typer.Option("--to", metavar="T", help="Last time, s.", show_default=False),
    ] = None,
    max_gap: Annotated[
        float | None,
        typer.Option(
            "--max-gap",
            metavar="S",
            help="Never interpolate the truth across a longer gap, s; default 1.5 median steps.",
            show_default=False,
        ),
    ] = None,
    at: Annotated[
        At,
        typer.Option("--at", help="Score each time once, after its last event, or every event."),
    ] = At.TIMES,
    log: Annotated[
        Path | None,
        typer.Option(
            "--log",
            metavar="FILE",
            help="Detection log, for --seen-by.",
            show_default=False,
        ),
    ] = None,
    seen_by: Annotated[
        int | None,
        typer.Option(
            "--seen-by",
            metavar="N",
            min=1,
            help="Score only objects that N cameras detected within --within seconds.",
            show_default=False,
        ),
    ] = None,
    within: Annotated[
        float | None,
        typer.Option("--within", metavar="S", help="Seconds of --seen-by.", show_default=False),
    ] = None,
    ospa2_window: Annotated[
        int,
        typer.Option("--ospa2-window", metavar="SCANS", min=1, help="Scored scans in a window of OSPA(2)."),
    ] = 10,
    cameras: Annotated[
        Path | None,
        typer.Option(
            "--cameras",
            metavar="FILE",
            help="Cameras (YAML): the clocks of --log, the cameras in the plots; with --true-cameras, what is scored.",
            show_default=False,
        ),
    ] = None,
    true_cameras: Annotated[
        Path | None,
        typer.Option(
            "--true-cameras",
            metavar="FILE",
            help="True cameras (YAML): score the calibration in --cameras instead of tracks.",
            show_default=False,
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            metavar="CONFIG",
            help="With --true-cameras: simulated scenario and priors whose Cramer-Rao bound is told.",
            show_default=False,
        ),
    ] = None,
    seed: options.Seed = None,
    fail_above: Annotated[
        list[str] | None,
        typer.Option(
            "--fail-above",
            metavar="KEY=VALUE",
            help="Exit with 1 if a figure is above a limit, such as ospa.mean=0.8 (repeatable).",
            show_default=False,
        ),
    ] = None,
    plots: Annotated[
        bool | None,
        typer.Option(
            "--plots/--no-plots",
            help="Make plots (needs the extra 'plot'); default: if it is installed.",
            show_default=False,
        ),
    ] = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
    debug: options.Debug = False,
) -> None:
    """Score tracks against the truth (OSPA, RMSE, identities, NEES), or calibrated cameras against true ones."""
    session = begin(context)
    if true_cameras is not None:
        if cameras is None or tracks is not None:
            raise InputError("--true-cameras: expected --cameras FILE to score, and neither TRACKS nor TRUTH")
        _evaluate_cameras(session, cameras, true_cameras, out, config, seed, _parse_limits(fail_above or []), force)
        return
    if tracks is None or truth is None:
        raise InputError("expected TRACKS and TRUTH, or --cameras and --true-cameras")
    if plots and out is None:
        raise InputError("--plots: expected --out DIR to put the plots in, found none")
    limits = _parse_limits(fail_above or [])
    from stereophd.commands.evaluate import evaluate

    try:
        report = evaluate(
            tracks,
            truth,
            out,
            order=order,
            cutoff=cutoff,
            base=base.value,
            from_s=from_s,
            to_s=to_s,
            max_gap_s=max_gap,
            at=at.value,
            log_path=log,
            seen_by=seen_by,
            within_s=within,
            ospa2_window=ospa2_window,
            fail_above=limits,
            cameras_path=cameras,
            force=force,
            plots=plots,
        )
    except GateError as error:
        # The run is done: its report is shown before the failed gate is.
        failed = _report_of(error, out)
        if failed is not None:
            _show(session, failed)
        raise
    _show(session, report)


def _evaluate_cameras(
    session: Session,
    cameras: Path,
    true_cameras: Path,
    out: Path | None,
    config: Path | None,
    seed: int | None,
    limits: dict[str, float],
    force: bool,
) -> None:
    """Score calibrated cameras."""
    from stereophd.commands.evaluate_cameras import evaluate_calibration

    loaded = None if config is None else load(config, None, seed, true_cameras)
    try:
        report = evaluate_calibration(cameras, true_cameras, out, loaded, None, limits, force)
    except GateError as error:
        failed = _report_of(error, out)
        if failed is not None:
            print_report(session, failed)
        raise
    print_report(session, report)


def _report_of(error: GateError, out: Path | None) -> dict[str, Any] | None:
    """Return the report of a run whose gate failed: the error carries it, or it is in the output folder."""
    report: dict[str, Any] | None = getattr(error, "report", None)
    if report is None and out is not None:
        import json

        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    return report


def _parse_limits(texts: list[str]) -> dict[str, float]:
    """Return {key: limit} of the options ``--fail-above KEY=VALUE``."""
    limits: dict[str, float] = {}
    for text in texts:
        key, separator, value = text.partition("=")
        try:
            limit = float(value)
        except ValueError:
            limit = math.nan
        if not key or not separator or not math.isfinite(limit):
            raise InputError(f"--fail-above {text}: expected KEY=NUMBER, such as ospa.mean=0.8")
        if key in limits:
            raise InputError(f"--fail-above {text}: expected each key once, found {key} again")
        limits[key] = limit
    return limits


def _show(session: Session, report: dict[str, Any]) -> None:
    """Print JSON, or a table."""
    if session.json or session.quiet:
        print_report(session, report)
        return
    from rich.console import Console

    from stereophd.cli.tables import print_evaluation

    with quiet_pipe():
        print_evaluation(report, Console())
