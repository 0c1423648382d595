"""Rolling shutter, from simulation to tracks: where a fast object is seen, and that its track is not led astray."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereophd.commands.check import check
from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_cameras, load_config
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.errors import InputError
from tests.core.simulation.scenes import camera, frames_of, moving_object, scene

pytestmark = pytest.mark.usefixtures("without_checks")

READOUT_S = 0.03

# Three cameras about a volume through which objects fly at some 10 m/s: 300 px/s and more, 5 px in half a readout.
SCENE = f"""
units: {{length: m}}
cameras:
  south:
    image_size_px: [1920, 1080]
    intrinsics: {{fx: 1000.0, fy: 1000.0, cx: 959.5, cy: 539.5}}
    pose: {{center: [0.0, 0.0, -35.0]}}
    detector: {{sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 0.5}}
    frame_rate_hz: 25.0
    readout_s: {READOUT_S}
  east:
    image_size_px: [1920, 1080]
    intrinsics: {{fx: 1000.0, fy: 1000.0, cx: 959.5, cy: 539.5}}
    pose: {{center: [35.0, 0.0, 0.0], rotation_vector_deg: [0, 90, 0]}}
    detector: {{sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 0.5}}
    frame_rate_hz: 30.0
    phase_s: 0.007
    readout_s: {READOUT_S}
  west:
    image_size_px: [1920, 1080]
    intrinsics: {{fx: 1000.0, fy: 1000.0, cx: 959.5, cy: 539.5}}
    pose: {{center: [-35.0, 0.0, 0.0], rotation_vector_deg: [0, -90, 0]}}
    detector: {{sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 0.5}}
    distortion: {{model: radial, k1: -0.05}}
    frame_rate_hz: 20.0
    readout_s: -{READOUT_S}
motion: {{acceleration_std: 1.0, max_speed: 40.0}}
filter:
  kind: pmb
  birth: {{depth_range: [15.0, 60.0], velocity_std: 8.0}}
simulate:
  duration_s: 2.0
  acceleration_std: 1.0
  objects:
    count: 2
    box: {{x: [-6.0, 6.0], y: [-4.0, 4.0], z: [-6.0, 6.0]}}
    velocity_std: 6.0
    stay_in_view: any
