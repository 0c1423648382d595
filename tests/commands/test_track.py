"""`track` end to end: files and their schema, determinism, accuracy on simulated scenes and shared data."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import stereophd
from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import FILES, track
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.disparity import moments
from stereophd.errors import InputError
from tests.shared_data import shared_data

FLOATS, STRING, INTEGER = pa.float64(), pa.string(), pa.int64()
# design, section 3
TRACK_COLUMNS = {
    "time_s": FLOATS, "camera": STRING, "frame": INTEGER, "track_id": INTEGER,
    **dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), FLOATS), "covariance": "36 floats", "existence": FLOATS,
    "status": STRING,
}  # fmt: skip
SCAN_COLUMNS = {
    "time_s": FLOATS, "camera": STRING, "frame": INTEGER, "n_detections": INTEGER, "cardinality_mean": FLOATS,
    "cardinality_estimate": INTEGER, "log_likelihood": FLOATS, "n_components": INTEGER,
}  # fmt: skip

SCENE = """
units: {length: cm}
seed: 5
cameras:
  left:
    image_size_px: [800, 600]
    intrinsics: {fx: 900.0, fy: 890.0, cx: 400.0, cy: 300.0}
    pose: {center: [-20.0, 0.0, 0.0], rotation_vector_deg: [0.0, -10.0, 0.0]}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 3.0}
  right:
    image_size_px: [800, 600]
    intrinsics: {fx: 900.0, fy: 890.0, cx: 400.0, cy: 300.0}
    pose: {center: [20.0, 0.0, 0.0], rotation_vector_deg: [0.0, 10.0, 0.0]}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 3.0}
motion: {acceleration_std: 0.05, max_speed: 10.0}
filter:
  kind: phd
  birth: {disparity: {mean_px: 7.0, std_px: 2.5}, velocity_std: 1.5}
  extraction: {confirm: 0.5, release: 0.02}
simulate:
  duration_s: 20.0
  frame_rate_hz: 2.0
  acceleration_std: 0.05
  object_id: true
  objects:
    count: 3
    box: {x: [-20.0, 20.0], y: [-20.0, 20.0], z: [90.0, 180.0]}
    velocity_std: 1.0
