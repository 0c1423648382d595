"""Calibrate cameras from many detection logs, each separately: a folder for each, and a summary of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from stereophd.commands.calibrate import FILES, calibrate
from stereophd.config.loading import LoadedConfig, as_loaded
from stereophd.io.outputs.atomic import tidy
from stereophd.io.outputs.provenance import provenance
from stereophd.io.tables.schemas import FLOAT, INTEGER, STRING
from stereophd.pipeline.batch.run import Batch, Item, log_items, run_batch
from stereophd.pipeline.checks.finding import count_warnings
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES

# Columns of ``summary.parquet`` besides those of every batch; the standard deviations are the largest of the cameras.
COLUMNS = {
    "calibration": STRING,
    **dict.fromkeys(("frames", "detections"), INTEGER),
    **dict.fromkeys(("information_bits", "rotation_std_deg", "center_std"), FLOAT),
    "warnings": INTEGER,
}


def calibrate_logs(
    loaded: LoadedConfig | Path | str,
    logs: Sequence[Path | str],
    out_dir: Path | str,
    force: bool = False,
    jobs: int = 1,
    resume: bool = False,
    progress: Progress | None = None,
    dask: str | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Calibrate cameras from many detection logs, each separately.

    A log that fails is a row of the summary with the reason; the others are used.

    Parameters
    ----------
    loaded : LoadedConfig or path
        The same as in `stereophd.commands.calibrate.calibrate`.
    logs : sequence of path
        Detection logs, or patterns.
    out_dir : path
        Folder for the outputs: ``NAME/`` for each log (named as in `stereophd.commands.track_logs.track_logs`) and
        ``summary.parquet``.
    force : bool
        Whether the outputs of an earlier run may be replaced.
    jobs : int
        Logs at a time, one process each (-1: as many as there are cores); the outputs do not depend on it.
    resume : bool
        Whether finished logs stay as they are, and unfinished ones continue from their checkpoints.
    progress : callable, optional
        Called with the logs done and their number.
    dask : str, optional
        Address of a Dask scheduler whose workers do the work instead.
    **options
        The same as in `stereophd.commands.calibrate.calibrate`.

    Returns
    -------
    dict
        ``logs``: the rows of the summary; ``done`` and ``failed``: their numbers; ``exit_code``.

    Raises
    ------
    InputError
        As `stereophd.commands.track_logs.track_logs`.
    """
    loaded = as_loaded(loaded)
    from joblib import effective_n_jobs

    record = provenance("calibrate", loaded.record)
    work = partial(_calibrate, loaded, force, resume, options)
    batch = Batch(log_items(logs), work, _values, (*FILES, *UNFINISHED_FILES), COLUMNS, record)
    return run_batch(batch, out_dir, effective_n_jobs(jobs), dask, force, resume, progress)


def _calibrate(
    loaded: LoadedConfig,
    force: bool,
    resume: bool,
    options: Mapping[str, Any],
    item: Item,
    out: Path,
    progress: Progress | None,
) -> Mapping[str, Any]:
    """Calibrate from one log."""
    tidy(out)  # of a run that was killed while it moved its files, or before its first checkpoint
    return calibrate(loaded, item.paths[0], out, force, resume=resume, progress=progress, **options)


def _values(report: Mapping[str, Any]) -> Mapping[str, Any]:
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
