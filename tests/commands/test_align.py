"""Cameras and tracks come into a world frame, with honest uncertainties, or it is said what is missing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd import Camera, Clock, InputError, read_cameras, write_cameras
from stereophd.commands.align import align
from stereophd.core.alignment.frames import floor_frame
from stereophd.core.alignment.to_points import ControlPoints, align_to_points
from stereophd.core.alignment.to_track import align_to_track
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.core.metrics.truth.registration import Freedom, TrackedPlaces
from stereophd.io.outputs.provenance import to_metadata
from stereophd.io.tables.schemas import TRACKS
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.control import local_places, read_control
from stereophd.report.camera_scores import alignments_text
from tests.scenes import build_camera

TURN, SCALE, MOVE = rotation_from_vector([0.3, -1.2, 2.0]), 12.3, np.array([100.0, -50.0, 20.0])
SHIFT, RATE = 47.3, 1.0005
TIMES = np.arange(0.0, 60.0, 0.1)


def wander(seed: int, times: np.ndarray) -> np.ndarray:
    """Return a curve of five random sines on each axis."""
    rng = np.random.default_rng(seed)
    frequency, phase, size = rng.uniform(0.01, 0.1, (5, 3)), rng.uniform(0.0, 6.28, (5, 3)), rng.normal(0, 4, (5, 3))
    return (size * np.sin(2.0 * np.pi * frequency * times[:, None, None] + phase)).sum(axis=1)


def in_world(path: np.ndarray) -> np.ndarray:
    return SCALE * path @ TURN.T + MOVE


def control_of(path: np.ndarray, times: np.ndarray, noise: float = 0.05) -> Truth:
    """Return a path as a control track in the world, on its own clock."""
    errors = np.random.default_rng(9).normal(0.0, noise, path.shape)
    return Truth(RATE * times + SHIFT, np.zeros(len(times), dtype=np.int64), in_world(path) + errors)


def tracks_of(*paths: np.ndarray, noise: float = 0.02) -> TrackedPlaces:
    """Return noisy positions of several objects, in order of time."""
    rng = np.random.default_rng(8)
    noisy = np.stack(paths, axis=1)
    ids = np.tile(np.arange(len(paths)), len(TIMES))
    places = (noisy + rng.normal(0.0, noise, noisy.shape)).reshape(-1, 3)
    return TrackedPlaces(np.repeat(TIMES, len(paths)), places, np.tile(noise**2 * np.eye(3), (len(places), 1, 1)), ids)


def test_the_track_the_similarity_and_the_clock_are_found() -> None:
    tracks = tracks_of(*(wander(seed, TIMES) for seed in range(4)))
    tracks.track_id[(tracks.track_id == 2) & (tracks.time_s > 35.0)] = 7  # the object was lost once
    at = np.arange(5.0, 50.0, 0.2)
    found = align_to_track(tracks, control_of(wander(2, at), at), Freedom(scale=True, clock=True))
    assert found.members.tolist() == [2, 7]
    errors = np.array(
        [
            *rotation_to_vector(found.registration.rotation @ TURN.T),
            np.log(found.registration.scale / SCALE),
            float(found.registration.times(np.array(30.0))) - (RATE * 30.0 + SHIFT),
            found.registration.rate - RATE,
        ]
    )
    assert (np.abs(errors) < 4.0 * found.std[[0, 1, 2, 6, 7, 8]]).all()
    assert (found.std[[0, 1, 2, 6, 7, 8]] < [2e-3, 2e-3, 2e-3, 1e-3, 5e-3, 2e-4]).all()


def test_places_that_one_camera_saw_hide_no_motion() -> None:
    tracks = tracks_of(wander(2, TIMES))
    lost = (tracks.time_s > 20.0) & (tracks.time_s < 32.0)  # far off in depth, and known to be so
    tracks.position[lost, 2] += 40.0
    tracks.covariance[lost, 2, 2] = 25.0
    kept = tracks.take((tracks.time_s < 32.0) | (tracks.time_s > 40.0))
    kept.track_id[kept.time_s > 40.0] = 1
    found = align_to_track(kept, control_of(wander(2, TIMES), TIMES), Freedom(scale=True, clock=True))
    assert found.members.tolist() == [0, 1]
    assert abs(np.log(found.registration.scale / SCALE)) < min(5.0 * found.std[6], 5e-3)
    assert abs(found.registration.rate - RATE) < min(5.0 * found.std[8], 1e-3)


STILL = np.zeros((len(TIMES), 3))
LINE = np.column_stack([10.0 * np.sin(TIMES / 5.0) + TIMES / 3.0, 0.0 * TIMES, 0.0 * TIMES])
CIRCLE = 5.0 * np.column_stack([np.cos(TIMES / 4.0), np.sin(TIMES / 4.0), 0.0 * TIMES])


@pytest.mark.parametrize(
    ("paths", "control", "expected"),
    [
        ([STILL], STILL, "no track has the motion of the control track"),
        ([LINE], LINE, "along one straight line"),
        ([CIRCLE], CIRCLE, "a clock offset of .* fits nearly as well"),
        ([wander(0, TIMES)], wander(5, TIMES), "no track has the motion|fits nearly as well|straight line"),
        ([wander(0, TIMES), wander(0, TIMES) + 9.0], wander(0, TIMES), "which of them it belongs to"),
    ],
    ids=["still", "straight line", "circle", "another object", "two alike"],
)
def test_what_the_motion_leaves_open_is_refused(paths: list[np.ndarray], control: np.ndarray, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        align_to_track(tracks_of(*paths), control_of(control[::4], TIMES[::4]), Freedom(scale=True, clock=True))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a folder with cameras and the tracks of two objects, in units of a baseline."""
    poses = {"a": ([0.1, 0.0, 0.0], [0.0, -9.0, -30.0]), "b": ([0.2, 0.3, 0.0], [9.0, -9.0, -30.0])}
    cameras = [
        build_camera(name, center, turn, focal=600.0, clock=Clock(0.4 * (name == "b"), 1.0))
        for name, (turn, center) in poses.items()
    ]  # fmt: skip
    (tmp_path / "run").mkdir()
    write_cameras(tmp_path / "run" / "cameras.yaml", cameras, "baseline")
    write_tracks(tmp_path / "run", tracks_of(wander(0, TIMES), wander(1, TIMES)))
    return tmp_path / "run"