"""

# one camera of its own rate, phase and clock, one that moves and has a lens, and a vertical companion
UNEVEN = (
    "cameras.left.frame_rate_hz=3.1",
    "cameras.left.phase_s=0.13",
    "cameras.left.clock={offset_s: 4.0, rate: 1.001}",
    "cameras.right.pose.velocity=[0.6, 0.0, -0.3]",
    "cameras.right.pose.rotation_rate_deg_s=[0.0, -0.2, 0.0]",
    "cameras.right.distortion={model: radial, k1: -0.1}",
    "disparity.rectification=vertical",
)
STATIC = (
    "motion.model=static",
    "motion.max_speed=null",
    "simulate.objects.velocity_std=0.0",
    "simulate.acceleration_std=0.0",
)
SPARSE = ("cameras.left.detector.clutter_per_frame=0.0", "cameras.right.detector.clutter_per_frame=0.0")
NOBODY = ("simulate.objects.count=0", "cameras.left.detector.clutter_per_frame=0.3")


@pytest.fixture
def config_path(tmp_path: Path) -> Path:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    return path


def made(config_path: Path, *overrides: str, seed: int | None = None) -> tuple[LoadedConfig, Path]:
    """A configuration and the folder of a log that was simulated with it."""
    loaded = load_config(config_path, overrides, seed)
    folder = config_path.parent / "log"
    simulate(loaded, folder)
    return loaded, folder


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def assert_columns(path: Path, expected: dict) -> pa.Table:
    table = pq.read_table(path)
    assert table.column_names == list(expected)
    for name, kind in expected.items():
        found = table.schema.field(name).type
        if kind == "36 floats":
            assert pa.types.is_fixed_size_list(found)
            assert (found.list_size, found.value_type) == (36, FLOATS)
        else:
            assert found == kind
    return table


def log_events(folder: Path) -> dict[tuple[str, int], int]:
    """Frames of a log with their numbers of detections."""
    log = pq.read_table(folder / "detections.parquet").to_pydict()
    events: dict[tuple[str, int], int] = {}
    for camera, frame, u in zip(log["camera"], log["frame"], log["u_px"], strict=True):
        events[camera, frame] = events.get((camera, frame), 0) + (u is not None)
    return events


def test_files_and_their_columns(config_path: Path, tmp_path: Path) -> None:
    loaded, folder = made(config_path)
    calls: list[tuple[int, int]] = []
    report = track(loaded, folder / "detections.parquet", tmp_path / "out", progress=lambda *a: calls.append(a))
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"tracks.parquet", "scans.parquet", "report.json"} < set(FILES)
    tracks = assert_columns(tmp_path / "out" / "tracks.parquet", TRACK_COLUMNS).to_pydict()
    scans = assert_columns(tmp_path / "out" / "scans.parquet", SCAN_COLUMNS).to_pydict()
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == report

    # one row an event, also of those without detections or estimates, in order of time and of the cameras
    events = log_events(folder)
    found = dict(zip(zip(scans["camera"], scans["frame"], strict=True), scans["n_detections"], strict=True))
    assert found == events
    assert scans["time_s"] == sorted(scans["time_s"])
    assert scans["camera"][:4] == ["left", "right"] * 2
    reported = dict.fromkeys(events, 0)
    for key in zip(tracks["camera"], tracks["frame"], strict=True):
        reported[key] += 1
    assert dict(zip(zip(scans["camera"], scans["frame"], strict=True), scans["cardinality_estimate"], strict=True)) == (
        reported
    )
    for name in ("cardinality_mean", "log_likelihood"):
        assert np.isfinite(scans[name]).all()
    assert min(scans["n_components"][5:]) >= 2

    # estimates: identities once an event and in order, covariances of full rank, weights from the threshold on
    keys = list(zip(tracks["time_s"], tracks["camera"], tracks["track_id"], strict=True))
    assert len(set(keys)) == len(keys)
    covariances = np.array(tracks["covariance"]).reshape(-1, 6, 6)
    np.testing.assert_array_equal(covariances, np.swapaxes(covariances, 1, 2))
    np.linalg.cholesky(covariances)
    assert min(tracks["existence"]) >= 0.02
    first = sorted(set(tracks["track_id"]), key=tracks["track_id"].index)
    assert first == list(range(len(first)))

    assert report["report_version"] == 1
    assert report["length_unit"] == "cm"
    assert report["events"] == len(events)
    assert report["estimates"] == len(keys)
    assert report["log_likelihood"] == pytest.approx(sum(scans["log_likelihood"]), rel=1e-12)
    assert [row["track_id"] for row in report["tracks"]] == sorted(set(tracks["track_id"]))
    for row in report["tracks"]:
        mine = [k for k, identity in enumerate(tracks["track_id"]) if identity == row["track_id"]]
        assert row["n_estimates"] == len(mine)
        assert (row["first_s"], row["last_s"]) == (tracks["time_s"][mine[0]], tracks["time_s"][mine[-1]])
        assert row["mean_existence"] == pytest.approx(np.mean([tracks["existence"][k] for k in mine]))
    rows = pq.read_metadata(folder / "detections.parquet").num_rows
    assert report["input"]["rows"] == rows
    assert calls[-1] == (rows, rows)
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)


@pytest.mark.usefixtures("without_checks")
def test_provenance(config_path: Path, tmp_path: Path) -> None:
    loaded, folder = made(config_path)
    report = track(loaded, folder / "detections.parquet", tmp_path / "out")
    expected = {
        "version": stereophd.__version__,
        "config_sha256": loaded.sha256,
        "seed": 5,
        "log": hashlib.sha256((folder / "detections.parquet").read_bytes()).hexdigest(),
    }
    for name in ("tracks.parquet", "scans.parquet"):
        metadata = pq.read_schema(tmp_path / "out" / name).metadata
        assert metadata[b"length_unit"] == b"cm"
        record = json.loads(metadata[b"stereophd"])
        assert record == report["provenance"]
        assert record["config"] == loaded.resolved
        assert record["config_sha256"] == expected["config_sha256"]
        assert record["seed"] == expected["seed"]
        assert record["command"] == "track"
        assert expected["version"] in record.values()
        assert expected["log"] in record["inputs"].values()
        assert str(tmp_path) not in json.dumps(record)


@pytest.mark.usefixtures("without_checks")
@pytest.mark.parametrize("overrides", [(), UNEVEN, STATIC], ids=["even", "uneven", "static"])
@pytest.mark.parametrize("method", ["qmc", "particle", "unscented", "linear"])
def test_same_bytes_again_and_with_two_threads(
    config_path: Path, tmp_path: Path, overrides: tuple[str, ...], method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded, folder = made(config_path, *overrides, f"moments.method={method}", "simulate.duration_s=8.0")
    log = folder / "detections.parquet"
    track(loaded, log, tmp_path / "one")
    # a thread takes part from that many sample trips on: low, so that it does so here
    monkeypatch.setattr(moments, "TRIPS_PER_THREAD", 100)
    track(loaded, log, tmp_path / "two", threads=2)
    assert digests(tmp_path / "one") == digests(tmp_path / "two")


@pytest.mark.usefixtures("without_checks")
def test_the_seed_draws_the_samples(config_path: Path, tmp_path: Path) -> None:
    loaded, folder = made(config_path, "simulate.duration_s=8.0")
    log = folder / "detections.parquet"
    track(loaded, log, tmp_path / "one")
    track(load_config(config_path, ("simulate.duration_s=8.0",), 6), log, tmp_path / "other")
    one, other = (pq.read_table(tmp_path / name / "scans.parquet").to_pydict() for name in ("one", "other"))
    assert one["log_likelihood"] != other["log_likelihood"]
    # another set of samples, but the same log: nearly the same likelihood
    np.testing.assert_allclose(sum(one["log_likelihood"]), sum(other["log_likelihood"]), rtol=0.02)


def score(folder: Path, log: Path, from_s: float) -> dict:
    return evaluate(folder / "tracks.parquet", log / "truth.parquet", order=2.0, cutoff=20.0, from_s=from_s)


@pytest.mark.usefixtures("without_checks")
@pytest.mark.parametrize(
    ("overrides", "limit"),
    [((), 2.5), (UNEVEN, 2.5), (STATIC, 2.0), (SPARSE, 2.0), (("moments.method=particle", "moments.samples=500"), 2.5)],
    ids=["even", "uneven", "static", "no clutter", "particles"],
)
def test_objects_are_tracked(config_path: Path, tmp_path: Path, overrides: tuple[str, ...], limit: float) -> None:
    """Mean OSPA (p 2, c 20 cm) of the second half, over three scenes: an eighth of the cutoff at most.

    One object of three lost or invented all the time would cost 11.5 cm, in a fifth of the frames 2.3.
    """
    scores = []
    for seed in (1, 2, 3):
        loaded = load_config(config_path, overrides, seed)
        log, out = tmp_path / f"log{seed}", tmp_path / f"out{seed}"
        simulate(loaded, log)
        track(loaded, log / "detections.parquet", out)
        report = score(out, log, 10.0)
        scores.append(report["ospa"]["mean"])
        assert report["position_error"]["median"] < 1.0
    assert np.mean(scores) < limit


@pytest.mark.usefixtures("without_checks")
def test_times_are_true_times(config_path: Path, tmp_path: Path) -> None:
    """The tracks are on the common clock: scans in order, and where the log's clocks differ, corrected."""
    loaded, folder = made(config_path, *UNEVEN)
    track(loaded, folder / "detections.parquet", tmp_path / "out")
    scans = pq.read_table(tmp_path / "out" / "scans.parquet").to_pydict()
    assert scans["time_s"] == sorted(scans["time_s"])
    for camera, rate, phase in (("left", 3.1, 0.13), ("right", 2.0, 0.0)):
        mine = [(f, t) for f, t, c in zip(scans["frame"], scans["time_s"], scans["camera"], strict=True) if c == camera]
        frames, times = map(np.array, zip(*mine, strict=True))
        assert frames.tolist() == list(range(len(frames)))
        np.testing.assert_allclose(times, phase + frames / rate, rtol=0, atol=1e-9)


