"""A live run gives what a batch run gives, in whatever order the frames arrive."""

from __future__ import annotations

import io
import json
import random
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import stereophd.commands.track_live as commands
from stereophd.commands import recalibrate
from stereophd.commands.recalibrate import Recalibration
from stereophd.commands.track import track
from stereophd.commands.track_live import LiveOutputs, track_live
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.logs.reading import LogReader
from stereophd.io.streams.messages import Message
from stereophd.io.streams.rows import ROWS, ArrowRows, JsonLines, Publisher
from stereophd.io.streams.sources import from_stream
from stereophd.pipeline.live.frames import FrameChecks
from stereophd.pipeline.tracking import loop
from stereophd.pipeline.tracking.knocked import Knock, KnockTest
from stereophd.pipeline.workers.aside import Aside
from tests.conftest import leave_out_checks
from tests.scenes import build_camera

pytestmark = pytest.mark.usefixtures("without_checks")

HALL = Path(__file__).resolve().parents[3] / "sample_data"


@pytest.fixture(scope="module")
def loaded() -> LoadedConfig:
    return load_config(HALL / "hall.yaml", ["report.times=events"], cameras_path=HALL / "hall" / "cameras.yaml")


@pytest.fixture(scope="module")
def frames(loaded: LoadedConfig) -> list[Message]:
    cameras = loaded.build_cameras()
    log = LogReader(HALL / "hall" / "detections.parquet", cameras)
    return [Message(cameras[f.camera].name, f.frame, cameras[f.camera].clock.to_log(f.time_s), f.pixels) for f in log][
        :90
    ]


def shuffled(frames: Sequence[Message], delay_s: float) -> list[Message]:
    """Delay every frame by up to `delay_s`."""
    rng = random.Random(5)
    return [m for _, _, m in sorted((m.time_s + rng.uniform(0.0, delay_s), k, m) for k, m in enumerate(frames))]


def run(loaded: LoadedConfig, frames: Sequence[Message], out: Path | None = None) -> tuple[dict[str, Any], list[Any]]:
    lines = io.BytesIO()
    content = "".join(frame.to_line() + "\n" for frame in frames).encode()
    report = track_live(loaded, from_stream(io.BytesIO(content)), "frames", LiveOutputs([JsonLines(lines)], out))
    return report, [json.loads(line) for line in lines.getvalue().splitlines()]


# report, rows and files
Plain = tuple[dict[str, Any], list[Any], Path]


@pytest.fixture(scope="module")
def plain(loaded: LoadedConfig, frames: list[Message], tmp_path_factory: pytest.TempPathFactory) -> Plain:
    """A run in which no frame is late."""
    out = tmp_path_factory.mktemp("live") / "plain"
    with pytest.MonkeyPatch.context() as patch:
        leave_out_checks(patch)
        return *run(loaded, frames, out), out


def by_event(lines: Sequence[Any]) -> dict[tuple[str, int], Any]:
    """Return the last line of each event, without whether it was revised."""
    return {(line["camera"], line["frame"]): {**line, "revised": False} for line in lines}


def test_the_order_of_arrival_does_not_matter(
    loaded: LoadedConfig, frames: list[Message], plain: Plain, tmp_path: Path
) -> None:
    report, expected, out = plain
    assert report["late_frames"] == 0
    assert len(expected) == len(frames)
    late, lines = run(loaded, shuffled(frames, 0.5), tmp_path / "late")
    assert late["late_frames"] > 10
    assert late["revised_events"] == sum(line["revised"] for line in lines)
    assert by_event(lines) == by_event(expected)
    # the log that both wrote, and its tracks, are those of a batch run to the byte
    track(loaded, out / "detections.parquet", tmp_path / "batch")
    for name in ("tracks.parquet", "scans.parquet"):
        batch = (tmp_path / "batch" / name).read_bytes()
        assert batch == (out / name).read_bytes() == (tmp_path / "late" / name).read_bytes()


def test_a_stream_without_a_frame_is_refused(loaded: LoadedConfig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="frames: expected frames, found none"):
        run(loaded, [], tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("unit", "warned"), [(1.0, False), (1000.0, True)])
