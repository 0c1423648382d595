"""Score the tracks of many runs against their truths: a folder for each, and a summary of all."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from stereophd.commands.evaluate import PER_SCAN_NAME, PLOT_NAMES, REPORT_NAME, evaluate
from stereophd.commands.options import EvaluateOptions
from stereophd.errors import InputError
from stereophd.io.outputs.provenance import provenance
from stereophd.io.tables.schemas import FLOAT, INTEGER
from stereophd.options import takes
from stereophd.pipeline.batch.names import pairs_by_name
from stereophd.pipeline.batch.run import Batch, Item, run_batch
from stereophd.pipeline.runs.progress import Progress

# Columns of ``summary.parquet`` besides those of every batch.
COLUMNS = {
    "scans": INTEGER,
    **dict.fromkeys(("ospa", "ospa2", "gospa", "rmse_position", "rmse_velocity", "cardinality_bias"), FLOAT),
    "identity_switches": INTEGER,
    "nees_position": FLOAT,
}


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
        Folder of runs, ``NAME/tracks.parquet``, as `stereophd.commands.track_logs.track_logs` writes it.
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
    batch = Batch(items, partial(_evaluate, each), _values, files, COLUMNS, provenance("evaluate", values))
    return run_batch(batch, out_dir, options.jobs, options.dask, options.force, progress=progress)


def _evaluate(options: EvaluateOptions, item: Item, out: Path, progress: Progress | None) -> Mapping[str, Any]:
    """Score one run."""
    if progress is not None:
        progress(0, 1)
    return evaluate(item.paths[0], item.paths[1], out, options=options)


def _values(report: Mapping[str, Any]) -> Mapping[str, Any]:
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
