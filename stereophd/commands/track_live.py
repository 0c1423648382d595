"""Track a recording that is still running: a line for each record as soon as it is known, the usual files at its end.

Every frame that was used is recorded as a line of JSON, in the order of arrival. At the end of the stream, or at an
interrupt, the recording becomes ``detections.parquet`` and is tracked as `stereophd.commands.track` does: the files are
those of that command, to the byte, however the frames arrived.
"""

from __future__ import annotations

import contextlib
import io
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from stereophd.commands.recalibrate import Recalibration, with_pose
from stereophd.config.loading import LoadedConfig, variant
from stereophd.core.geometry.camera import Camera
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.streams.messages import Message
from stereophd.io.streams.rows import JsonLines, Publisher, RowSink, document_of
from stereophd.io.streams.sources import Arrivals
from stereophd.pipeline.build import report_times
from stereophd.pipeline.live.frames import FrameChecks
from stereophd.pipeline.live.recording import write_log
from stereophd.pipeline.live.run import LiveRecord, LiveRun, warm_up_messages, without_collections
from stereophd.pipeline.tracking.knocked import Knock
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.run import TrackingRun, build_tracking, estimated_cameras

LOG_FILE = "detections.parquet"
# Time between two reports of how a run goes, s.
STATUS_EVERY_S = 2.0


@dataclass(frozen=True)
class LiveOutputs:
    """Where a live run writes; None: nowhere."""

    rows: Sequence[RowSink] = ()  # What takes each record as it comes
    folder: Path | None = None  # The files of a batch run, at the end
    recording: Path | None = None  # The frames as lines of JSON, while they arrive
    force: bool = False  # Whether the folder may hold an earlier run


def track_live(loaded: LoadedConfig, arrivals: Arrivals, source: str, outputs: LiveOutputs) -> dict[str, Any]:
    """Track frames as they arrive, by a configuration with a ``filter`` section of several objects and cameras.

    Arrivals come from a source as in `stereophd.io.streams.sources`, whose name serves messages; an interrupt ends them
    like the end of the stream. Returns counts of frames, late, revised and bad ones, percentiles: ``latency_ms``, of
    the time from the arrival of a frame to its row, and ``processor_ms``, of the processor time of a frame. Raises
    InputError if the configuration is for whole logs only, if a frame is bad and ``input.on_bad_row`` is ``error``, or
    if an output cannot be written.
    """
    _check(loaded)
    if outputs.recording is not None and outputs.recording.exists():
        raise InputError(f"{outputs.recording}: the file exists; choose another name for the recording")
    tracking = build_tracking(loaded)
    with _recording(outputs) as (path, stream):
        with without_collections("" if loaded.config.filter is None else loaded.config.filter.kind):
            warming_up = variant(loaded, [("warm-up", {"input.on_bad_row": "drop", "live.recalibrate": False})])
            _Session(warming_up, tracking, [JsonLines(io.StringIO())], None).work(
                warm_up_messages(tracking.cameras), "warm-up"
            )
            session = _Session(loaded, tracking, outputs.rows, stream)
            session.tell({"event": "ready", "cameras": [_described(camera) for camera in tracking.cameras]})
            session.work(arrivals, source)
        report = {"frames": session.checks.counts, **_summary(session.run)}
        if outputs.folder is not None and session.checks.counts["frames"]:
            _write_files(session.found, path, outputs)
    return report


