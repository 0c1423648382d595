"""Commands over many recordings: a folder for each, and a summary of all; one that fails stops no other."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from stereophd.commands.calibrate import FILES as CALIBRATE_FILES
from stereophd.commands.calibrate import calibrate
from stereophd.commands.evaluate import PER_SCAN_NAME, PLOT_NAMES, REPORT_NAME, evaluate
from stereophd.commands.options import CalibrateOptions, EvaluateOptions, TrackOptions
from stereophd.commands.track import FILES, track
from stereophd.config.loading import LoadedConfig
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import tidy
from stereophd.io.outputs.provenance import provenance
from stereophd.io.tables.schemas import FLOAT, INTEGER, STRING
from stereophd.options import takes
from stereophd.pipeline.batch.names import pairs_by_name
from stereophd.pipeline.batch.run import Batch, Item, log_items, run_batch
from stereophd.pipeline.checks.finding import count_warnings
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES

# Columns of ``summary.parquet`` besides those of every batch. The standard deviations are the largest of the cameras.
TRACK_COLUMNS = {
    **dict.fromkeys(("frames", "detections", "tracks", "estimates"), INTEGER),
    **dict.fromkeys(("duration_s", "log_likelihood"), FLOAT),
    "warnings": INTEGER,
}
CALIBRATE_COLUMNS = {
    "calibration": STRING,
    **dict.fromkeys(("frames", "detections"), INTEGER),
    **dict.fromkeys(("information_bits", "rotation_std_deg", "center_std"), FLOAT),
    "warnings": INTEGER,
}
SCORE_COLUMNS = {
    "scans": INTEGER,
    **dict.fromkeys(("ospa", "ospa2", "gospa", "rmse_position", "rmse_velocity", "cardinality_bias"), FLOAT),
    "identity_switches": INTEGER,
    "nees_position": FLOAT,
}


@takes(TrackOptions)
def track_logs(
    loaded: LoadedConfig,
    logs: Sequence[Path | str],
    out_dir: Path | str,
    *,
    options: TrackOptions,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Track the objects of many detection logs.

    A log that fails is a row of the summary with the reason; the others are tracked.

    Parameters
    ----------
    loaded : LoadedConfig
        With a ``filter`` section and cameras.
    logs : sequence of path
        Detection logs, or patterns such as ``day-*/detections.parquet``.
    out_dir : path
        Folder for the outputs: ``NAME/`` for each log, with the files of `stereophd.commands.track.track`, and
        ``summary.parquet``. NAME is the log's file name without its ending, or the name of its folder if the file is
        called ``detections.parquet``.
    progress : callable, optional
        Called with the logs done and their number.

    Returns
    -------
    dict
        ``logs``: the rows of the summary; ``done`` and ``failed``: their numbers; ``exit_code``.

    Raises
    ------
    InputError
        No log fits a pattern, one is given twice, or the output folder cannot be used.
    """
    work = partial(_one_log, track, loaded, replace(options, jobs=1, dask=None))
    files, record = (*FILES, *UNFINISHED_FILES), provenance("track", loaded.record)
    batch = Batch(log_items(logs), work, _track_values, files, TRACK_COLUMNS, record)
    return run_batch(batch, out_dir, options.jobs, options.dask, options.force, options.resume, progress)


