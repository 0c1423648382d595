"""When estimates are reported: after events, after the frames of one camera, on a grid; and whose detections."""

from __future__ import annotations

from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.trajectories.smoothing import Trajectory, smooth
from stereophd.errors import InputError
from stereophd.pipeline.tracking.loop import Attribution, grid_times
from tests.commands.test_track import SCAN_COLUMNS, SCENE, TRACK_COLUMNS, assert_columns
from tests.core.trajectories.test_smoothing import batch, filtered, simulated

pytestmark = pytest.mark.usefixtures("without_checks")

STEP_S = 0.15
GRID = f"report.times=grid {STEP_S}"
# the cameras share neither rate nor phase; both see all objects; the truth is written at the times of the grid
OVERRIDES = (
    "cameras.left.frame_rate_hz=3.1",
    "cameras.left.phase_s=0.13",
    "filter.kind=pmb",
    "filter.extraction={confirm: 0.95, release: 0.01}",
    f"simulate.truth_rate_hz={1 / STEP_S}",
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One log tracked with every kind of report: the reports by name, and the folder of it all."""
    folder = tmp_path_factory.mktemp("reports")
    (folder / "scene.yaml").write_text(SCENE)
    simulate(load_config(folder / "scene.yaml", OVERRIDES), folder / "log")
    out: dict[str, Any] = {"folder": folder}
    for name, more in {
        "events": (),
        "camera": ("report.times=camera right",),
        "grid": (GRID,),
        "events smoothed": ("report.smooth={}",),
        "camera smoothed": ("report.smooth={}", "report.times=camera right"),
        "grid smoothed": ("report.smooth={}", GRID),
    }.items():
        loaded = load_config(folder / "scene.yaml", (*OVERRIDES, *more))
        out[name] = track(loaded, folder / "log" / "detections.parquet", folder / name)
    return out


def table(runs: dict[str, Any], name: str, kind: str = "tracks") -> dict[str, NDArray[Any]]:
    columns = assert_columns(
        runs["folder"] / name / f"{kind}.parquet", TRACK_COLUMNS if kind == "tracks" else SCAN_COLUMNS
    ).to_pydict()
    return {key: np.array(values) for key, values in columns.items()}


def rows_at(columns: dict[str, NDArray[Any]], time_s: float, track_id: int) -> NDArray[np.int64]:
    return np.flatnonzero((columns["time_s"] == time_s) & (columns["track_id"] == track_id))


@pytest.mark.parametrize("smoothed", ["", " smoothed"])
def test_after_the_frames_of_a_camera(runs: dict[str, Any], smoothed: str) -> None:
    """The same rows as after every event, but only those of the camera; scans add up what lies between."""
    events, camera = table(runs, "events" + smoothed), table(runs, "camera" + smoothed)
    mine = events["camera"] == "right"
    assert 0 < mine.sum() < len(mine)
    for key, values in camera.items():
        np.testing.assert_array_equal(values, events[key][mine])
    every, scans = table(runs, "events" + smoothed, "scans"), table(runs, "camera" + smoothed, "scans")
    last = np.flatnonzero(every["camera"] == "right")
    np.testing.assert_array_equal(scans["time_s"], every["time_s"][last])
    for key in ("n_detections", "log_likelihood"):
        np.testing.assert_allclose(np.cumsum(scans[key]), np.cumsum(every[key])[last], rtol=1e-12)
    report = runs["camera" + smoothed]
    assert report["events"] == len(every["time_s"])
    assert report["reports"] == len(scans["time_s"])
    assert report["log_likelihood"] == pytest.approx(every["log_likelihood"].sum(), rel=1e-12)


@pytest.mark.parametrize("smoothed", ["", " smoothed"])
def test_scans_on_a_grid(runs: dict[str, Any], smoothed: str) -> None:
    """A row at every multiple of the step between the first event and the last; its event is the one before."""
    scans, every = table(runs, "grid" + smoothed, "scans"), table(runs, "events" + smoothed, "scans")
    first, last = every["time_s"][0], every["time_s"][-1]
    expected = np.round(np.arange(np.ceil(first / STEP_S), np.floor(last / STEP_S) + 1) * STEP_S, 9)
    np.testing.assert_array_equal(scans["time_s"], expected)
    before = np.searchsorted(every["time_s"], scans["time_s"], side="right") - 1
    for key in ("camera", "frame", "n_components"):
        np.testing.assert_array_equal(scans[key], every[key][before])
    for key in ("n_detections", "log_likelihood"):
        np.testing.assert_allclose(np.cumsum(scans[key]), np.cumsum(every[key])[before], rtol=1e-12)
    elapsed = scans["time_s"] - every["time_s"][before]
    np.testing.assert_allclose(scans["cardinality_mean"], every["cardinality_mean"][before] * 0.99**elapsed)
    tracks = table(runs, "grid" + smoothed)
    confirmed = tracks["time_s"][tracks["status"] == "confirmed"]
    counts = [np.count_nonzero(confirmed == time_s) for time_s in scans["time_s"]]
    np.testing.assert_array_equal(scans["cardinality_estimate"], counts)
    assert max(counts) == 3


def test_estimates_on_a_grid_are_predicted_from_the_last_event(runs: dict[str, Any]) -> None:
    """By the motion model, in the mean, the covariance and existence; at an event's own time as after it.

    The moments are those of samples through the camera's geometry: 2 % of a standard deviation for the mean and
    2 % of the covariance, in its own metric, is what the curvature leaves once a track has settled.
    """
    events, grid = table(runs, "events"), table(runs, "grid")
    motion = ConstantVelocity([0.05] * 3)
    compared = ahead = 0
    for row in range(len(grid["time_s"])):
        time_s, track_id = grid["time_s"][row], grid["track_id"][row]
        mine = np.flatnonzero((events["track_id"] == track_id) & (events["time_s"] <= time_s))
        source = mine[-1]
        matrix, noise, _ = motion.transition(time_s - events["time_s"][source])
        state = np.array([events[key][source] for key in ("x", "y", "z", "vx", "vy", "vz")])
        found = np.array([grid[key][row] for key in ("x", "y", "z", "vx", "vy", "vz")])
        covariance = matrix @ events["covariance"][source].reshape(6, 6) @ matrix.T + noise
        elapsed = time_s - events["time_s"][source]
        assert grid["existence"][row] == pytest.approx(events["existence"][source] * 0.99**elapsed, rel=1e-9)
        if time_s < 5.0:
            continue
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        assert np.abs(whiten @ (found - matrix @ state)).max() < 0.02
        ratio = whiten @ grid["covariance"][row].reshape(6, 6) @ whiten.T
        np.testing.assert_allclose(ratio, np.eye(6), atol=0.02)
        compared += 1
        ahead += elapsed > 0.02
    assert compared > 200
    assert 50 < ahead < compared


def test_smoothed_estimates_on_a_grid(runs: dict[str, Any]) -> None:
    """Times of the grid change nothing at the events, and lie between them as the motion model says.

    The Gauss-Markov state at t between events a and b, given all data: x_t = F x_a + G (x_b - F_ab x_a) with the
    gain G of the predicted state; compared in standard deviations, as above.
    """
    events, grid = table(runs, "events smoothed"), table(runs, "grid smoothed")
    motion = ConstantVelocity([0.05] * 3)
    names = ("x", "y", "z", "vx", "vy", "vz")
    compared = 0
    for row in range(len(grid["time_s"])):
        time_s, track_id = grid["time_s"][row], grid["track_id"][row]
        mine = np.flatnonzero(events["track_id"] == track_id)
        after = mine[events["time_s"][mine] > time_s]
        before = mine[events["time_s"][mine] <= time_s]
        if time_s < 5.0 or not len(after) or not len(before):
            continue
        a, b = before[-1], after[0]
        state_a, state_b = (np.array([events[key][k] for key in names]) for k in (a, b))
        to_t, noise_t, _ = motion.transition(time_s - events["time_s"][a])
        onward, noise_b, _ = motion.transition(events["time_s"][b] - time_s)
        # bridge between two known states: mean and covariance of x_t given x_a and x_b
        gain = noise_t @ onward.T @ np.linalg.pinv(onward @ noise_t @ onward.T + noise_b)
        expected = to_t @ state_a + gain @ (state_b - onward @ to_t @ state_a)
        found = np.array([grid[key][row] for key in names])
        std = np.sqrt(np.diag(grid["covariance"][row].reshape(6, 6)))
        assert (np.abs(found - expected) / std).max() < 0.05
        neighbours = [np.sqrt(np.diag(events["covariance"][k].reshape(6, 6))) for k in (a, b)]
        assert (std[:3] < 1.1 * np.maximum(*neighbours)[:3]).all()
        compared += 1
    assert compared > 200


def test_times_without_a_measurement_are_smoothed_exactly() -> None:
    """Smoothed at times that only predict: the joint Gaussian of all states given all measurements."""
    rng = np.random.default_rng(3)
    times = np.array([0.0, 0.4, 0.5, 1.1, 1.9, 2.0])
    motion = ConstantVelocity([0.3, 0.1, 0.5])
    _, positions = simulated(times, rng)
    prior = np.diag([100.0] * 3 + [4.0] * 3)
    known = filtered(times, positions, prior)
    means, covariances = batch(times, positions, prior)
    inserted = {0.2: 0, 0.9: 2, 1.3: 3, 1.6: 3}
    nodes = [(times[k], known.states[k], known.covariances[k]) for k in range(len(times))]
    for time_s, k in inserted.items():
        matrix, noise, _ = motion.transition(time_s - times[k])
        nodes.append((time_s, matrix @ known.states[k], matrix @ known.covariances[k] @ matrix.T + noise))
    nodes.sort(key=lambda node: node[0])
    count = len(nodes)
    whole = Trajectory(
        0, np.arange(count), np.array([node[0] for node in nodes]), np.array([node[1] for node in nodes]),
        np.array([node[2] for node in nodes]), np.ones(count),
    )  # fmt: skip
    result = smooth(whole, motion)
    at_events = np.isin(result.times, times)
    np.testing.assert_allclose(result.states[at_events], means, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(result.covariances[at_events], covariances, rtol=1e-6, atol=1e-7)
    for time_s, k in inserted.items():
        # without the other inserted times: one prediction, one step back from the next event
        matrix, noise, _ = motion.transition(time_s - times[k])
        onward, noise_on, _ = motion.transition(times[k + 1] - time_s)
        covariance = matrix @ known.covariances[k] @ matrix.T + noise
        predicted = onward @ covariance @ onward.T + noise_on
        gain = covariance @ onward.T @ np.linalg.inv(predicted)
        mean = matrix @ known.states[k] + gain @ (means[k + 1] - onward @ matrix @ known.states[k])
        covariance = covariance + gain @ (covariances[k + 1] - predicted) @ gain.T
        found = int(np.flatnonzero(result.times == time_s)[0])
        np.testing.assert_allclose(result.states[found], mean, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(result.covariances[found], covariance, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("name", "limit"), [("grid", 0.35), ("grid smoothed", 0.25)])
def test_tracks_on_a_grid_are_scored(runs: dict[str, Any], name: str, limit: float) -> None:
    """The median error of the second half, 0.22 cm filtered and 0.15 cm smoothed, with a margin of a half.

    Scored at the truth's times, which are the grid's: had times or predictions been off by one event (0.16 s at
    1.7 cm/s) the error would be 0.3 cm larger.
    """
    folder = runs["folder"]
    report = evaluate(folder / name / "tracks.parquet", folder / "log" / "truth.parquet", cutoff=20.0, from_s=10.0)
    assert report["scans"]["not_scored"] == report["scans"]["outside_truth"]
    assert report["scans"]["scored"] > 60
    assert report["position_error"]["median"] < limit
    assert report["cardinality"]["mae"] < 0.05


def test_detections_of_each_track(runs: dict[str, Any]) -> None:
    """Counts by camera: those of the true object in the log; before confirmation too.

    A detection may be a neighbour's or clutter within the gate, and a missed frame may be filled by clutter: at
    3 false detections in 480000 px^2, gates of some hundred px^2, in under 1 % of the frames.
    """
    log = pq.read_table(runs["folder"] / "log" / "detections.parquet").to_pydict()
    true = {
        (camera, identity): sum(
            c == camera and o == identity for c, o in zip(log["camera"], log["object_id"], strict=True)
        )
        for camera in ("left", "right")
        for identity in range(3)
    }
    for name in ("events", "camera", "grid", "events smoothed", "grid smoothed"):
        rows = runs[name]["tracks"]
        for camera in ("left", "right"):
            assert [list(row["n_detections"]) for row in rows] == [["left", "right"]] * len(rows)
            found = sorted(row["n_detections"][camera] for row in rows)[-3:]
            expected = sorted(true[camera, identity] for identity in range(3))
            assert np.abs(np.subtract(found, expected)).max() <= 2


def test_detections_before_the_first_report_count() -> None:
    attribution = Attribution()

    def estimates(*pairs: tuple[int, int]) -> Estimates:
        tracks, labels = np.array([p[0] for p in pairs], dtype=int), np.array([p[1] for p in pairs], dtype=int)
        count = len(pairs)
        return Estimates(tracks, np.zeros((count, 6)), np.zeros((count, 6, 6)), np.ones(count), labels)

    assert attribution.update("a", [7, 8], estimates()) == {}
    assert attribution.update("b", np.array([7, 9]), estimates()) == {}
    assert attribution.update("a", np.array([7]), estimates((0, 7))) == {0: {"a": 2, "b": 1}}
    assert attribution.update("b", np.array([7]), estimates((0, 7))) == {0: {"b": 1}}
    assert attribution.update("b", np.array([8]), estimates((0, 7))) == {}
    # what became of the others does not matter once they are gone
    attribution.keep(np.array([9, 11]))
    assert attribution.update("b", np.array([8]), estimates((1, 8), (2, 9))) == {1: {"b": 1}, 2: {"b": 1}}


@pytest.mark.parametrize("step_s", [0.04, 1 / 3, 0.1, 7.0])
@pytest.mark.parametrize("start_s", [0.0, -3.21, 0.12, 1.7e9])
def test_a_grid_has_every_multiple_once(step_s: float, start_s: float) -> None:
    """Whatever intervals it is asked in, ends on the grid or not."""
    rng = np.random.default_rng(1)
    ends = start_s + np.cumsum(np.r_[0.0, rng.choice([0.0, step_s, 0.3 * step_s, 2.5 * step_s], 60)])
    pieces = [list(grid_times(step_s, a, b)) for a, b in pairwise(ends)]
    found = np.array(list(chain.from_iterable(pieces)))
    np.testing.assert_array_equal(found, list(grid_times(step_s, ends[0], ends[-1])))
    np.testing.assert_allclose(np.diff(found), step_s, rtol=0, atol=1e-6 if start_s > 1e9 else 2.1e-9)
    np.testing.assert_allclose(found / step_s, np.round(found / step_s), atol=1e-6)
    assert found[0] - step_s < ends[0] <= found[0]
    assert found[-1] < ends[-1] <= found[-1] + step_s * (1 + 1e-6)


TIMES_ERRORS = {
    '"camera lefft"': "expected one of the cameras left, right, found lefft; did you mean left?",
    "{camera: middle}": "expected one of the cameras left, right, found middle",
    "grid 0": "expected a grid of at least 1e-06 s, found 0",
    "{grid: -0.1}": "expected a grid of at least 1e-06 s, found -0.1",
    "grid soon": 'expected events, camera NAME or grid DT (in seconds), found "grid soon"',
    "{grid: 0.1, camera: left}": "expected events, camera NAME or grid DT (in seconds), found {",
    "frames": 'expected events, camera NAME or grid DT (in seconds), found "frames"',
    "7": "expected events, camera NAME or grid DT (in seconds), found 7",
}


@pytest.mark.parametrize("text", list(TIMES_ERRORS))
def test_times_that_cannot_be(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    with pytest.raises(InputError) as caught:
        load_config(path, [f"report.times={text}"])
    message = str(caught.value)
    assert f"report.times: {TIMES_ERRORS[text]}" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "resolved"),
    [
        ("events", "events"),
        ("camera left", {"camera": "left"}),
        ("{camera: left}", {"camera": "left"}),
        ("grid 0.25", {"grid": 0.25}),
        ("{grid: 2}", {"grid": 2.0}),
    ],
)
def test_times_in_both_forms(tmp_path: Path, text: str, resolved: Any) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    assert load_config(path, [f"report.times={text}"]).resolved["report"]["times"] == resolved