class _Session:
    """A live run with what happens beside it: frames are recorded, and knocked cameras solved anew.

    `found` is the configuration with the poses that were found.
    """

    def __init__(
        self, loaded: LoadedConfig, tracking: TrackingRun, rows: Sequence[RowSink], stream: IO[str] | None
    ) -> None:
        config = loaded.config
        self.found = self._tracked_by = loaded
        self.checks = FrameChecks(tracking.cameras, config.input.on_bad_row, config.input.image_margin_px)
        times = report_times(config.report, config.region)
        self.run = LiveRun(tracking.estimator, times, self.checks, config.live, self._keep)
        self._rows, self._stream = rows, stream
        self._most_std = config.report.max_position_std
        self._told_s = -math.inf
        self._knock: Knock | None = None
        self._recalibration: Recalibration | None = None

    def tell(self, event: dict[str, Any]) -> None:
        """Report an event to every sink."""
        for sink in self._rows:
            sink.tell(event)

    def work(self, arrivals: Arrivals, source: str) -> None:
        """Work all arrivals."""
        processor_s = time.thread_time()
        with contextlib.suppress(KeyboardInterrupt):
            for live in self.run.records(arrivals, source):
                if self._rows and live.record.reported:
                    document = _document(live, self._most_std)
                    for sink in self._rows:
                        sink.add(document)
                if not live.is_revised:
                    before_s, processor_s = processor_s, time.thread_time()
                    self.run.counts.add_row(live.arrived_s, processor_s - before_s)
                self._look_after_cameras(live.record)
                if time.monotonic() > self._told_s + STATUS_EVERY_S:
                    self._told_s = time.monotonic()
                    self._tell_status()

    def _tell_status(self) -> None:
        """Tell those who watch how the run goes."""
        counts, residuals = self.checks.counts, self.run.residuals
        status = {"event": "status", "frames": counts["frames"], "late": self.run.counts.late}
        status |= {
            "too_late": counts["too_late"],
            "residuals": residuals,
            "latency_ms": self.run.counts.latency.percentiles_ms(),
        }
        for sink in self._rows:
            if isinstance(sink, Publisher):
                sink.tell(status)

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
            self.tell({"event": "knocked", **asdict(record.knock)})
            if self.found.config.live.recalibrate:
                self._recalibration = Recalibration(self._tracked_by, record.knock, record)
                self.run.pass_over(record.knock.camera)
        if self._recalibration is None:
            return
        result = self._recalibration.step(record.time_s)
        if result is None:
            return
        knock, pose = self._recalibration.knock, result.get("pose")
        self.tell({"event": "recalibrated", "camera": knock.camera, "time_s": record.time_s, **result})
        if pose is not None:
            self._tracked_by = with_pose(self._tracked_by, knock.camera, pose, None)
            self.found = with_pose(self.found, knock.camera, pose, knock.since_s)
            self.run.go_on(build_tracking(self._tracked_by).estimator)
        if pose is not None or self._recalibration.is_over:
            self._recalibration = None


def _described(camera: Camera) -> dict[str, Any]:
    """Return where a camera stands and looks, for those who draw the tracks."""
    pose = camera.pose
    return {"name": camera.name, "center": pose.center.tolist(), "looks_along": pose.rotation[2].tolist()}


def _check(loaded: LoadedConfig) -> None:
    """Refuse what needs the whole log."""
    if isinstance(loaded.config.filter, SingleSettings):
        raise InputError(f"{loaded.path}: filter.kind: expected a filter of several objects (live), found single")
    if estimated_cameras(loaded):
        raise InputError(
            f"{loaded.path}: detector: expected the detectors of all cameras for a live run, found estimate; estimate "
            "them from a recording first (`stereophd track`)"
        )


@contextlib.contextmanager
def _recording(outputs: LiveOutputs) -> Iterator[tuple[Path, IO[str] | None]]:
    """Open the file of the frames: the user's, or a temporary one for the files of the end."""
    with contextlib.ExitStack() as held:
        path = outputs.recording
        if path is None and outputs.folder is None:
            yield Path(), None
            return
        if path is None:
            path = Path(held.enter_context(tempfile.TemporaryDirectory())) / "frames.jsonl"
        try:
            stream = held.enter_context(open(path, "x", encoding="utf-8", newline="\n"))
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
        yield path, stream


def _document(live: LiveRecord, max_position_std: float | None) -> dict[str, Any]:
    record = live.record
    estimates = record.estimates if max_position_std is None else record.estimates.certain(max_position_std)
    return document_of(record.time_s, record.camera, record.frame, estimates, live.is_revised)


def _summary(run: LiveRun) -> dict[str, Any]:
    counts = run.counts
    return {
        "late_frames": counts.late,
        "revised_events": counts.revised,
        "latency_ms": counts.latency.percentiles_ms(),
        "processor_ms": counts.processor.percentiles_ms(),
    }


def _write_files(loaded: LoadedConfig, recording: Path, outputs: LiveOutputs) -> None:
    """Turn the recording into a log, and track it as a batch run does."""
    from stereophd.commands.track import CAMERAS_FILE, track

    assert outputs.folder is not None
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / LOG_FILE
        write_log(loaded, recording, log)
        track(loaded, log, outputs.folder, force=outputs.force)
        if any(camera.poses for camera in loaded.cameras.values()):
            write_cameras(outputs.folder / CAMERAS_FILE, loaded.cameras, loaded.config.units.length)
        # after the other files: the log lies beside them, and is no output of `track`
        with open(log, "rb") as content, open(outputs.folder / LOG_FILE, "wb") as target:
            target.write(content.read())
