"""Track a recording that is still running: a line for each record as soon as it is known, files beside it.

Every frame that is used is first recorded as a line of JSON, in the order of arrival. At checkpoints, and at the end of
the stream or an interrupt, the recording becomes ``detections.parquet`` and is tracked as `stereophd.commands.track`
does: the files are those of that command, to the byte, however the frames arrived. A process of its own writes those of
a checkpoint, and all of them come into their places together.
"""

import contextlib
import io
import itertools
import math
import os
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

from stereophd.commands.recalibrate import Recalibration, with_pose
from stereophd.commands.track import CAMERAS_FILE, FILES, track
from stereophd.config.loading import LoadedConfig, variant
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.outputs.atomic import OutputFolder, output_folder
from stereophd.io.outputs.locks import output_lock
from stereophd.io.streams.documents import CameraPlace, Checkpoint, Knocked, LiveEvent, Ready, Recalibrated, Status
from stereophd.io.streams.messages import Message
from stereophd.io.streams.rows import JsonLines, Publisher, RowSink, document_of
from stereophd.io.streams.sources import Arrivals
from stereophd.pipeline.build import report_times
from stereophd.pipeline.live.frames import FrameChecks
from stereophd.pipeline.live.lagged import LaggedRecords
from stereophd.pipeline.live.live_run import LiveRun, warm_up_messages, without_collections
from stereophd.pipeline.live.recording import read_recording, write_log
from stereophd.pipeline.tracking.knocked import Knock
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.tracking_run import TrackingRun, build_tracking
from stereophd.pipeline.workers.aside import Aside
from stereophd.pipeline.workers.worker_process import WorkerProcess

LOG_FILE = "detections.parquet"
# Time between two reports of how a run goes, s.
STATUS_EVERY_S = 2.0
# Longest wait at the end of the stream for a camera that is being solved, s, and the status where it is not solved.
PATIENCE_S, NOT_FINISHED = 30.0, "not finished when the stream ended"
# Time between two checkpoints, s; more where one takes more than this part of it.
CHECKPOINT_EVERY_S, MOST_SHARE = 60.0, 0.1


@dataclass(frozen=True)
class LiveOutputs:
    """Where a live run writes; None: nowhere."""

    rows: Sequence[RowSink] = ()  # What takes each record as it comes
    folder: Path | None = None  # The files of a batch run, at checkpoints and at the end
    recording: Path | None = None  # The frames as lines of JSON; None: beside the folder until it holds them all
    force: bool = False  # Whether the folder may hold an earlier run
    resume: bool = False  # Whether the frames that a killed run recorded come first

    @property
    def frames(self) -> Path | None:
        """Where the frames are recorded."""
        return Path(f"{self.folder}.frames.jsonl") if self.recording is None and self.folder else self.recording


def track_live(loaded: LoadedConfig, arrivals: Arrivals, source: str, outputs: LiveOutputs) -> dict[str, Any]:
    """Track frames as they arrive, by a configuration with a ``filter`` section of several objects and cameras.

    Arrivals come from a source as in `stereophd.io.streams.sources`, whose name serves messages; an interrupt ends them
    like the end of the stream. Returns counts of frames, late, revised and bad ones, percentiles: ``latency_ms``, of
    the time from the arrival of a frame to its row, and ``processor_ms``, of the CPU time of a frame. Raises
    InputError if the configuration is for whole logs only, if a frame is bad and ``input.on_bad_row`` is ``error``, or
    if an output cannot be written.
    """
    _check(loaded)
    tracking = _tracking(loaded)
    with contextlib.ExitStack() as held:
        if outputs.folder is not None:
            held.enter_context(output_lock(outputs.folder))
        recorded, stream = _recording(outputs, held)
        if outputs.folder is not None:
            output_folder(outputs.folder, outputs.force or outputs.resume, FILES)
        with without_collections("" if loaded.config.filter is None else loaded.config.filter.kind):
            warming_up = variant(loaded, [("warm-up", {"input.on_bad_row": "drop", "live.recalibrate": False})])
            _Session(warming_up, tracking, LiveOutputs([JsonLines(io.BytesIO())])).work(
                warm_up_messages(tracking.cameras), "warm-up"
            )
            session = _Session(loaded, tracking, outputs)
            poses = [(camera.name, camera.pose) for camera in tracking.cameras]
            session.tell(Ready([CameraPlace(n, pose.center.tolist(), pose.rotation[2].tolist()) for n, pose in poses]))
            session.work(itertools.chain(recorded, session.recording_to(stream, arrivals)), source)
        if outputs.folder is not None and session.checks.counts["frames"]:
            _write_files(session.found, outputs)
        if outputs.recording is None and outputs.frames is not None:
            os.truncate(outputs.frames, 0)  # the folder holds all frames
    counts = session.run.counts
    return {
        "frames": session.checks.counts,
        "late_frames": counts.late,
        "revised_events": counts.revised,
        "latency_ms": counts.latency.percentiles_ms(),
        "processor_ms": counts.processor.percentiles_ms(),
    }


