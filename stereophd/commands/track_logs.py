"""Track the objects of many detection logs: a folder for each, and a summary of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereophd.commands.options import TrackOptions
from stereophd.commands.track import FILES, track
from stereophd.io.outputs.provenance import provenance
from stereophd.io.tables.schemas import FLOAT, INTEGER
from stereophd.options import takes
from stereophd.pipeline.batch.run import Batch, Item, log_items, run_batch
from stereophd.pipeline.checks.finding import count_warnings
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig

# Columns of ``summary.parquet`` besides those of every batch.
COLUMNS = {
    **dict.fromkeys(("frames", "detections", "tracks", "estimates"), INTEGER),
    **dict.fromkeys(("duration_s", "log_likelihood"), FLOAT),
    "warnings": INTEGER,
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
    record = provenance("track", loaded.record)
    work = partial(_track, loaded, replace(options, jobs=1, dask=None))
    batch = Batch(log_items(logs), work, _values, (*FILES, *UNFINISHED_FILES), COLUMNS, record)
    return run_batch(batch, out_dir, options.jobs, options.dask, options.force, options.resume, progress)


def _track(
    loaded: LoadedConfig, options: TrackOptions, item: Item, out: Path, progress: Progress | None
) -> Mapping[str, Any]:
    """Track one log."""
    return track(loaded, item.paths[0], out, options=options, progress=progress)


def _values(report: Mapping[str, Any]) -> Mapping[str, Any]:
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
