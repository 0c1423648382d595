"""Cameras on known trajectories: simulated and tracked from files alone, refused where the poses end too early."""

from pathlib import Path

import numpy as np
import pytest

from stereophd.commands.check import check
from stereophd.commands.evaluate import evaluate
from stereophd.commands.info import info
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_cameras, load_config
from stereophd.errors import InputError
from stereophd.io.cameras.writing import camera_config

CONFIG = """
units: {length: cm}
seed: 3
cameras:
  carried:
    image_size_px: [800, 600]
    intrinsics: {fx: 900.0, fy: 900.0, cx: 400.0, cy: 300.0}
    pose: {trajectory: poses.txt, mount: {center: [1.0, 0.5, 2.0], rotation_vector_deg: [1.0, 2.0, 0.0]}}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 1.0}
  right:
    image_size_px: [800, 600]
    intrinsics: {fx: 900.0, fy: 900.0, cx: 400.0, cy: 300.0}
    pose: {center: [20.0, 0.0, 0.0], rotation_vector_deg: [0.0, 12.0, 0.0]}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 1.0}
motion: {model: constant_velocity, acceleration_std: 0.01}
filter:
  kind: pmb
  birth: {per_s: 0.05, depth_range: [60, 300], velocity_std: 1.0}
simulate:
  duration_s: 20.0
  objects: {count: 2, box: {x: [-15, 15], y: [-15, 15], z: [100, 160]}, velocity_std: 0.5, stay_in_view: all}
"""


def write_set_up(folder: Path, last_s: float = 21.0) -> Path:
    """A configuration beside a trajectory that sways and turns."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time_s in np.arange(-1.0, last_s + 0.5, 0.5).tolist():
        half = 0.5 * (-0.2 + 0.1 * np.sin(time_s / 4.0))
        x, z = -20.0 + 5.0 * float(np.sin(time_s / 5.0)), 3.0 * float(np.cos(time_s / 3.0))
        lines.append(f"{time_s!r} {x!r} 0 {z!r} 0 {float(np.sin(half))!r} 0 {float(np.cos(half))!r}")
    (folder / "poses.txt").write_text("\n".join(lines))
    path = folder / "config.yaml"
    path.write_text(CONFIG)
    return path


def test_objects_are_tracked_by_a_camera_that_is_carried(tmp_path: Path) -> None:
    path = write_set_up(tmp_path)
    simulate(load_config(path), tmp_path / "scene")
    (tmp_path / "poses.txt").unlink()  # cameras.yaml holds the poses
    loaded = load_config(path, cameras_path=tmp_path / "scene" / "cameras.yaml")
    log = tmp_path / "scene" / "detections.parquet"
    report = track(loaded, log, tmp_path / "tracks")
    assert report["checks"]
    tracks, truth = tmp_path / "tracks" / "tracks.parquet", tmp_path / "scene" / "truth.parquet"
    scores = evaluate(tracks, truth, plots=False, from_s=10.0)
    assert scores["ospa"]["mean"] < 2.0
    summary = info(tmp_path / "scene" / "cameras.yaml")["cameras"]["carried"]
    assert summary["moves"]
    assert (summary["trajectory"]["first_s"], summary["trajectory"]["poses"]) == (-1.0, 45)


def test_a_camera_leads_back_to_its_configuration(tmp_path: Path) -> None:
    camera = load_config(write_set_up(tmp_path)).build_cameras()[0]
    assert camera_config(camera).build("carried").pose == camera.pose


def test_trajectories_that_end_too_early_are_refused(tmp_path: Path) -> None:
    path = write_set_up(tmp_path)
    simulate(load_config(path), tmp_path / "scene")
    write_set_up(tmp_path, last_s=12.0)
    short, log = load_config(path), tmp_path / "scene" / "detections.parquet"
    with pytest.raises(InputError, match=r"cameras.carried.pose.trajectory: expected poses that cover the frames"):
        simulate(short, tmp_path / "again")
    for command in (lambda: track(short, log, tmp_path / "tracks"), lambda: check(short, log)):
        with pytest.raises(InputError, match=r"camera carried, frame 13: expected a true time .* found 13 s"):
            command()
    assert not (tmp_path / "tracks").exists()


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ("{}", "expected center or trajectory, found neither"),
        ("{trajectory: poses.txt, center: [0, 0, 0]}", "expected only mount besides trajectory, found center"),
        ("{center: [0, 0, 0], mount: {center: [0, 0, 1]}}", "mount: expected a trajectory"),
        ("{trajectory: absent.txt}", r"cameras.carried.pose.trajectory: .*absent.txt: cannot be read"),
        ("{trajectory: {file: a, poses: AAAA}}", "expected"),
    ],
)
def test_forms_of_a_pose_exclude_one_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pose: str, message: str
) -> None:
    path = write_set_up(tmp_path)
    monkeypatch.chdir(tmp_path)  # the path of an override is relative to the current folder
    with pytest.raises(InputError, match=message):
        load_config(path, [f"cameras.carried.pose={pose}"])


def test_cameras_file_names_a_trajectory_beside_it(tmp_path: Path) -> None:
    write_set_up(tmp_path)
    cameras = CONFIG[CONFIG.index("cameras:") : CONFIG.index("motion:")]
    file = tmp_path / "cameras.yaml"
    file.write_text(f"units: {{length: cm}}\n{cameras}")
    assert load_cameras(file).cameras["carried"].pose.build().span == (-1.0, 21.0)