def _tracking(loaded: LoadedConfig) -> TrackingRun:
    """Return what tracks, without claims to detections: no row has them."""
    tracking = build_tracking(loaded)
    if not isinstance(tracking.estimator, DisparityFilter):
        return tracking
    return replace(tracking, estimator=replace(tracking.estimator, claims=False))


class _Session:
    """A live run with what happens beside it: frames are recorded, and knocked cameras solved anew.

    `found` is the configuration with the poses that were found.
    """

    def __init__(self, loaded: LoadedConfig, tracking: TrackingRun, outputs: LiveOutputs) -> None:
        config = loaded.config
        self.found = self._tracked_by = loaded
        self.checks = FrameChecks(tracking.cameras, config.input.on_bad_row, config.input.image_margin_px)
        times = report_times(config.report, config.region)
        lag_s, self._is_lagged = config.report.lag_s, config.report.lag_s is not None
        lagged = None if lag_s is None else LaggedRecords(tracking.motion, lag_s)
        self.run = LiveRun(tracking.estimator, times, self.checks, config.live, self._keep, lagged)
        self._outputs, self._rows = outputs, outputs.rows
        self._stream: IO[str] | None = None
        self._most_std = config.report.max_position_std
        self._told_s = -math.inf
        self._knock: Knock | None = None
        self._recalibration: Recalibration | None = None
        self._shown_s = -math.inf  # time of the last record
        self._checkpoint = Aside()
        self._began_s, self._next_s = 0.0, time.monotonic() + CHECKPOINT_EVERY_S

    def recording_to(self, stream: IO[str] | None, arrivals: Arrivals) -> Arrivals:
        """Yield arrivals; those that are used are recorded."""
        self._stream = stream
        yield from arrivals

    def tell(self, event: LiveEvent) -> None:
        """Report an event to every sink."""
        for sink in self._rows:
            sink.tell(event)

    def work(self, arrivals: Arrivals, source: str) -> None:
        """Work all arrivals."""
        processor_s = time.thread_time()
        with contextlib.ExitStack() as ending:
            ending.enter_context(contextlib.suppress(KeyboardInterrupt))
            ending.callback(self._checkpoint.stop)
            ending.callback(self._give_up_recalibration)
            for live in self.run.records(arrivals, source):
                if not self._is_lagged:
                    self._show(live.record, live.is_revised)
                elif not live.is_revised:
                    self._show_late()
                if not live.is_revised:
                    before_s, processor_s = processor_s, time.thread_time()
                    self.run.counts.add_row(live.arrived_s, processor_s - before_s)
                self._look_after_cameras(live.record)
                if time.monotonic() > self._told_s + STATUS_EVERY_S:
                    self._told_s = time.monotonic()
                    self._tell_status()
                    self._save()
            self._show_late(is_over=True)
            if self._recalibration is not None:
                self._recalibration.aside.wait(PATIENCE_S)
                self._take_recalibration(self._recalibration)

    def _show(self, record: Record, is_revised: bool) -> None:
        """Give a record to every sink."""
        if not self._rows or not record.reported:
            return
        shown = record.estimates if self._most_std is None else record.estimates.certain(self._most_std)
        document = document_of(record.time_s, record.camera, record.frame, shown, is_revised)
        for sink in self._rows:
            sink.add(document)

    def _show_late(self, is_over: bool = False) -> None:
        """Give the smoothed records that are due to every sink."""
        for record in self.run.late_records(is_over):
            self._show(record, False)

    def _tell_status(self) -> None:
        counts, run = self.checks.counts, self.run
        for sink in self._rows:
            if isinstance(sink, Publisher):
                latency_ms = run.counts.latency.percentiles_ms()
                sink.tell(Status(counts["frames"], run.counts.late, counts["too_late"], run.residuals, latency_ms))

    def _save(self) -> None:
        """Let a process write the files of a checkpoint when it is time; tell how the last one ended."""
        if self._outputs.folder is None or self._stream is None:
            return
        now_s, outcome = time.monotonic(), self._checkpoint.take()
        if outcome is not None:
            self._next_s = now_s + max(CHECKPOINT_EVERY_S, (now_s - self._began_s) / MOST_SHARE)
            failed = isinstance(outcome, Exception)
            self.tell(Checkpoint(error=str(outcome)) if failed else Checkpoint(outcome))
        elif now_s >= self._next_s and not self._checkpoint.is_busy:
            self._began_s, found, outputs = now_s, self.found, self._outputs
            self._checkpoint.start(lambda worker: _write_files(found, outputs, worker))

    def _keep(self, message: Message) -> None:
        """Write a frame before it is worked: a killed run has lost none."""
        if self._stream is not None:
            self._stream.write(message.to_line() + "\n")
            self._stream.flush()
        if self._recalibration is not None:
            self._recalibration.keep(message)

    def _look_after_cameras(self, record: Record) -> None:
        if record.knock is not None and record.knock != self._knock:
            self._knock = record.knock
            self.tell(Knocked(**asdict(record.knock)))
            # another pose for a camera that stands still would be a confident wrong answer
            if self.found.config.live.recalibrate and not record.knock.others:
                self._recalibration = Recalibration(self._tracked_by, record.knock, record)
                self.run.pass_over(record.knock.camera)
        self._shown_s = record.time_s
        if self._recalibration is not None:
            self._take_recalibration(self._recalibration)

    def _take_recalibration(self, recalibration: Recalibration) -> None:
        """Tell what a try to solve a camera has found, if one has ended, and go on with its pose."""
        result = recalibration.step(self._shown_s)
        if result is None:
            return
        knock, pose = recalibration.knock, result.get("pose")
        self.tell(Recalibrated(knock.camera, self._shown_s, **result))
        if pose is not None:
            self._tracked_by = with_pose(self._tracked_by, knock.camera, pose, None)
            self.found = with_pose(self.found, knock.camera, pose, knock.since_s)
            self.run.go_on(_tracking(self._tracked_by).estimator)
        if pose is not None or recalibration.is_over:
            self._recalibration = None

    def _give_up_recalibration(self) -> None:
        """Tell at the end of a run that a camera is still to be solved."""
        if self._recalibration is not None:
            self._recalibration.aside.stop()
            self.tell(Recalibrated(self._recalibration.knock.camera, self._shown_s, NOT_FINISHED))


