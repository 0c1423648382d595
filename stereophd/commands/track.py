"""The one filter loop: a detection log in, tracks out, event by event.

Memory does not depend on the length of the log: frames are read as they come, and estimates are
written as they are made (smoothing, which needs the whole run, holds it in memory).
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereophd.config.model import Config
from stereophd.config.single import SingleConfig
from stereophd.core.disparity.sample_move import carry_components
from stereophd.core.motion.models import Motion
from stereophd.core.numerics.kernel_cache import is_kept
from stereophd.errors import InputError
from stereophd.io.atomic import OutputFolder
from stereophd.io.log_checks import KINDS
from stereophd.io.logs import LogReader
from stereophd.io.provenance import provenance, to_metadata
from stereophd.io.tables import SCANS, TRACKS, TableWriter
from stereophd.pipeline.build import build_filter, build_labelled_filter, build_motion, report_times
from stereophd.pipeline.detectors.passes import estimate_detectors
from stereophd.pipeline.tracking.loop import Progress, Record, ReportTimes, run_filter
from stereophd.pipeline.tracking.records import smoothed_records, write_records
from stereophd.pipeline.tracking.single import build_single, run_single

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig
    from stereophd.core.geometry.camera import Camera

FILES = ("tracks.parquet", "scans.parquet", "report.json")
REPORT_VERSION = 1

LOGGER = logging.getLogger("stereophd")


def track(
    loaded: LoadedConfig,
    log_path: Path | str,
    out_dir: Path | str,
    force: bool = False,
    threads: int = 1,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Track the objects of a detection log.

    Parameters
    ----------
    loaded : LoadedConfig
        With a ``filter`` section and cameras.
    log_path : path
        Detection log.
    out_dir : path
        Folder for ``tracks.parquet``, ``scans.parquet`` and ``report.json``; all or none is written.
    force : bool
        Whether the outputs of an earlier run may be replaced.
    threads : int
        Threads of the sample trips; the outputs do not depend on it.
    progress : callable, optional
        Called with the rows done and their total.

    Returns
    -------
    dict
        The report, as in ``report.json``.

    Raises
    ------
    InputError
        The configuration has no filter or no cameras; the log is not usable; the output folder is not
        ours or cannot be written.
    """
    config = loaded.config
    cameras = loaded.build_cameras()
    motion, run = _prepare(config, cameras, loaded.path, threads)
    estimated = [name for name, c in loaded.cameras.items() if c.detector.estimate or config.detector == "estimate"]
    if estimated and isinstance(config.filter, SingleConfig):
        raise InputError(f"{loaded.path}: detector: expected given where filter.kind is single, found estimate")
    rolling = [camera for camera in cameras if camera.readout_s != 0.0]
    if rolling and isinstance(config.filter, SingleConfig):
        where = f"{loaded.path}: cameras.{rolling[0].name}.readout_s"
        raise InputError(f"{where}: expected 0 where filter.kind is single, found {rolling[0].readout_s:g}")
    LOGGER.info("configuration %s, sha256 %s, seed %d", loaded.path, loaded.sha256, config.seed)
    _announce_compilation()
    reader = LogReader(log_path, cameras, config.input.on_bad_row, config.input.image_margin_px)
    with OutputFolder(out_dir, FILES, force) as out:
        detectors = None
        if estimated:
            cameras, detectors = estimate_detectors(
                cameras, estimated, lambda found: build_labelled_filter(config, found, loaded.path, threads),
                lambda: LogReader(log_path, cameras, config.input.on_bad_row, config.input.image_margin_px),
                progress,
            )  # fmt: skip
            motion, run = _prepare(config, cameras, loaded.path, threads)
        record = provenance("track", loaded.record, inputs={"detections": log_path})
        metadata = to_metadata(record)
        with (
            TableWriter(out.path("tracks.parquet"), TRACKS, metadata) as tracks,
            TableWriter(out.path("scans.parquet"), SCANS, metadata) as scans,
        ):
            unusable = [0]
            records = run(reader, report_times(config.report), unusable, progress)
            if config.report.smooth is not None:
                records = smoothed_records(records, cameras, motion, config.report.smooth.max_gap_s)
            names = [camera.name for camera in cameras]
            summary = write_records(records, tracks, scans, names, config.report.max_position_std)
        report = {
            "report_version": REPORT_VERSION,
            "length_unit": config.units.length,
            "input": {**reader.counts, "not_invertible": unusable[0]},
            "detectors": detectors,
            **summary,
            "provenance": record,
        }
        text = json.dumps(report, indent=2, allow_nan=False) + "\n"
        out.path("report.json").write_text(text, encoding="utf-8")
    _warn_of_losses(reader, log_path, cameras, unusable[0])
    return report


def _announce_compilation() -> None:
    """Say that the kernels are compiled first, where no compiled ones are found."""
    if not is_kept(carry_components):
        LOGGER.info("first run: compiling the kernels, once, in about a minute")


def _warn_of_losses(reader: LogReader, log_path: Path | str, cameras: tuple[Camera, ...], unusable: int) -> None:
    """Say what of the log did not reach the filter, and which cameras said nothing."""
    counts = reader.counts
    LOGGER.info("%s: %d frames, %d detections", log_path, counts["frames"], counts["detections"])
    dropped = {kind: counts[kind] for kind in KINDS if counts.get(kind)}
    if dropped:
        why = ", ".join(f"{kind} {count}" for kind, count in dropped.items())
        LOGGER.warning("%s: %d of %d rows dropped (%s)", log_path, sum(dropped.values()), counts["rows"], why)
    if unusable:
        LOGGER.warning("%s: %d detections lie where the lens model cannot be inverted: left out", log_path, unusable)
    if counts.get("cameras_without_frames"):
        LOGGER.warning(
            "%s: no frames of %d of the %d cameras: %s",
            log_path,
            len(reader.silent_cameras),
            len(cameras),
            ", ".join(reader.silent_cameras),
        )


def _prepare(
    config: Config, cameras: tuple[Camera, ...], path: Path | str, threads: int
) -> tuple[Motion, Callable[[LogReader, ReportTimes, list[int], Progress | None], Iterator[Record]]]:
    """Return the motion model, and what runs the filter or the single-object estimator over a log."""
    if isinstance(config.filter, SingleConfig):
        motion, point = build_motion(config.motion), config.filter.point
        estimator = build_single(config, motion, cameras, path)
        return motion, partial(run_single, estimator, point)
    multi_filter = build_filter(config, cameras, path, threads)
    keep_events = config.report.smooth is not None
    return multi_filter.motion, partial(run_filter, multi_filter, keep_events=keep_events)