"""


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("lens", [None, Lens("radial", k1=-0.1)])
@pytest.mark.parametrize("readout_s", [READOUT_S, -0.05])
def test_a_pixel_is_where_the_object_was_when_its_row_was_read(
    lens: Lens | None, readout_s: float, moving: bool
) -> None:
    rates = ((3.0, 3.0, 1.0), (0.4, 0.3, -0.4)) if moving else ()
    made = replace(camera("camera", (0.0, 0.0, 0.0), 1e-9, 1.0, 0.0, *rates, lens=lens), readout_s=readout_s)
    velocity = np.array([6.0, 4.0, 3.0])
    position = np.array([-4.0, -3.0, 12.0])
    frames = frames_of(scene([made], [moving_object(tuple(position), tuple(velocity))], duration_s=1.5))
    pixels = np.array([frame.pixels[0] for frame in frames])
    times = np.array([frame.log_time_s for frame in frames])
    assert len(frames) == 15
    read_s = times + readout_s * pixels[:, 1] / made.height
    expected = [made.at(t).project(position[None] + t * velocity)[0] for t in read_s.tolist()]
    np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-6)
    # and neither where it was at the time of the frame, nor where the camera was
    for t, at in ((times, times), (read_s, times)) if moving else ((times, times),):
        seen = [made.at(b).project(position[None] + a * velocity)[0] for a, b in zip(t, at, strict=True)]
        assert np.abs(pixels - seen).max() > 3.0


def test_what_keeps_pace_with_the_readout_is_not_seen() -> None:
    """An object that moves down as fast as the rows are read: no single row reads it."""
    made = replace(camera(), readout_s=0.1)
    # 480 rows in 0.1 s at fy 510, depth 10: 94.1 length/s
    objects = [moving_object((0.0, -4.0, 10.0), (0.0, 4800.0 / 510.0 * 10.0, 0.0), death_s=0.05)]
    assert all(len(frame.pixels) == 0 for frame in frames_of(scene([made], objects, duration_s=0.1)))


def test_tracks_of_fast_objects(tmp_path: Path) -> None:
    """Without the readout every camera sees the object elsewhere than it was: 15 ms at some 10 m/s, 0.15 m.

    Six runs of two objects, two of them without it too. With it the errors are those of the noise (0.03 m) and the
    NEES that of a consistent filter: 3. The means of single runs deviate by 0.43, so five standard errors of the mean
    of six are 0.88.
    """
    config = tmp_path / "scene.yaml"
    config.write_text(SCENE)
    figures: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for seed in range(1, 7):
        loaded = load_config(config, seed=seed)
        simulate(loaded, tmp_path / f"log{seed}")
        for known in (True, False) if seed <= 2 else (True,):
            off = () if known else tuple(f"cameras.{name}.readout_s=0.0" for name in NAMES)
            out = tmp_path / f"out{seed}-{known}"
            track(load_config(config, off, seed), tmp_path / f"log{seed}" / "detections.parquet", out)
            report = evaluate(out / "tracks.parquet", tmp_path / f"log{seed}" / "truth.parquet", cutoff=2.0, from_s=0.5)
            figures[known].append((report["position_error"]["median"], report["nees"]["position"]))
    with_it, without = np.mean(figures[True], axis=0), np.mean(figures[False], axis=0)
    assert with_it[0] < 0.04
    assert abs(with_it[1] - 3.0) < 0.88
    assert without[0] > 3.0 * with_it[0]
    assert without[1] > 10.0


# Some 10 px of turn and 4 px of way in a readout. The third camera rides on a body of known trajectory.
STEADY = (
    "cameras.south.pose.velocity=[5.0, 1.0, 2.0]",
    "cameras.south.pose.rotation_rate_deg_s=[5.0, 20.0, 10.0]",
    "cameras.south.pose.time_s=1.0",
    "cameras.east.pose.velocity=[0.0, 2.0, 6.0]",
    "cameras.east.pose.rotation_rate_deg_s=[-10.0, -20.0, 30.0]",
    "cameras.east.pose.time_s=1.0",
)
NAMES = ("south", "east", "west")


def moving(folder: Path, from_s: float = -0.1) -> tuple[str, ...]:
    """Write the trajectory of a body at 7 m/s and 26 degrees a second; return overrides of cameras that move."""
    start = Pose(rotation_from_vector([0.0, -np.pi / 2, 0.0]), [-35.0, 0.0, 0.0], (4, -2, 5), (0.14, 0.26, 0.35), 1.0)
    rows = []
    for time_s in np.linspace(from_s, 2.1, 60).tolist():
        pose = start.at(time_s)
        half = 0.5 * rotation_to_vector(pose.rotation.T)
        angle = float(np.linalg.norm(half))
        rows.append([time_s, *pose.center, *(np.sin(angle) / angle * half), np.cos(angle)])
    np.savetxt(folder / "west.txt", rows)
    return (*STEADY, f"cameras.west.pose={{trajectory: {folder / 'west.txt'}}}")


def test_tracks_of_cameras_that_move_while_they_read(tmp_path: Path) -> None:
    """The same with cameras that fly and turn: poses of the frames for those of the rows would cost ten times more.

    Over 20 runs the NEES was 3.08 with a standard error of 0.09, and 3.01 with the cameras at rest.
    """
    config = tmp_path / "scene.yaml"
    config.write_text(SCENE)
    overrides = moving(tmp_path)
    figures: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for seed in range(1, 7):
        log = tmp_path / f"log{seed}"
        simulate(load_config(config, overrides, seed), log)
        for known in (True, False) if seed <= 2 else (True,):
            off = () if known else tuple(f"cameras.{name}.readout_s=0.0" for name in NAMES)
            out = tmp_path / f"out{seed}-{known}"
            track(load_config(config, (*overrides, *off), seed), log / "detections.parquet", out)
            report = evaluate(out / "tracks.parquet", log / "truth.parquet", cutoff=2.0, from_s=0.5)
            figures[known].append((report["position_error"]["median"], report["nees"]["position"]))
    with_it, without = np.mean(figures[True], axis=0), np.mean(figures[False], axis=0)
    assert with_it[0] < 0.045
    assert abs(with_it[1] - 3.0) < 0.88
    assert without[0] > 5.0 * with_it[0]
    assert without[1] > 20.0


def test_a_trajectory_covers_the_rows_of_the_last_frame(tmp_path: Path) -> None:
    """The third camera reads from the bottom up: its first frame, at 0 s, ends with row 0 and began 30 ms before."""
    config = tmp_path / "scene.yaml"
    config.write_text(SCENE)
    simulate(load_config(config, moving(tmp_path)), tmp_path / "log")
    overrides = moving(tmp_path, -0.01)
    with pytest.raises(InputError, match=r"cameras\.west\.pose\.trajectory: expected poses that cover the frames"):
        simulate(load_config(config, overrides), tmp_path / "other")
    with pytest.raises(InputError, match=r"camera west, frame 0: .* found 0 s and rows from -0\.03 to 0 s after it"):
        track(load_config(config, overrides), tmp_path / "log" / "detections.parquet", tmp_path / "out")


def test_checks_take_rows_for_rows_and_not_for_wrong_clocks(tmp_path: Path) -> None:
    """By the times of the frames the third camera, which reads the other way, was said to be 13 to 38 ms off."""
    config = tmp_path / "scene.yaml"
    config.write_text(SCENE)
    named = 0
    for seed in (1, 3, 4, 5, 6, 7):
        simulate(load_config(config, seed=seed), tmp_path / f"log{seed}")
        report = check(load_config(config, seed=seed), tmp_path / f"log{seed}" / "detections.parquet")
        rays = [one for one in report["checks"] if one["name"].startswith("geometry")]
        assert {one["status"] for one in rays} == {"ok"}, (seed, rays)
        wrong = [f"cameras.{name}.readout_s=0.0" for name in NAMES]
        report = check(load_config(config, wrong, seed), tmp_path / f"log{seed}" / "detections.parquet")
        named += any(one["cause"] == "clock_offset" for one in report["checks"])
    assert named >= 4  # of these, two logs have too few tracks that decide


def test_readout_in_files(tmp_path: Path) -> None:
    config = tmp_path / "scene.yaml"
    config.write_text(SCENE)
    simulate(load_config(config), tmp_path / "log")
    cameras = load_cameras(tmp_path / "log" / "cameras.yaml").cameras
    assert [cameras[name].build(name).readout_s for name in cameras] == [READOUT_S, READOUT_S, -READOUT_S]