@pytest.mark.usefixtures("without_checks")
def test_nobody_there(config_path: Path, tmp_path: Path) -> None:
    """Empty frames count: nothing is reported, and the likelihood is that of nearly no clutter."""
    loaded, folder = made(config_path, *NOBODY, "cameras.right.detector.clutter_per_frame=0.0")
    report = track(loaded, folder / "detections.parquet", tmp_path / "out")
    scans = pq.read_table(tmp_path / "out" / "scans.parquet").to_pydict()
    assert report["estimates"] == 0
    assert report["tracks"] == []
    assert len(pq.read_table(tmp_path / "out" / "tracks.parquet")) == 0
    assert 0 in scans["n_detections"]
    assert 1 in scans["n_detections"]
    empty = [
        value
        for value, count, camera in zip(scans["log_likelihood"], scans["n_detections"], scans["camera"], strict=True)
        if count == 0 and camera == "right"
    ]
    # no clutter, hardly any object, and few births
    assert -0.1 < empty[0] < 0.0
    assert max(scans["cardinality_mean"]) < 0.5


@pytest.mark.usefixtures("without_checks")
@pytest.mark.parametrize("kind", ["phd", "pmb"])
def test_a_false_detection_is_no_object_where_none_is_stated(config_path: Path, tmp_path: Path, kind: str) -> None:
    """With none at all, each was one for certain: a false detection in ten frames made most of the tracks."""
    _, folder = made(config_path, *NOBODY, "cameras.right.detector.clutter_per_frame=0.0")
    loaded = load_config(config_path, (*SPARSE, f"filter.kind={kind}", "filter.birth.per_s=0.001"))
    report = track(loaded, folder / "detections.parquet", tmp_path / "out")
    assert report["input"]["detections"] >= 3
    assert report["tracks"] == []