def _check(loaded: LoadedConfig) -> None:
    """Refuse what needs the whole log."""
    if isinstance(loaded.config.filter, SingleSettings):
        raise InputError(f"{loaded.path}: filter.kind: expected a filter of several objects (live), found single")
    if loaded.estimated_cameras:
        raise InputError(
            f"{loaded.path}: detector: expected the detectors of all cameras for a live run, found estimate; estimate "
            "them from a recording first (`stereophd track`)"
        )


def _recording(outputs: LiveOutputs, held: contextlib.ExitStack) -> tuple[Arrivals, IO[str] | None]:
    """Open the file of the frames; return those that it holds already, and where further ones are written."""
    path = outputs.frames
    if path is None:
        return iter(()), None
    if path.exists() and not outputs.resume and (outputs.recording is not None or not outputs.force):
        raise InputError(
            f"{path}: the file exists; choose another name for the recording, or `resume=True` to go on after its "
            "frames"
        )
    try:
        stream = held.enter_context(path.open("a" if outputs.resume else "w", encoding="utf-8", newline="\n"))
        held.callback(_remove_empty, path)
        with path.open("rb") as content:  # what a killed run wrote last may be half a line
            size = sum(len(line) for line in content if line.endswith(b"\n"))
        os.truncate(path, size)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return read_recording(path), stream


def _remove_empty(path: Path) -> None:
    with contextlib.suppress(OSError):
        if not path.stat().st_size:
            path.unlink()


def _write_files(loaded: LoadedConfig, outputs: LiveOutputs, worker: WorkerProcess | None = None) -> int:
    """Track the recording so far as a batch run does, here or in a worker, and put its files into their places.

    Returns the number of its frames.
    """
    assert outputs.folder is not None
    assert outputs.frames is not None
    with OutputFolder(outputs.folder, FILES, force=True) as out:
        task = loaded, outputs.frames, out.path(LOG_FILE).parent
        frames: int = track_recording(task) if worker is None else worker.call(track_recording, task)
    return frames


def track_recording(task: tuple[LoadedConfig, Path, Path]) -> int:
    """Turn a recording into a log in a folder, and track it as a batch run does; return the number of its frames."""
    loaded, recording, place = task
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / LOG_FILE
        write_log(loaded, recording, log)
        report = track(loaded, log, place)
        if any(camera.poses for camera in loaded.cameras.values()):
            write_cameras(place / CAMERAS_FILE, loaded.cameras, loaded.config.units.length)
        # after the other files: the log lies beside them, and is no output of `track`
        shutil.copyfile(log, place / LOG_FILE)
    frames: int = report["input"]["frames"]
    return frames