def write_tracks(folder: Path, tracks: TrackedPlaces) -> None:
    times, covariance = tracks.time_s, np.zeros((len(tracks.time_s), 6, 6))
    covariance[:, :3, :3], covariance[:, 3:, 3:] = tracks.covariance, 4e-4 * np.eye(3)
    metadata = to_metadata({"units": {"length": "baseline"}})
    with TableWriter(folder / "tracks.parquet", TRACKS, metadata) as table:
        table.append(
            {
                "time_s": times, "camera": "a", "frame": np.round(10.0 * times).astype(int),
                "track_id": tracks.track_id, **dict(zip("xyz", tracks.position.T, strict=True)),
                "vx": 1.0, "vy": 0.0, "vz": 0.0,
                "covariance": covariance, "existence": 1.0, "status": "confirmed",
            }
        )  # fmt: skip


def write_control(path: Path, control: Truth) -> Path:
    columns = {"time_s": control.time_s, **dict(zip("xyz", control.position.T, strict=True))}
    pq.write_table(pa.table(columns), path)
    return path


def test_cameras_and_tables_are_moved(run: Path, tmp_path: Path) -> None:
    control = write_control(tmp_path / "gps.parquet", control_of(wander(1, TIMES), TIMES))
    (report,) = align([run], control, tmp_path / "out")["runs"]
    assert report["length_unit"] == "m"
    assert report["tracks"] == [1]
    assert report["scale"] == pytest.approx(SCALE, rel=1e-3)
    # a deviation stands beside the place that it is of: the origin of the tracks, far away, is known less well
    assert report["translation_std_at"] == pytest.approx(in_world(wander(1, TIMES)).mean(axis=0).tolist(), abs=0.1)
    assert "translation  [99.99, -50, 20] m\n  middle       [92.44" in alignments_text({"runs": [report]})
    points, at = wander(1, TIMES)[:20], 30.0
    for before, after in zip(
        read_cameras(run / "cameras.yaml"), read_cameras(tmp_path / "out/cameras.yaml"), strict=True
    ):
        seen, again = (
            camera.pose.to_camera(places) / scale
            for camera, places, scale in ((before, points, 1.0), (after, in_world(points), SCALE))
        )
        np.testing.assert_allclose(seen, again, atol=0.05)
        assert after.clock.to_true(at) == pytest.approx(RATE * before.clock.to_true(at) + SHIFT, abs=5e-3)
    table = pq.read_table(tmp_path / "out/tracks.parquet")
    assert table.schema.metadata[b"length_unit"] == b"m"
    np.testing.assert_allclose(np.asarray(table["time_s"]), np.repeat(RATE * TIMES + SHIFT, 2), atol=5e-3)
    places = np.column_stack([table[name] for name in "xyz"])[1::2]
    assert np.median(np.linalg.norm(places - in_world(wander(1, TIMES)), axis=1)) < 0.6
    first = np.asarray(table["covariance"].combine_chunks().flatten()[:36]).reshape(6, 6)
    np.testing.assert_allclose(np.diag(first)[:3], 4e-4 * SCALE**2, rtol=2e-3)
    np.testing.assert_allclose(np.diag(first)[3:], 4e-4 * SCALE**2, rtol=2e-3)


