"""Commands over many recordings: a folder for each, and a summary of all; one that fails stops no other.

The output folder gets ``NAME/`` for each recording, with the files of the command, and ``summary.parquet``. `progress`
is called with the recordings done and their number. Each command returns what `run_batch` does, and raises InputError
if a file is named twice or not there, or an option or the folder cannot be used. A recording that fails is a row with
the reason.
"""

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
from stereophd.pipeline.batch.run_batch import Batch, Item, log_items, run_batch
from stereophd.pipeline.checks.finding import count_warnings
from stereophd.pipeline.evaluation.inputs import is_truth
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES
from stereophd.pipeline.workers.places import processes
from stereophd.wording import LOGGER, counted

Report = Mapping[str, Any]


def _largest(report: Report, key: str) -> float | None:
    return max((camera[key] for camera in report.get("cameras", {}).values()), default=None)


#: Command -> its columns of ``summary.parquet`` besides those of every batch: type, and value from a report.
COLUMNS: dict[str, dict[str, tuple[Any, Callable[[Report], Any]]]] = {
    "track": {
        "frames": (INTEGER, lambda report: report["input"]["frames"]),
        "detections": (INTEGER, lambda report: report["input"]["detections"]),
        "tracks": (INTEGER, lambda report: len(report["tracks"])),
        "estimates": (INTEGER, lambda report: report["estimates"]),
        "duration_s": (FLOAT, lambda report: report["duration_s"]),
        "log_likelihood": (FLOAT, lambda report: report["log_likelihood"]),
        "warnings": (INTEGER, count_warnings),
    },
    "calibrate": {
        "calibration": (STRING, lambda report: report["status"]),
        "frames": (INTEGER, lambda report: report["input"].get("frames")),
        "detections": (INTEGER, lambda report: report["input"].get("detections")),
        "information_bits": (FLOAT, lambda report: report.get("observability", {}).get("information_bits")),
        "rotation_std_deg": (FLOAT, lambda report: _largest(report, "rotation_std_deg")),
        "center_std": (FLOAT, lambda report: _largest(report, "center_std")),
        "length_unit": (STRING, lambda report: report["length_unit"]),
        "warnings": (INTEGER, count_warnings),
    },
    "evaluate": {
        "scans": (INTEGER, lambda report: report["scans"]["scored"]),
        "ospa": (FLOAT, lambda report: report["ospa"]["mean"]),
        "ospa2": (FLOAT, lambda report: report["ospa2"]["mean"]),
        "gospa": (FLOAT, lambda report: report["gospa"]["mean"]),
        "rmse_position": (FLOAT, lambda report: report["rmse"]["position"]),
        "rmse_velocity": (FLOAT, lambda report: report["rmse"]["velocity"]),
        "length_unit": (STRING, lambda report: report["length_unit"]),
        "cardinality_bias": (FLOAT, lambda report: report["cardinality"]["bias"]),
        "identity_switches": (INTEGER, lambda report: report["identity_switches"]),
        "nees_position": (FLOAT, lambda report: report["nees"]["position"]),
    },
}


def _values(command: str, report: Report) -> Report:
    """Return the values of a row of the summary, and what the row has beside them: its gates, if there are any."""
    gates = {"gates": report["gates"]} if report.get("gates") else {}
    return {name: value(report) for name, (_, value) in COLUMNS[command].items()} | gates


@takes(TrackOptions)
def track_logs(
    loaded: LoadedConfig, logs: Sequence[Path | str], out_dir: Path | str, *, options: TrackOptions,
    progress: Progress = ignore,
) -> dict[str, Any]:  # fmt: skip
    """Track the objects of many detection logs (paths, or patterns such as ``day-*/detections.parquet``).

    NAME is the log's file name without its ending, or that of its folder if the file is called ``detections.parquet``.
    """
    work = partial(_one_log, track, loaded, replace(options, jobs=1, dask=None))
    return _run("track", log_items(logs), work, FILES, loaded.record, out_dir, options, progress)


@takes(CalibrateOptions)
def calibrate_logs(
    loaded: LoadedConfig, logs: Sequence[Path | str], out_dir: Path | str, *, options: CalibrateOptions,
    progress: Progress = ignore,
) -> dict[str, Any]:  # fmt: skip
    """Calibrate cameras from many detection logs, each separately; the folders are named as by `track_logs`."""
    work = partial(_one_log, calibrate, loaded, replace(options, jobs=1, dask=None))
    options = replace(options, jobs=processes(options.jobs))
    return _run("calibrate", log_items(logs), work, CALIBRATE_FILES, loaded.record, out_dir, options, progress)


@takes(EvaluateOptions)
def evaluate_runs(
    tracks_dir: Path | str, truth_dir: Path | str, out_dir: Path | str, *, options: EvaluateOptions,
    progress: Progress = ignore,
) -> dict[str, Any]:  # fmt: skip
    """Score the tracks of many runs, ``NAME/tracks.parquet``, against the truths of the same names.

    These are ``NAME/truth.parquet`` (as `simulate` writes runs) or ``NAME.parquet``. A truth without tracks is a
    warning; where figures have limits it is a recording that fails.
    """
    if options.log_path is not None:
        raise InputError("`log_path`: expected the tracks of one run, found a folder of runs")
    pairs, alone = pairs_by_name(Path(tracks_dir), Path(truth_dir), "tracks.parquet", "truth.parquet")
    alone = {name: files for name, files in alone.items() if is_truth(files[1])}
    if options.fail_above or options.fail_below:
        pairs |= alone
    elif alone:
        LOGGER.warning("%s: %s without tracks: %s", truth_dir, counted(len(alone), "truth"), ", ".join(alone))
    items = [
        Item(name, str(tracks), (Path(os.path.abspath(tracks)), Path(os.path.abspath(truth))))
        for name, (tracks, truth) in sorted(pairs.items())
    ]
    each = replace(options, jobs=1, dask=None)
    values = {name: None if value is None else str(value) for name, value in vars(each).items() if name != "force"}
    files = (REPORT_NAME, PER_SCAN_NAME, *PLOT_NAMES)
    return _run("evaluate", items, partial(_evaluate, each), files, values, out_dir, options, progress)


def _run(
    command: str, items: Sequence[Item], work: Any, files: Sequence[str], record: Any, out_dir: Path | str,
    options: TrackOptions | CalibrateOptions | EvaluateOptions, progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    columns = {name: kind for name, (kind, _) in COLUMNS[command].items()}
    resume = not isinstance(options, EvaluateOptions) and options.resume
    files = files if isinstance(options, EvaluateOptions) else (*files, *UNFINISHED_FILES)
    batch = Batch(items, work, partial(_values, command), files, columns, provenance(command, record))
    return run_batch(batch, out_dir, options.jobs, options.dask, options.force, resume, progress)


def _one_log(
    command: Callable[..., Report], loaded: LoadedConfig, options: TrackOptions | CalibrateOptions, item: Item,
    out: Path, progress: Progress,
) -> Report:  # fmt: skip
    tidy(out)  # of a run that was killed while it moved its files, or before it had kept anything
    return command(loaded, item.paths[0], out, options=options, progress=progress)


def _evaluate(options: EvaluateOptions, item: Item, out: Path, progress: Progress) -> Report:
    progress(0, 1)
    tracks, truth = item.paths
    if not truth.exists():
        raise InputError(f"{truth}: there is no such file, and no {truth.parent.name}.parquet beside that folder")
    return evaluate(tracks, truth, out, options=options)