@takes(CalibrateOptions)
def calibrate_logs(
    loaded: LoadedConfig,
    logs: Sequence[Path | str],
    out_dir: Path | str,
    *,
    options: CalibrateOptions,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Calibrate cameras from many detection logs, each separately.

    A log that fails is a row of the summary with the reason; the others are used.

    Parameters
    ----------
    loaded : LoadedConfig
        The same as in `stereophd.commands.calibrate.calibrate`.
    logs : sequence of path
        Detection logs, or patterns.
    out_dir : path
        Folder for the outputs: ``NAME/`` for each log (named as in `track_logs`) and
        ``summary.parquet``.
    progress : callable, optional
        Called with the logs done and their number.

    Returns
    -------
    dict
        ``logs``: the rows of the summary; ``done`` and ``failed``: their numbers; ``exit_code``.

    Raises
    ------
    InputError
        As `track_logs`.
    """
    from joblib import effective_n_jobs

    work = partial(_one_log, calibrate, loaded, replace(options, jobs=1, dask=None))
    files, record = (*CALIBRATE_FILES, *UNFINISHED_FILES), provenance("calibrate", loaded.record)
    batch = Batch(log_items(logs), work, _calibrate_values, files, CALIBRATE_COLUMNS, record)
    jobs = effective_n_jobs(options.jobs)
    return run_batch(batch, out_dir, jobs, options.dask, options.force, options.resume, progress)


@takes(EvaluateOptions)
def evaluate_runs(
    tracks_dir: Path | str,
    truth_dir: Path | str,
    out_dir: Path | str,
    *,
    options: EvaluateOptions,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score the tracks of many runs against the truths of the same names.

    Parameters
    ----------
    tracks_dir : path
        Folder of runs, ``NAME/tracks.parquet``, as `track_logs` writes it.
    truth_dir : path
        Folder of truths, ``NAME/truth.parquet`` (as ``simulate`` writes runs) or ``NAME.parquet``.
    out_dir : path
        Folder for the outputs: ``NAME/`` for each run, with the files of `stereophd.commands.evaluate.evaluate`, and
        ``summary.parquet``.
    progress : callable, optional
        Called with the runs done and their number.

    Returns
    -------
    dict
        ``logs``: the rows of the summary; ``done`` and ``failed``: their numbers; ``exit_code``.

    Raises
    ------
    InputError
        A folder or an option cannot be used.
    """
    if options.log_path is not None:
        raise InputError("`log_path`: expected the tracks of one run, found a folder of runs")
    pairs = pairs_by_name(Path(tracks_dir), Path(truth_dir), "tracks.parquet", "truth.parquet")
    items = [
        Item(name, str(tracks), (Path(os.path.abspath(tracks)), Path(os.path.abspath(truth))))
        for name, (tracks, truth) in pairs.items()
    ]
    each = replace(options, jobs=1, dask=None)
    values = {name: None if value is None else str(value) for name, value in vars(each).items() if name != "force"}
    files = (REPORT_NAME, PER_SCAN_NAME, *PLOT_NAMES)
    batch = Batch(items, partial(_evaluate, each), _score_values, files, SCORE_COLUMNS, provenance("evaluate", values))
    return run_batch(batch, out_dir, options.jobs, options.dask, options.force, progress=progress)


def _one_log(
    command: Callable[..., Mapping[str, Any]],
    loaded: LoadedConfig,
    options: TrackOptions | CalibrateOptions,
    item: Item,
    out: Path,
    progress: Progress | None,
) -> Mapping[str, Any]:
    """Track or calibrate from one log."""
    tidy(out)  # of a run that was killed while it moved its files, or before it had kept anything
    return command(loaded, item.paths[0], out, options=options, progress=progress)


def _evaluate(options: EvaluateOptions, item: Item, out: Path, progress: Progress | None) -> Mapping[str, Any]:
    """Score one run."""
    if progress is not None:
        progress(0, 1)
    return evaluate(item.paths[0], item.paths[1], out, options=options)


def _track_values(report: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the values of a row of the summary."""
    return {
        "frames": report["input"]["frames"],
        "detections": report["input"]["detections"],
        "tracks": len(report["tracks"]),
        "estimates": report["estimates"],
        "duration_s": report["duration_s"],
        "log_likelihood": report["log_likelihood"],
        "warnings": count_warnings(report),
    }


def _calibrate_values(report: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the values of a row of the summary."""
    cameras = report.get("cameras", {}).values()
    return {
        "calibration": report["status"],
        "frames": report["input"].get("frames"),
        "detections": report["input"].get("detections"),
        "information_bits": report.get("observability", {}).get("information_bits"),
        "rotation_std_deg": max((camera["rotation_std_deg"] for camera in cameras), default=None),
        "center_std": max((camera["center_std"] for camera in cameras), default=None),
        "warnings": count_warnings(report),
    }


def _score_values(report: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the values of a row of the summary."""
    return {
        "scans": report["scans"]["scored"],
        "ospa": report["ospa"]["mean"],
        "ospa2": report["ospa2"]["mean"],
        "gospa": report["gospa"]["mean"],
        "rmse_position": report["rmse"]["position"],
        "rmse_velocity": report["rmse"]["velocity"],
        "cardinality_bias": report["cardinality"]["bias"],
        "identity_switches": report["identity_switches"],
        "nees_position": report["nees"]["position"],
    }
