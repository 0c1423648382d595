"""Every format of cameras: what it writes it reads again, and no other format takes the file for its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereophd.config.loading import load_config
from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.interchange.base import ImportOptions, PerCamera
from stereophd.io.interchange.registry import find, names, recognise_cameras, recognises

from .conftest import SIZES, assert_same_cameras, rig, round_trip

WRITERS = [name for name in names() if find(name).write_cameras is not None]
FILE_NAMES = {"opencv": "rig.yml", "anipose": "rig.toml", "kalibr": "rig.yaml", "colmap": "model", "dlt": "rig.csv"}
# What a format's lens holds; DLT holds none.
LENSES = {"kalibr": (-0.11, 0.02, 1e-3, -2e-3), "dlt": (0.0,)}


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    inside = camera.pose.to_camera(points)
    distorted, _ = camera.lens.distort(inside[:, :2] / inside[:, 2:])
    return distorted * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def test_every_format_has_a_title_and_does_something() -> None:
    for name in names():
        form = find(name)
        assert form.title
        assert form.read or form.write_tracks or form.write_cameras


def test_all_writers_are_tried() -> None:
    assert set(WRITERS) == set(FILE_NAMES)


@pytest.mark.parametrize("name", [name for name in WRITERS if name not in ("dlt", "kalibr")])
@pytest.mark.parametrize("fisheye", [False, True])
def test_round_trips_are_exact(name: str, fisheye: bool, tmp_path: Path) -> None:
    cameras = rig(fisheye)
    assert_same_cameras(round_trip(name, cameras, tmp_path, FILE_NAMES[name]), cameras)


@pytest.mark.parametrize("fisheye", [False, True])
def test_kalibr_keeps_the_cameras_relative_to_the_first(fisheye: bool, tmp_path: Path) -> None:
    cameras = rig(fisheye, (-0.11, 0.02, 1e-3, -2e-3))
    found = {name: config.build(name) for name, config in round_trip("kalibr", cameras, tmp_path, "rig.yaml").items()}
    given = {name: config.build(name) for name, config in cameras.items()}
    points = np.random.default_rng(0).normal(0, 0.2, (20, 3))
    in_first = given["left"].pose.to_camera(points)
    for name, camera in found.items():
        np.testing.assert_allclose(project(camera, in_first), project(given[name], points), atol=1e-9)


def test_dlt_projects_to_the_same_pixels_from_below(tmp_path: Path) -> None:
    cameras = rig(lens=(0.0,))
    target = tmp_path / "rig.csv"
    find("dlt").write_cameras(cameras, "m", target)  # type: ignore[misc]
    points = np.random.default_rng(0).normal(0, 0.2, (20, 3))
    table = np.loadtxt(target, delimiter=",")
    for column, (name, config) in zip(table.T, cameras.items(), strict=True):
        expected = project(config.build(name), points)
        below = points @ column[8:11] + 1
        u = (points @ column[:3] + column[3]) / below
        v = (points @ column[4:7] + column[7]) / below
        np.testing.assert_allclose(np.stack([u - 1, SIZES[name][1] - v], axis=1), expected, atol=1e-9)
    names_of = {"cam1": "left", "cam2": "right"}
    options = ImportOptions(image_sizes=PerCamera(SIZES), length_unit="m", rename=names_of)
    again = find("dlt").read([target], options).cameras  # type: ignore[misc]
    assert_same_cameras(again, cameras, atol=1e-8)


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_is_recognised_by_its_own_format_only(name: str, tmp_path: Path) -> None:
    target = tmp_path / FILE_NAMES[name]
    find(name).write_cameras(rig(lens=LENSES.get(name, (0.1,))), "m", target)  # type: ignore[misc]
    assert [other for other in names() if recognises(find(other), target)] == [name]


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "dlt"])
def test_cameras_of_a_configuration_may_be_a_foreign_file(name: str, tmp_path: Path) -> None:
    cameras = rig(lens=LENSES.get(name, (0.1,)))
    target = tmp_path / FILE_NAMES[name]
    find(name).write_cameras(cameras, "m", target)  # type: ignore[misc]
    config = tmp_path / "config.yaml"
    config.write_text(f"units: {{length: m}}\ncameras: {target.name}\n")
    loaded = load_config(config)
    assert list(loaded.cameras) == list(cameras)
    assert loaded.cameras["left"].detector.estimate
    assert load_config(config, cameras_path=target).cameras == loaded.cameras
    config.write_text("units: {length: cm}\n")
    if name == "colmap":
        # a reconstruction has no unit: it is taken for that of the configuration
        assert load_config(config, cameras_path=target).cameras == loaded.cameras
    else:
        with pytest.raises(InputError, match=r"units.length: expected cm as in .*, found m"):
            load_config(config, cameras_path=target)


def test_native_files_are_of_no_foreign_format(tmp_path: Path) -> None:
    write_cameras(tmp_path / "cameras.yaml", rig(), "m")
    assert recognise_cameras(tmp_path / "cameras.yaml") is None


def test_what_a_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    moving = {
        name: CameraConfig.model_validate({**config.model_dump(), "pose": {"center": [0, 0, 0], "velocity": [1, 0, 0]}})
        for name, config in rig().items()
    }
    for name in WRITERS:
        with pytest.raises(InputError, match="expected a camera at rest"):
            find(name).write_cameras(moving, "m", tmp_path / FILE_NAMES[name])  # type: ignore[misc]
    with pytest.raises(InputError, match="k1, k2, p1, p2"):
        find("kalibr").write_cameras(rig(), "m", tmp_path / "rig.yaml")  # type: ignore[misc]