def test_no_filter_is_an_input_error(config_path: Path, tmp_path: Path) -> None:
    loaded, folder = made(config_path, "filter=null")
    with pytest.raises(InputError, match="filter"):
        track(loaded, folder / "detections.parquet", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("without_checks")
def test_outputs_are_replaced_only_by_force(config_path: Path, tmp_path: Path) -> None:
    loaded, folder = made(config_path, "simulate.duration_s=3.0")
    log = folder / "detections.parquet"
    track(loaded, log, tmp_path / "out")
    before = digests(tmp_path / "out")
    with pytest.raises(InputError, match="`force=True`"):
        track(loaded, log, tmp_path / "out")
    track(loaded, log, tmp_path / "out", force=True)
    assert digests(tmp_path / "out") == before


@pytest.mark.parametrize("scene", [1, 2])
def test_shared_scenes(scene: int, tmp_path: Path) -> None:
    """The paper's multi-object scene: mean OSPA (p 2, c 20 cm) from t = 50 at most 4.5 cm."""
    data = shared_data("scene", str(scene))
    config = Path(__file__).parents[2] / "configs" / "paper" / "multi_object.yaml"
    loaded = load_config(config, cameras_path=data / "cameras.yaml")
    track(loaded, data / "detections.parquet", tmp_path / "out")
    report = evaluate(tmp_path / "out" / "tracks.parquet", data / "truth.parquet", order=2.0, cutoff=20.0, from_s=50.0)
    assert report["scans"]["scored"] >= 49
    assert report["ospa"]["mean"] <= 4.5