def floor_and_balls(kind: str) -> TrackedPlaces:
    """Return objects on an inclined floor, or that are thrown over and over, in a frame where down is not y."""
    tilt = rotation_from_vector([0.2, 0.0, 0.15])
    paths = []
    for seed in range(2):
        path = wander(seed, TIMES)
        phase = TIMES % 2.0
        path[:, 1] = 0.0 if kind == "floor" else 0.5 * (phase**2 - 2.0 * phase)
        if kind == "gravity":
            path[:, [0, 2]] = 0.3 * TIMES[:, None]
        paths.append(path @ tilt.T)
    return tracks_of(*paths, noise=1e-4)


@pytest.mark.parametrize(
    ("to", "expected", "scale"), [("floor", "down", 1.0), ("gravity", "down", 9.80665), ("b", "camera", 1.0)]
)
def test_frames_without_a_control_track(run: Path, tmp_path: Path, to: str, expected: str, scale: float) -> None:
    if to != "b":
        write_tracks(run, floor_and_balls(to))
    (report,) = align([run / "cameras.yaml"], to, tmp_path / "out")["runs"]
    first, second = read_cameras(tmp_path / "out" / "cameras.yaml")
    assert report["scale"] == pytest.approx(scale, rel=0.02)
    assert ("scale_is_unknown" in report) == (to != "gravity")
    if expected == "camera":
        np.testing.assert_allclose(second.pose.rotation, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(second.pose.center, 0.0, atol=1e-12)
        return
    places = np.column_stack([pq.read_table(tmp_path / "out" / "tracks.parquet")[name] for name in "xyz"])
    assert abs(first.pose.rotation[2] @ [1.0, 0.0, 0.0]) < 1e-9  # the first camera looks forward
    if to == "floor":
        assert np.abs(places[:, 1]).max() < 1e-3
        np.testing.assert_allclose(first.pose.center[[0, 2]], 0.0, atol=1e-9)
        assert first.pose.center[1] < 0.0
    else:
        rows = places[0::2][:19, 1]
        assert np.polyfit(TIMES[:19], rows, 2)[0] == pytest.approx(0.5 * 9.80665, rel=0.02)


def test_a_floor_is_known_as_well_as_objects_of_different_heights_show_it() -> None:
    """Players keep their heights: 20,000 estimates of eight of them stated the vertical to 0.004 degrees, and erred by
    0.01.

    The height of the floor was stated to 0.
    """
    pose, errors = Pose(rotation_from_vector([-0.5, 0.0, 0.0]), [0.0, -5.0, -10.0]), []
    for seed in range(30):
        rng, times = np.random.default_rng(seed), np.arange(0.0, 40.0, 0.1)
        paths = [np.column_stack([6.0 * np.sin(a * times + b), np.full(400, 0.1 * rng.normal()), 8.0 * np.sin(
                 c * times + d)]) for a, b, c, d in rng.uniform(0.1, 1.0, (8, 4)) * [1.0, 6.3, 1.0, 6.3]]  # fmt: skip
        tracks = TrackedPlaces(np.repeat(times, 8), np.stack(paths, axis=1).reshape(-1, 3),
                               np.tile(1e-4 * np.eye(3), (3200, 1, 1)), np.tile(np.arange(8), 400))  # fmt: skip
        found = floor_frame(tracks, pose)
        down = found.registration.rotation @ [0.0, 1.0, 0.0]
        height = found.registration.positions(np.array([tracks.position.mean(axis=0) * [1.0, 0.0, 1.0]]))[0, 1]
        errors.append([np.hypot(*down[[0, 2]]) / np.sqrt(2.0) / found.std[0], height / found.std[4]])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (rms > 0.2).all()
    assert (rms < 1.5).all()


@pytest.mark.parametrize(
    ("to", "words", "message"),
    [
        ("gps.csv", {}, "expected a control track .*, floor, gravity, or a camera .*, found gps.csv; there is no such"),
        ("floor", {"forward": "c"}, "`forward`: expected one of the cameras a, b"),
        ("floor", {}, "the objects are on no floor: they scatter 0.[0-9]+ times as much"),
        ("gravity", {}, "the tracks share no acceleration"),
        ("CONTROL", {"same_scale": True}, "`same_scale`: expected cameras in m"),
        ("BACKWARDS", {}, "row 1: expected times that increase"),
        ("SHORT", {}, "expected 6 or more rows, found 3"),
    ],
)
def test_unusable_requests_are_refused(run: Path, tmp_path: Path, to: str, words: dict, message: str) -> None:
    control = control_of(wander(1, TIMES), TIMES)
    tables = {
        "CONTROL": control,
        "BACKWARDS": Truth(control.time_s[::-1], control.object_id, control.position),
        "SHORT": Truth(control.time_s[:3], control.object_id[:3], control.position[:3]),
    }
    word = write_control(tmp_path / "control.parquet", tables[to]) if to in tables else to
    with pytest.raises(InputError, match=message):
        align([run], word, tmp_path / "out", **words)
    assert not (tmp_path / "out").exists()


def test_a_folder_without_cameras_names_what_is_needed(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected cameras.yaml in it; name a file of cameras"):
        align([tmp_path], "floor")


def test_geographic_places_are_metres_about_their_origin() -> None:
    origin = np.array([47.0, 8.0, 500.0])
    moves = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 10.0]])
    # metres of a thousandth of a degree at 47 degrees, from the radii of curvature of WGS 84
    expected = [[0.0, 0.0, 0.0], [0.0, 0.0, 111.18], [76.06, 0.0, 0.0], [0.0, -10.0, 0.0]]
    np.testing.assert_allclose(local_places(origin + moves, origin), expected, atol=0.02)