def test_times_in_milliseconds_are_told_at_once(
    loaded: LoadedConfig, frames: list[Message], unit: float, warned: bool, caplog: pytest.LogCaptureFixture
) -> None:
    checks = FrameChecks(loaded.build_cameras(), "error", 0.0)
    with caplog.at_level("WARNING", "stereophd"):
        for k, message in enumerate(frames[:40]):
            checks.frame(replace(message, time_s=unit * message.time_s), f"frame {k}")
    assert ("they seem to be in milliseconds" in caplog.text) == warned


@pytest.mark.parametrize("seconds", [5, 2])
def test_milliseconds_of_a_slow_camera_are_told_after_ten_frames_of_it(
    seconds: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Among twenty frames of two cameras with 60 and 4 Hz were too few of the slow one, and its times never judged."""
    fast, slow = (build_camera(name, [0, 0, 0], frame_rate_hz=rate) for name, rate in (("fast", 60.0), ("slow", 4.0)))
    messages = [Message("fast", k, k / 60.0, np.empty((0, 2))) for k in range(60 * seconds)]
    messages += [Message("slow", k, 250.0 * k, np.empty((0, 2))) for k in range(4 * seconds)]
    checks = FrameChecks((fast, slow), "error", 0.0)
    with caplog.at_level("WARNING", "stereophd"):
        for message in sorted(messages, key=lambda one: one.frame / (60.0 if one.camera == "fast" else 4.0)):
            checks.frame(message, "frame")
    told = [record.getMessage() for record in caplog.records]
    assert ["slow: " in one and "divide time_s by 1000" in one for one in told] == [True] * (seconds == 5)


def test_frames_that_wait_are_not_revised(loaded: LoadedConfig, frames: list[Message], plain: Plain) -> None:
    waiting = load_config(
        loaded.path, ["report.times=events", "live.wait_s=0.6"], cameras_path=HALL / "hall" / "cameras.yaml"
    )
    behind = next(iter(loaded.cameras))
    delayed = sorted(frames, key=lambda m: m.time_s + (0.5 if m.camera == behind else 0.0))
    assert run(loaded, delayed)[0]["late_frames"] > 10
    report, lines = run(waiting, delayed)
    assert report["late_frames"] == 0
    assert by_event(lines) == by_event(plain[1])


def test_a_frame_that_is_too_late_is_counted_or_refused(loaded: LoadedConfig, frames: list[Message]) -> None:
    late = [*frames[3:], frames[2]]
    with pytest.raises(InputError, match=r"frame 1 of camera .*: expected .* older than the newest \(live.span_s\)"):
        run(loaded, late)
    dropping = load_config(
        loaded.path,
        ["report.times=events", "input.on_bad_row=drop"],
        cameras_path=HALL / "hall" / "cameras.yaml",
    )
    report, lines = run(dropping, late)
    assert report["frames"]["too_late"] == 1
    assert by_event(lines) == by_event(run(loaded, frames[:2] + frames[3:])[1]) or len(lines) == len(late) - 1


def test_frames_of_one_time_come_in_any_order_however_rare_they_are(loaded: LoadedConfig) -> None:
    """Those of a time-lapse, 5 s apart, were refused as older than the newest by more than 2 s."""
    names = list(loaded.cameras)
    messages = [Message(name, k, 5.0 * k, np.array([[300.0, 200.0]])) for k in range(3) for name in reversed(names)]
    report, _ = run(loaded, messages)
    assert report["frames"]["frames"] == len(messages)
    assert report["frames"]["too_late"] == 0


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"camera": "none"}, "camera: expected one of"),
        ({"detections": [[-500.0, 5.0]]}, "expected a detection inside the"),
        ({"detections": [[5.0, 5.0], [5.0, 5.0]]}, "again|repeated|twice|duplicate"),
        ({"time_s": 1e300}, "time_s: expected a number between"),
    ],
)
def test_a_bad_frame_is_refused_with_its_place(
    change: dict[str, Any], expected: str, loaded: LoadedConfig, frames: list[Message]
) -> None:
    bad = json.dumps({**json.loads(frames[1].to_line()), **change})
    content = (frames[0].to_line() + "\n" + bad + "\n").encode()
    with pytest.raises(InputError, match=f"frames: frame .* of camera .*(message 2).*({expected})"):
        track_live(loaded, from_stream(io.BytesIO(content)), "frames", LiveOutputs())


def test_rows_of_a_grid_are_predicted_to_now(loaded: LoadedConfig, frames: list[Message]) -> None:
    gridded = load_config(loaded.path, ["report.times=grid 0.1"], cameras_path=HALL / "hall" / "cameras.yaml")
    lines, end_s = io.BytesIO(), max(frame.time_s for frame in frames[:60])

    def arrivals() -> Iterator[Message | None]:
        yield from (replace(frame, arrived_s=time.perf_counter()) for frame in frames[:60])
        before = len(lines.getvalue().splitlines())
        until_s = time.perf_counter() + 0.3
        while time.perf_counter() < until_s:
            yield None
        ahead = [json.loads(line)["time_s"] for line in lines.getvalue().splitlines()[before:]]
        assert any(end_s < time_s <= end_s + 0.4 for time_s in ahead)
        yield from (replace(frame, arrived_s=time.perf_counter()) for frame in frames[60:])

    track_live(gridded, arrivals(), "frames", LiveOutputs([JsonLines(lines)]))
    rows = [json.loads(line) for line in lines.getvalue().splitlines()]
    # what came early comes once more, and the last row of each time is that of a run that nobody waited for
    assert any(row["revised"] for row in rows if row["time_s"] > end_s)
    last = {row["time_s"]: row["tracks"] for row in rows}
    assert last == {row["time_s"]: row["tracks"] for row in run(gridded, frames)[1]}


def test_rows_with_a_lag_are_smoothed(loaded: LoadedConfig, frames: list[Message], plain: Plain) -> None:
    lagging = load_config(
        loaded.path, ["report.times=events", "report.lag_s=0.8"], cameras_path=HALL / "hall" / "cameras.yaml"
    )
    lines = io.BytesIO()

    def arrivals() -> Iterator[Message]:
        for frame in shuffled(frames, 0.1):
            yield frame
            for line in lines.getvalue().splitlines()[-1:]:
                assert json.loads(line)["time_s"] < frame.time_s - 0.6

    track_live(lagging, arrivals(), "frames", LiveOutputs([JsonLines(lines)]))
    rows = [json.loads(line) for line in lines.getvalue().splitlines()]
    at_once = plain[1]
    assert [(row["camera"], row["frame"]) for row in rows] == [(row["camera"], row["frame"]) for row in at_once]
    table = pq.read_table(HALL / "hall" / "truth.parquet")
    truth = np.stack([table[name].to_numpy() for name in ("time_s", "x", "y", "z")], axis=1)
    assert error_of(rows, truth) < 0.8 * error_of(at_once, truth)


def error_of(rows: Sequence[Any], truth: Array) -> float:
    """Return the median distance of confirmed positions to the nearest object."""
    out = []
    for row in rows:
        near = truth[abs(truth[:, 0] - row["time_s"]) < 0.03, 1:]
        places = [[one[axis] for axis in "xyz"] for one in row["tracks"] if one["status"] == "confirmed"]
        out += [np.linalg.norm(near - place, axis=1).min() for place in places if len(near)]
    return float(np.median(out))


def test_a_camera_that_stops_does_not_stop_the_others(loaded: LoadedConfig, frames: list[Message]) -> None:
    names = list(loaded.cameras)
    stopped = [m for m in frames if m.camera != names[1] or m.time_s < 1.0 or m.time_s > 2.0]
    waiting = load_config(
        loaded.path, ["report.times=events", "live.wait_s=0.2"], cameras_path=HALL / "hall" / "cameras.yaml"
    )
    _, lines = run(waiting, stopped)
    assert [(line["camera"], line["frame"]) for line in lines] == [(m.camera, m.frame) for m in stopped]


def test_what_needs_the_whole_log_is_refused(loaded: LoadedConfig) -> None:
    estimating = load_config(loaded.path, ["detector=estimate"], cameras_path=HALL / "hall" / "cameras.yaml")
    with pytest.raises(InputError, match="detector: expected the detectors of all cameras for a live run"):
        track_live(estimating, iter(()), "frames", LiveOutputs())


def test_a_recording_holds_what_was_used(loaded: LoadedConfig, frames: list[Message], tmp_path: Path) -> None:
    outputs = LiveOutputs(recording=tmp_path / "frames.jsonl")
    track_live(loaded, iter(frames), "frames", outputs)
    lines = (tmp_path / "frames.jsonl").read_text().splitlines()
    assert lines == [frame.to_line() for frame in frames]
    with pytest.raises(InputError, match="the file exists"):
        track_live(loaded, iter(frames), "frames", outputs)


def test_files_are_whole_at_checkpoints_and_a_killed_run_goes_on(
    loaded: LoadedConfig, frames: list[Message], plain: Plain, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """The work of a checkpoint is done in this process; whoever looks between two frames finds files of a batch run."""

    def start(self: Aside, work: Any) -> None:
        self._thread, self._outcome = threading.Thread(), work(None)

    monkeypatch.setattr(Aside, "start", start)
    monkeypatch.setattr(commands, "CHECKPOINT_EVERY_S", 0.0)
    monkeypatch.setattr(commands, "STATUS_EVERY_S", 0.0)
    out, events = tmp_path / "live", io.StringIO()

    def until_killed() -> Iterator[Message]:
        yield from frames[:20]
        assert (out / "report.json").exists()
        raise MemoryError

    with pytest.raises(MemoryError):
        track_live(loaded, until_killed(), "frames", LiveOutputs([JsonLines(io.BytesIO(), events)], out))
    told = [json.loads(line) for line in events.getvalue().splitlines()]
    assert {"event": "checkpoint", "frames": 1} in told
    track(loaded, out / "detections.parquet", tmp_path / "at checkpoint")
    for name in ("tracks.parquet", "scans.parquet"):
        assert (out / name).read_bytes() == (tmp_path / "at checkpoint" / name).read_bytes()
    recording = tmp_path / "live.frames.jsonl"
    assert len(recording.read_text().splitlines()) == 20
    with open(recording, "a") as stream:
        stream.write('{"camera": "half a li')
    with pytest.raises(InputError, match=r"live.frames.jsonl: the file exists; .*resume=True"):
        track_live(loaded, iter(frames[20:]), "frames", LiveOutputs(folder=out))
    monkeypatch.setattr(commands, "CHECKPOINT_EVERY_S", 60.0)
    track_live(loaded, iter(frames[20:]), "frames", LiveOutputs(folder=out, resume=True))
    for name in ("tracks.parquet", "scans.parquet", "detections.parquet"):
        assert (out / name).read_bytes() == (plain[2] / name).read_bytes()
    assert not recording.exists()


def test_a_knocked_camera_is_solved_anew(
    loaded: LoadedConfig, frames: list[Message], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Knock and calibration are given: the run passes the camera over, goes on, and keeps the pose."""
    name, at_s, back_s = next(iter(loaded.cameras)), 2.0, 3.0
    knock = Knock(name, at_s, at_s - 0.1, 1.0, (5.0, 0.0))
    found = {"center": [-4.0, -1.5, 0.1], "rotation_matrix": np.eye(3).tolist()}

    def look(test: Any, cameras: Any, event: Any, *rest: Any) -> Any:
        if event.time_s >= at_s and not test.is_over:
            return KnockTest(is_over=True), knock
        return test, None

    monkeypatch.setattr(loop, "look", look)
    monkeypatch.setattr(
        Recalibration, "step", lambda self, time_s: {"status": "determined", "pose": found} if time_s > back_s else None
    )
    recalibrating = load_config(
        loaded.path, ["report.times=events", "live.recalibrate=true"], cameras_path=HALL / "hall" / "cameras.yaml"
    )
    records, events = io.BytesIO(), io.StringIO()
    track_live(recalibrating, iter(frames), "frames", LiveOutputs([JsonLines(records, events)], tmp_path / "out"))
    lines = [json.loads(line) for line in records.getvalue().splitlines()]
    passed_over = [line["time_s"] for line in lines if line["camera"] == name and at_s < line["time_s"] <= back_s]
    assert passed_over == []
    assert any(line["camera"] == name and line["time_s"] > back_s + 0.2 for line in lines)
    told = [json.loads(line)["event"] for line in events.getvalue().splitlines()]
    assert told[:3] == ["ready", "knocked", "recalibrated"]
    cameras = load_config(loaded.path, cameras_path=tmp_path / "out" / "cameras.yaml").build_cameras()
    np.testing.assert_allclose(cameras[0].at(at_s).pose.center, found["center"])
    np.testing.assert_allclose(cameras[0].at(at_s - 0.2).pose.center, loaded.build_cameras()[0].pose.center)


@pytest.mark.parametrize("ending", ["no try began", "a try goes on", "a try fails", "a try succeeds"])
def test_the_end_of_the_stream_says_what_became_of_a_knocked_camera(
    loaded: LoadedConfig, frames: list[Message], monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    name = loaded.build_cameras()[0].name
    at_s = frames[30].time_s
    knock = Knock(name, at_s, at_s - 0.1, 1.0, (5.0, 0.0))
    outcomes = {
        "a try fails": ValueError("no"),
        "a try succeeds": {
            "status": "determined",
            "pose": {"center": [-4.0, -1.5, 0.1], "rotation_matrix": np.eye(3).tolist()},
        },
    }

    def look(test: Any, cameras: Any, event: Any, *rest: Any) -> Any:
        return (KnockTest(is_over=True), knock) if event.time_s >= at_s and not test.is_over else (test, None)

    def work(self: Aside, work: Any) -> None:  # ends after the stream, or when its process is killed
        if ending in outcomes:
            time.sleep(0.3)
            self._outcome = outcomes[ending]
        else:
            killed = threading.Event()
            self._worker = SimpleNamespace(kill=killed.set)  # type: ignore[assignment]
            killed.wait()

    monkeypatch.setattr(loop, "look", look)
    monkeypatch.setattr(Aside, "_do", work)
    monkeypatch.setattr(commands, "PATIENCE_S", 10.0 if ending in outcomes else 0.2)
    monkeypatch.setattr(recalibrate, "TRIES_S", (1e6,) if ending == "no try began" else (0.0,))
    recalibrating = load_config(
        loaded.path, ["report.times=events", "live.recalibrate=true"], cameras_path=HALL / "hall" / "cameras.yaml"
    )
    events = io.StringIO()
    track_live(recalibrating, iter(frames[:45]), "frames", LiveOutputs([JsonLines(io.BytesIO(), events)]))
    told = [json.loads(line) for line in events.getvalue().splitlines()]
    expected = {"a try fails": "failed: no", "a try succeeds": "determined"}.get(ending, commands.NOT_FINISHED)
    assert [each["status"] for each in told if each["event"] == "recalibrated"] == [expected]
    assert ("pose" in told[-1]) is (ending == "a try succeeds")


def test_rows_are_arrow_or_messages_as_well(loaded: LoadedConfig, frames: list[Message]) -> None:
    zmq = pytest.importorskip("zmq")
    lines, arrow = io.BytesIO(), io.BytesIO()
    publisher = Publisher("tcp://127.0.0.1:*")
    reader = zmq.Context.instance().socket(zmq.SUB)
    reader.subscribe("")
    reader.connect(publisher.address)
    reader.poll(100)  # a subscription takes a moment
    track_live(loaded, iter(frames[:40]), "frames", LiveOutputs([JsonLines(lines), ArrowRows(arrow), publisher]))
    documents = [json.loads(line) for line in lines.getvalue().splitlines()]
    rows = pa.ipc.open_stream(arrow.getvalue()).read_all().to_pylist()
    event = ("time_s", "camera", "frame", "revised")
    nothing = dict.fromkeys(ROWS.names)  # heights and widths of bodies
    assert rows == [nothing | {name: d[name] for name in event} | track for d in documents for track in d["tracks"]]
    messages = []
    while reader.poll(500):
        messages.append(json.loads(reader.recv()))
    assert [message for message in messages if "event" not in message] == documents
    assert messages[0]["event"] == "ready"
    reader.close(0)
