"""Track the objects of a detection log: write the estimates, a table of events, and a report.

Frames are read and estimates are written one after the other, so that memory does not depend on the length of the log.
Two cases differ: smoothing holds the whole run in memory, and a run in pieces holds one piece for each process.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereophd.commands.options import TrackOptions
from stereophd.config.loading import LoadedConfig, as_config
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.json_text import REPORT_VERSION, write_json
from stereophd.io.outputs.locks import output_lock
from stereophd.io.outputs.provenance import provenance, sha256_of, to_metadata
from stereophd.options import takes
from stereophd.pipeline.cameras_covariance import stated_uncertainty
from stereophd.pipeline.checks import run_checks
from stereophd.pipeline.checks.check_log import check_log, report_findings
from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.initial.acceleration import with_estimated_motion
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES, UnfinishedRun
from stereophd.pipeline.stream import EventStream, open_stream
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.single import SingleTracker
from stereophd.pipeline.tracking.tracking_run import (
    ASSOCIATIONS_FILE,
    SCANS_FILE,
    TRACKS_FILE,
    TrackingRun,
    build_tracking,
    with_detectors,
)
from stereophd.pipeline.tracking.unfinished import UnfinishedTracking
from stereophd.pipeline.workers.compile_ahead import compiling_ahead
from stereophd.report.installed import whether_to_draw
from stereophd.wording import LOGGER

if TYPE_CHECKING:
    from stereophd.pipeline.tracking.pieces import JoinedPieces

CAMERAS_FILE = "cameras.yaml"
PLOTS = tuple(f"{plot}.{kind}" for plot in ("top", "side", "timelines", "residuals") for kind in ("png", "svg"))
# The last is of a live run, which tracks its recording at the end.
FILES = (TRACKS_FILE, SCANS_FILE, ASSOCIATIONS_FILE, CAMERAS_FILE, "report.json", *PLOTS, "detections.parquet")


def with_reports(loaded: LoadedConfig, smooth: bool, associations: bool) -> LoadedConfig:
    """Return a configuration that states smoothing and associations, if they are wanted, besides its own."""
    wanted = ["report.smooth={}"] if smooth and loaded.config.report.smooth is None else []
    return as_config(loaded, [*wanted, *(["report.associations=true"] if associations else [])])


@takes(TrackOptions)
def track(
    loaded: LoadedConfig,
    log_path: Path | str,
    out_dir: Path | str,
    *,
    options: TrackOptions,
    progress: Progress = ignore,
) -> dict[str, Any]:
    """Track the objects of a detection log, as `stereophd.api.track`, into an output folder: all of it or nothing.

    The folder gets ``tracks.parquet``, ``scans.parquet``, ``report.json``; with ``report.associations``
    ``associations.parquet``; and where detectors are estimated ``cameras.yaml``, the cameras with those found.
    `progress` is called with the rows done and their total. Returns the report. Raises InputError if the configuration
    has no filter or no cameras, the log is not usable, or the folder holds other files or cannot be written to.
    """
    loaded, motion = with_estimated_motion(loaded, log_path)
    tracking = build_tracking(loaded, options.threads)
    stream = open_stream(loaded.config, tracking.cameras, log_path, progress)
    record = provenance("track", loaded.record, inputs={"detections": log_path})
    if options.pieces_s is not None:
        from stereophd.pipeline.tracking.pieces import overlap_of  # only here, as in `_Outputs.in_pieces`

        options = replace(options, overlap_s=overlap_of(options.pieces_s, options.overlap_s))
        record["pieces"] = {"length_s": options.pieces_s, "overlap_s": options.overlap_s}
    unfinished = UnfinishedRun(Path(out_dir), sha256_of(record))
    if options.resume and (report := unfinished.finished_report(record, options.force)) is not None:
        LOGGER.info("%s: finished already", out_dir)
        return report
    LOGGER.info("configuration %s, sha256 %s, seed %d", loaded.path, loaded.sha256, loaded.config.seed)
    kind = loaded.config.filter.kind if loaded.config.filter is not None else ""
    with compiling_ahead(kind), output_lock(out_dir):
        findings = check_log(loaded, log_path, of_rows=False)
        with (
            unfinished.held(options.resume, options.force),
            OutputFolder(out_dir, (*FILES, *UNFINISHED_FILES), options.force or unfinished.exists) as out,
        ):
            tracking = tracking.with_estimated_detectors(stream)
            stream = stream.with_cameras(tracking.cameras)
            plots = options.plots and whether_to_draw(options.plots)
            run = _Outputs(tracking, stream, record, unfinished, motion, plots)
            if options.pieces_s is None:
                kept = UnfinishedTracking(unfinished, tracking.estimator, tracking.report.smooth is not None)
                report = run.write(tracking.records(stream, kept), findings, out, kept=kept)
            else:
                joined = run.in_pieces(options, progress)
                report = run.write(joined.lasting_records(), findings, out, joined)
    return report


@dataclass(frozen=True)
class _Outputs:
    """What makes the outputs of a run: what tracks, what is read, and where an unfinished run is kept."""

    tracking: TrackingRun
    stream: EventStream
    record: dict[str, Any]
    unfinished: UnfinishedRun
    motion: dict[str, Any] | None = None
    plots: bool = False

    def in_pieces(self, options: TrackOptions, progress: Progress) -> JoinedPieces:
        """Track the log in pieces."""
        # Only here: a run in one piece begins sooner without what joins pieces.
        from stereophd.pipeline.tracking.pieces import JoinedPieces, PieceWork, plan_pieces, track_pieces

        length_s, overlap_s = options.pieces_s or 0.0, options.overlap_s or 0.0
        log = Path(os.path.abspath(self.stream.source))
        unfinished = UnfinishedRun(Path(os.path.abspath(self.unfinished.out)), self.unfinished.identity)
        work = PieceWork(self.tracking.loaded, self.tracking.cameras, log, unfinished, options.threads)
        ahead = self.tracking.report.smooth is not None
        pieces = plan_pieces(self.stream.frames, length_s, overlap_s, ahead)
        track_pieces(work, pieces, options.jobs, options.dask, progress)
        joined = JoinedPieces(work, pieces, length_s, overlap_s, isinstance(self.tracking.estimator, SingleTracker))
        self.stream.not_invertible = joined.not_invertible
        return joined

    def write(
        self, records: Iterator[Record], findings: tuple[Finding, ...], out: OutputFolder,
        joined: JoinedPieces | None = None, kept: UnfinishedTracking | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Write all files of the output folder; return the report."""
        tracking, loaded = self.tracking, self.tracking.loaded
        if tracking.detectors is not None:
            described = with_detectors(loaded.cameras, tracking.cameras)
            write_cameras(out.path(CAMERAS_FILE), described, loaded.config.units.length, self.record)
        metadata = to_metadata(self.record)
        uncertainty = stated_uncertainty(tracking.cameras, loaded.config.cameras_covariance)
        summary = tracking.write(records, out, metadata, kept, uncertainty)
        counts = self.stream.counts
        LOGGER.info("%s: %d frames, %d detections", self.stream.source, counts["frames"], counts["detections"])
        can_estimate = tracking.motion.moves and not isinstance(tracking.estimator, SingleTracker) and not self.motion
        run = run_checks.FinishedRun(
            summary, counts, tracking.cameras, self.stream.has_noise, tracking.boxes, can_estimate
        )
        since = functools.partial(check_log, loaded, self.stream.source, False, tracking.cameras)
        findings += run.checked(findings, since)
        findings += tuple(run_checks.check_estimated_detectors(tracking.detectors))
        report = {
            "report_version": REPORT_VERSION,
            "length_unit": loaded.config.units.length,
            "input": self.stream.counts,
            "detectors": tracking.detectors,
            "motion": self.motion,
            **({} if joined is None else {"pieces": joined.report()}),
            **summary,
            "checks": report_findings(findings),
            "provenance": self.record,
        }
        write_json(out.path("report.json"), report)
        if self.plots:
            _draw(report, out)
        return report


def _draw(report: dict[str, Any], out: OutputFolder) -> None:
    """Draw the plots of a run from the files that it has written."""
    from stereophd.pipeline.inspection.runs import read_run
    from stereophd.report.plots.track_plots import write_track_plots  # costly to import, and an extra

    run = read_run(out.path(TRACKS_FILE).parent, "track", report)
    kept = [name for name in PLOTS if run.associations is not None or not name.startswith("residuals")]
    write_track_plots(run, {name: out.path(name) for name in kept})
