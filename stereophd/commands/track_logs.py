"""Track the objects of many detection logs: a folder for each, and a summary of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from stereophd.commands.track import FILES, track
from stereophd.config.loading import LoadedConfig, as_loaded
from stereophd.io.outputs.provenance import provenance
from stereophd.io.tables.schemas import FLOAT, INTEGER
from stereophd.pipeline.batch.run import Batch, Item, log_items, run_batch
from stereophd.pipeline.checks.finding import count_warnings
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES

# Columns of ``summary.parquet`` besides those of every batch.
COLUMNS = {
    **dict.fromkeys(("frames", "detections", "tracks", "estimates"), INTEGER),
    **dict.fromkeys(("duration_s", "log_likelihood"), FLOAT),
    "warnings": INTEGER,
}


def track_logs(
    loaded: LoadedConfig | Path | str,
    logs: Sequence[Path | str],
    out_dir: Path | str,
    force: bool = False,
    threads: int = 1,
    progress: Progress | None = None,
    resume: bool = False,
    jobs: int = 1,
    dask: str | None = None,
    pieces_s: float | None = None,
    overlap_s: float | None = None,
    plots: bool = False,
) -> dict[str, Any]:
    """Track the objects of many detection logs.

    A log that fails is a row of the summary with the reason; the others are tracked.

    Parameters
    ----------
    loaded : LoadedConfig or path
        With a ``filter`` section and cameras.
    logs : sequence of path
        Detection logs, or patterns such as ``day-*/detections.parquet``.
    out_dir : path
        Folder for the outputs: ``NAME/`` for each log, with the files of `stereophd.commands.track.track`, and
        ``summary.parquet``. NAME is the log's file name without its ending, or the name of its folder if the file is
        called ``detections.parquet``.
    force, threads, progress : bool, int, callable
        The same as in `stereophd.commands.track.track`; `progress` is called with the logs done and their number.
    resume : bool
        Whether logs that are tracked already are left as they are.
    jobs : int
        Processes on this machine; the outputs do not depend on it.
    dask : str, optional
        Address of a Dask scheduler whose workers do the work instead.
    pieces_s, overlap_s, plots : float, float, bool, optional
        The same as in `stereophd.commands.track.track`.

    Returns
    -------
    dict
        ``logs``: the rows of the summary; ``done`` and ``failed``: their numbers; ``exit_code``.

    Raises
    ------
    InputError
        No log fits a pattern, one is given twice, or the output folder cannot be used.
    """
    loaded = as_loaded(loaded)
    items = log_items(logs)
    record = provenance("track", loaded.record)
    keywords = {"threads": threads, "pieces_s": pieces_s, "overlap_s": overlap_s, "plots": plots}
    batch = Batch(
        items, partial(_track, loaded, force, resume, keywords), _values, (*FILES, *UNFINISHED_FILES), COLUMNS, record
    )
    return run_batch(batch, out_dir, jobs, dask, force, resume, progress)


def _track(
    loaded: LoadedConfig,
    force: bool,
    resume: bool,
    keywords: Mapping[str, Any],
    item: Item,
    out: Path,
    progress: Progress | None,
) -> Mapping[str, Any]:
    """Track one log."""
    return track(loaded, item.paths[0], out, force, progress=progress, resume=resume, **keywords)


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
