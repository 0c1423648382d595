"""Track the objects of a detection log: tracks, one row an event, and a report.

Memory does not depend on the length of the log: frames are read as they come, and estimates are
written as they are made (smoothing, which needs the whole run, holds it in memory).
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereophd.core.disparity.sample_move import carry_components
from stereophd.core.numerics.kernel_cache import is_kept
from stereophd.io.atomic import OutputFolder
from stereophd.io.cameras import write_cameras
from stereophd.io.json_text import write_json
from stereophd.io.log_checks import KINDS
from stereophd.io.provenance import provenance, to_metadata
from stereophd.pipeline.checks.run import check_log, report_findings
from stereophd.pipeline.checks.tracking import check_tracking
from stereophd.pipeline.finished import finished_report
from stereophd.pipeline.progress import Progress
from stereophd.pipeline.stream import EventStream, open_stream
from stereophd.pipeline.tracking.run import (
    ASSOCIATIONS_FILE,
    SCANS_FILE,
    TRACKS_FILE,
    build_tracking,
    with_detectors,
    with_estimated_detectors,
    write_tracks,
)

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig

CAMERAS_FILE = "cameras.yaml"
FILES = (TRACKS_FILE, SCANS_FILE, ASSOCIATIONS_FILE, CAMERAS_FILE, "report.json")
REPORT_VERSION = 1

LOGGER = logging.getLogger("stereophd")


def track(
    loaded: LoadedConfig,
    log_path: Path | str,
    out_dir: Path | str,
    force: bool = False,
    threads: int = 1,
    progress: Progress | None = None,
    resume: bool = False,
) -> dict[str, Any]:
    """Track the objects of a detection log.

    Parameters
    ----------
    loaded : LoadedConfig
        With a ``filter`` section and cameras.
    log_path : path
        Detection log.
    out_dir : path
        Folder for ``tracks.parquet``, ``scans.parquet`` and ``report.json``; all or none is written. Where detectors
        are estimated, also for ``cameras.yaml``, the cameras with the detectors found; with ``report.associations``,
        also for ``associations.parquet``.
    force : bool
        Whether the outputs of an earlier run may be replaced.
    threads : int
        Threads of the sample trips; the outputs do not depend on it.
    progress : callable, optional
        Called with the rows done and their total.
    resume : bool
        Whether the results of a finished run of this configuration and log may stand.

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
    tracking = build_tracking(loaded, threads)
    stream = open_stream(loaded.config, tracking.cameras, log_path, progress)
    record = provenance("track", loaded.record, inputs={"detections": log_path})
    if resume and (report := finished_report(out_dir, record, force)) is not None:
        LOGGER.info("%s: finished already", out_dir)
        return report
    LOGGER.info("configuration %s, sha256 %s, seed %d", loaded.path, loaded.sha256, loaded.config.seed)
    _announce_compilation()
    findings = check_log(loaded, log_path, thorough=False)
    with OutputFolder(out_dir, FILES, force) as out:
        tracking = with_estimated_detectors(tracking, loaded, stream, threads)
        stream = stream.with_cameras(tracking.cameras)
        metadata = to_metadata(record)
        if tracking.detectors is not None:
            described = with_detectors(loaded.cameras, tracking.cameras)
            write_cameras(out.path(CAMERAS_FILE), described, loaded.config.units.length, record)
        summary = write_tracks(tracking.records(stream), out, metadata, tracking.cameras, loaded.config.report)
        findings += tuple(check_tracking(summary, stream.counts, tracking.cameras))
        report = {
            "report_version": REPORT_VERSION,
            "length_unit": loaded.config.units.length,
            "input": stream.counts,
            "detectors": tracking.detectors,
            **summary,
            "checks": report_findings(findings),
            "provenance": record,
        }
        write_json(out.path("report.json"), report)
    _warn_of_losses(stream)
    return report


def _announce_compilation() -> None:
    """Say that the kernels are compiled first, where no compiled ones are found."""
    if not is_kept(carry_components):
        LOGGER.info("first run: compiling the kernels, once, in about a minute")


def _warn_of_losses(stream: EventStream) -> None:
    """Warn of what did not reach the filter: bad rows, detections beyond the lens model, cameras without frames."""
    counts, source = stream.counts, stream.source
    LOGGER.info("%s: %d frames, %d detections", source, counts["frames"], counts["detections"])
    dropped = {kind: counts[kind] for kind in KINDS if counts.get(kind)}
    if dropped:
        why = ", ".join(f"{kind} {count}" for kind, count in dropped.items())
        LOGGER.warning("%s: %d of %d rows dropped (%s)", source, sum(dropped.values()), counts["rows"], why)
    if counts["not_invertible"]:
        LOGGER.warning(
            "%s: %d detections lie where the lens model cannot be inverted: left out", source, counts["not_invertible"]
        )
    silent = stream.silent_cameras
    if silent:
        LOGGER.warning(
            "%s: no frames of %d of the %d cameras: %s", source, len(silent), len(stream.cameras), ", ".join(silent)
        )