def write_points(path: Path, cameras: list[Camera], seed: int = 0, mistaken: bool = False) -> Path:
    """Write ten points on a plane as cameras see them, with their places in the world; the last has a height only."""
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(-8, 8, 10), np.zeros(10), rng.uniform(-8, 8, 10)])
    world, rows = in_world(places) + rng.normal(0.0, 0.01, places.shape), ["point,camera,u_px,v_px,x,y,z,std,sigma_px"]
    for camera in cameras:
        pixels = camera.project(places) + rng.normal(0.0, 0.5, (10, 2))
        for number, (pixel, place) in enumerate(zip(pixels, world, strict=True)):
            shown = pixels[3] if mistaken and number == 2 and camera is cameras[0] else pixel
            known = ["", "", f"{place[2]}"] if number == 9 else [f"{value}" for value in place]
            rows.append(",".join([f"p{number}", camera.name, *map(str, shown), *known, "0.01", "0.5"]))
    path.write_text("\n".join(rows))
    return path


def test_points_of_known_place_give_the_world_and_its_deviations(run: Path, tmp_path: Path) -> None:
    cameras = read_cameras(run / "cameras.yaml")
    squares = []
    for seed in range(12):
        points = read_control(write_points(tmp_path / "court.csv", cameras, seed), cameras)
        assert isinstance(points, ControlPoints)
        found = align_to_points(cameras, points, True)
        error = np.append(
            rotation_to_vector(TURN @ found.registration.rotation.T), np.log(SCALE) - np.log(found.registration.scale)
        )
        squares.append(error @ np.linalg.solve(found.covariance[np.ix_([0, 1, 2, 6], [0, 1, 2, 6])], error))
    # the sum is chi-squared of 48 degrees of freedom
    assert 26.0 < np.sum(squares) < 78.0
    (report,) = align([run], tmp_path / "court.csv", tmp_path / "out")["runs"]
    assert report["residual_px"]["median"] < 2.0
    assert report["tracks"] == []
    after = read_cameras(tmp_path / "out" / "cameras.yaml")[0].pose.center
    assert np.linalg.norm(after - in_world(cameras[0].pose.center)) < 0.02 * np.linalg.norm(after - MOVE)


def test_options_that_would_do_nothing_are_refused(run: Path, tmp_path: Path) -> None:
    points = write_points(tmp_path / "court.csv", read_cameras(run / "cameras.yaml"))
    for to, words in (
        (points, {"same_clock": True}),
        (points, {"forward": "a"}),
        ("a", {"same_scale": True}),
    ):
        with pytest.raises(InputError, match="does nothing"):
            align([run], to, tmp_path / "out", **words)


def test_a_mistaken_point_is_named(run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    align([run], write_points(tmp_path / "court.csv", read_cameras(run / "cameras.yaml"), mistaken=True))
    assert "point p2 in camera a" in caplog.text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace(",a,", ",c,"), "row 0: column camera: expected one of the cameras a, b, found c"),
        (lambda text: text.replace("u_px", "u"), "missing columns? time_s|expected .*time_s"),
        (lambda text: "\n".join(text.splitlines()[:3]), "expected 3 or more points"),
        (lambda text: text.replace(",1", ",9"), "another shape|open"),
        (lambda text: text.replace("0.5\n", "0\n"), "column sigma_px: expected a number"),
    ],
    ids=["camera", "column", "too few", "axes", "sigma"],
)
def test_unusable_points_are_refused(run: Path, tmp_path: Path, change: Callable[[str], str], message: str) -> None:
    path = write_points(tmp_path / "court.csv", read_cameras(run / "cameras.yaml"))
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=message):
        align([run], path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
