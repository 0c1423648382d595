"""``stereophd evaluate``: tracks against the truth, or calibrated cameras against true ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import typer

from stereophd.cli import evaluate_options as of
from stereophd.cli import options
from stereophd.cli.batch import finish_batch
from stereophd.cli.options import Session
from stereophd.cli.terminal import begin, load, print_data, print_report, progress_bar, quiet_pipe
from stereophd.cli.unused_options import refuse, report, report_jobs_beside_dask
from stereophd.errors import GateError, InputError

Report = dict[str, Any]

# Parameters that only one of the two uses has.
OF_TRACKS = (
    "order", "cutoff", "base", "from_s", "to_s", "max_gap", "at", "log", "seen_by", "within", "ospa2_window",
    "tentative", "align", "align_clock", "match_distance", "plane", "region", "switch_cost", "plots", "jobs", "dask",
)  # fmt: skip
OF_CAMERAS = ("config",)
# Options that only folders of runs have.
OF_FOLDERS = ("jobs", "dask")


def evaluate_command(
    context: typer.Context,
    tracks: of.Tracks = None,
    truth: of.Truth = None,
    out: of.Out = None,
    order: of.Order = 2.0,
    cutoff: of.Cutoff = None,
    base: of.BaseDistance = of.Base.EUCLIDEAN,
    from_s: of.From = None,
    to_s: of.To = None,
    max_gap: of.MaxGap = None,
    at: of.ScoredAt = of.At.TIMES,
    log: of.Log = None,
    seen_by: of.SeenBy = None,
    within: of.Within = None,
    ospa2_window: of.Ospa2Window = 10,
    tentative: of.Tentative = False,
    align: of.Align = of.Alignment.NONE,
    align_clock: of.AlignClock = False,
    match_distance: of.MatchDistance = None,
    plane: of.Plane = None,
    region: of.Region = None,
    switch_cost: of.SwitchCost = None,
    cameras: of.Cameras = None,
    true_cameras: of.TrueCameras = None,
    config: of.Config = None,
    seed: options.Seed = None,
    fail_above: of.FailAbove = None,
    fail_below: of.FailBelow = None,
    plots: options.Plots = None,
    jobs: options.Jobs = 1,
    dask: options.Dask = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
    debug: options.Debug = False,
) -> None:
    """Score tracks against the truth (OSPA, RMSE, identities, NEES), or calibrated cameras against true ones.

    With folders of runs as TRACKS and TRUTH, each NAME/tracks.parquet is scored against NAME/truth.parquet or
    NAME.parquet, and DIR/summary.parquet has a row for each.
    """
    session = begin(context)
    above = of.parse_limits("--fail-above", fail_above or [])
    below = of.parse_limits("--fail-below", fail_below or [])
    if true_cameras is not None:
        if cameras is None or tracks is not None:
            raise InputError("--true-cameras: expected --cameras FILE to score, and neither TRACKS nor TRUTH")
        refuse(context, OF_TRACKS, "for the scores of tracks; not used with --true-cameras")
        if config is None:
            report(context, ("seed",), "with --config CONFIG")
        _report_without_out(context, out)
        from stereophd.commands.evaluate_cameras import evaluate_calibration

        loaded = None if config is None else load(config, None, seed, true_cameras)
        score = partial(evaluate_calibration, cameras, true_cameras, out, loaded, None, above, below, force)
        _run(score, partial(_show_errors, session))
        return
    if tracks is None or truth is None:
        raise InputError("expected TRACKS and TRUTH, or --cameras and --true-cameras")
    refuse(context, OF_CAMERAS, "for the scores of cameras; not used with TRACKS and TRUTH")
    report(context, ("seed",), "for the scores of cameras, with --config CONFIG")
    _report_without_out(context, out)
    if log is None and (out is None or plots is False):
        refuse(context, ("cameras",), "with --log, whose clocks they have, or with plots (--out DIR), found neither")
    if plots and out is None:
        raise InputError("--plots: expected --out DIR to put the plots in, found none")
    words: dict[str, Any] = {
        "order": order, "cutoff": cutoff, "base": base.value, "from_s": from_s, "to_s": to_s, "max_gap_s": max_gap,
        "at": at.value, "log_path": log, "seen_by": seen_by, "within_s": within, "ospa2_window": ospa2_window,
        "cameras_path": cameras, "plots": plots, "fail_above": above, "fail_below": below,
        "tentative": tentative, "align": align.value, "align_clock": align_clock,
        "match_distance": match_distance, "plane": of.parse_plane(plane), "region": of.parse_region(region),
        "switch_cost": switch_cost,
    }  # fmt: skip
    if tracks.is_dir():
        report_jobs_beside_dask(context, dask)
        _score_runs(session, tracks, truth, out, force, jobs, dask, words)
        return
    refuse(context, OF_FOLDERS, "for folders of runs, found one run")
    from stereophd.commands.evaluate import evaluate

    score = partial(evaluate, tracks, truth, out, force=force, **words)
    _run(score, partial(_show_scores, session))


def _score_runs(
    session: Session,
    tracks: Path,
    truth: Path,
    out: Path | None,
    force: bool,
    jobs: int,
    dask: str | None,
    words: Mapping[str, Any],
) -> None:
    """Score a folder of runs."""
    if out is None:
        raise InputError("expected --out DIR for the scores of a folder of runs, found none")
    from stereophd.commands.evaluate_runs import evaluate_runs

    with progress_bar(session, "evaluate") as progress:
        found = evaluate_runs(tracks, truth, out, force, progress, jobs, dask, **words)
    finish_batch(session, found)


def _report_without_out(context: typer.Context, out: Path | None) -> None:
    """Warn of what concerns files where none is written."""
    if out is None:
        report(context, ("force",), "with --out DIR")


def _run(score: Callable[[], Report], show: Callable[[Mapping[str, Any]], None]) -> None:
    """Score and show the report; where a gate fails the run is done, and its report is shown before the failure."""
    try:
        show(score())
    except GateError as error:
        if error.report is not None:
            show(error.report)
        raise


def _show_scores(session: Session, report: Mapping[str, Any]) -> None:
    """Print the scores of tracks: JSON, or a table."""
    if session.json or session.quiet:
        print_report(session, report)
        return
    from rich.console import Console

    from stereophd.cli.tables import print_evaluation

    with quiet_pipe():
        print_evaluation(report, Console())


def _show_errors(session: Session, report: Mapping[str, Any]) -> None:
    """Print the errors of cameras: JSON, or tables."""
    if session.json or session.quiet:
        print_report(session, report)
        return
    from stereophd.report.camera_scores import camera_scores_text

    print_data(camera_scores_text(report))
