"""Calibrate cameras from many detection logs, each separately: a folder for each, and a summary of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereophd.commands.calibrate import FILES, calibrate
from stereophd.commands.options import CalibrateOptions
from stereophd.io.outputs.atomic import tidy
from stereophd.io.outputs.provenance import provenance
from stereophd.io.tables.schemas import FLOAT, INTEGER, STRING
from stereophd.options import takes
from stereophd.pipeline.batch.run import Batch, Item, log_items, run_batch
from stereophd.pipeline.checks.finding import count_warnings
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig

# Columns of ``summary.parquet`` besides those of every batch; the standard deviations are the largest of the cameras.
COLUMNS = {
    "calibration": STRING,
    **dict.fromkeys(("frames", "detections"), INTEGER),
    **dict.fromkeys(("information_bits", "rotation_std_deg", "center_std"), FLOAT),
    "warnings": INTEGER,
}


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
        Folder for the outputs: ``NAME/`` for each log (named as in `stereophd.commands.track_logs.track_logs`) and
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
        As `stereophd.commands.track_logs.track_logs`.
    """
    from joblib import effective_n_jobs

    record = provenance("calibrate", loaded.record)
    work = partial(_calibrate, loaded, replace(options, jobs=1, dask=None))
    batch = Batch(log_items(logs), work, _values, (*FILES, *UNFINISHED_FILES), COLUMNS, record)
    jobs = effective_n_jobs(options.jobs)
    return run_batch(batch, out_dir, jobs, options.dask, options.force, options.resume, progress)


def _calibrate(
    loaded: LoadedConfig, options: CalibrateOptions, item: Item, out: Path, progress: Progress | None
) -> Mapping[str, Any]:
    """Calibrate from one log."""
    tidy(out)  # of a run that was killed while it moved its files, or before its first checkpoint
    return calibrate(loaded, item.paths[0], out, options=options, progress=progress)


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
