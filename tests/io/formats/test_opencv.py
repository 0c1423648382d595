"""OpenCV's calibrations: written by OpenCV itself where it can, by hand in the forms that people use."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereophd.config.loading import load_cameras
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.formats.opencv import read, recognises_cameras
from stereophd.io.interchange.base import ImportOptions, PerCamera
from stereophd.io.interchange.cameras import take_apart
from stereophd.io.interchange.registry import read_foreign

from .conftest import SIZES, assert_same_cameras, rig, round_trip

SIZE_OPTION = ImportOptions(image_sizes=PerCamera(SIZES))


def storage(path: Path, cameras: dict[str, CameraConfig], vector: bool = False) -> Path:
    """Write a file of cameras with OpenCV's own storage, one mapping each."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, config in cameras.items():
        parts = take_apart(name, config)
        file.startWriteStruct(name, cv2.FileNode_MAP)
        file.write("camera_matrix", parts.matrix)
        file.write("distortion_coefficients", parts.coefficients)
        if vector:
            file.write("rvec", cv2.Rodrigues(parts.rotation)[0])
        else:
            file.write("R", parts.rotation)
        file.write("tvec", parts.translation)
        file.write("image_width", parts.size[0])
        file.write("image_height", parts.size[1])
        file.endWriteStruct()
    file.release()
    return path


@pytest.mark.parametrize("name", ["rig.yml", "rig.xml", "rig.json"])
@pytest.mark.parametrize("vector", [False, True])
def test_what_opencv_writes_is_read(tmp_path: Path, name: str, vector: bool) -> None:
    path = storage(tmp_path / name, rig(), vector)
    assert recognises_cameras(path)
    recording = read([path], ImportOptions())
    assert_same_cameras(recording.cameras, rig())
    assert recording.length_unit == "m"
    assert recording.unit_is_assumed


@pytest.mark.parametrize("fisheye", [False, True])
def test_round_trip_is_exact_and_opencv_reads_it(tmp_path: Path, fisheye: bool) -> None:
    cameras = rig(fisheye)
    assert_same_cameras(round_trip("opencv", cameras, tmp_path, "out.yml"), cameras)
    file = cv2.FileStorage(str(tmp_path / "out.yml"), cv2.FILE_STORAGE_READ)
    node = file.getNode("right")
    np.testing.assert_array_equal(node.getNode("K").mat(), take_apart("right", cameras["right"]).matrix)
    assert node.getNode("image_width").real() == 800
    file.release()


def test_projection_agrees_with_opencv(tmp_path: Path) -> None:
    """The centre and the rotation mean the same: a point projects to OpenCV's pixel."""
    cameras = rig()
    path = storage(tmp_path / "rig.yml", cameras)
    points = np.random.default_rng(0).normal(0, 0.2, (20, 3))
    for name, config in read([path], ImportOptions()).cameras.items():
        parts = take_apart(name, cameras[name])
        expected, _ = cv2.projectPoints(
            points, cv2.Rodrigues(parts.rotation)[0], parts.translation, parts.matrix, parts.coefficients
        )
        camera = config.build(name)
        inside = camera.pose.to_camera(points)
        distorted, _ = camera.lens.distort(inside[:, :2] / inside[:, 2:])
        pixels = distorted * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        np.testing.assert_allclose(pixels, expected.reshape(-1, 2), atol=1e-9)


def test_npz_with_names_of_cameras_in_the_keys(tmp_path: Path) -> None:
    arrays = {}
    for name, config in rig().items():
        parts = take_apart(name, config)
        arrays |= {f"mtx_{name}": parts.matrix, f"dist_{name}": parts.coefficients[None, :5]}
        arrays |= {f"rvec_{name}": cv2.Rodrigues(parts.rotation)[0], f"tvec_{name}": parts.translation[:, None]}
    np.savez(tmp_path / "calibration.npz", **arrays)
    assert recognises_cameras(tmp_path / "calibration.npz")
    assert_same_cameras(read([tmp_path / "calibration.npz"], SIZE_OPTION).cameras, rig())


def test_a_stereo_pair_in_two_files(tmp_path: Path) -> None:
    """The names of OpenCV's stereo sample; its R1, R2 are rectifying rotations and no poses."""
    left, right = (take_apart(name, config) for name, config in rig().items())
    rotation = right.rotation @ left.rotation.T
    translation = right.translation - rotation @ left.translation
    document = {"M1": left.matrix, "D1": left.coefficients, "M2": right.matrix, "D2": right.coefficients}
    for name, values in {
        "intrinsics.yml": document,
        "extrinsics.yml": {"R": rotation, "T": translation, "R1": np.eye(3), "R2": np.eye(3), "Q": np.eye(4)},
    }.items():
        file = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        for key, value in values.items():
            file.write(key, value)
        file.release()
    sizes = ImportOptions(image_sizes=PerCamera({"1": SIZES["left"], "2": SIZES["right"]}))
    found = read([tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml"], sizes).cameras
    first, second = found["1"].build("1"), found["2"].build("2")
    np.testing.assert_allclose(first.pose.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(second.pose.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(second.pose.rotation @ -second.pose.center, translation, atol=1e-9)


def test_a_stereo_pair_as_json_is_recognised(tmp_path: Path) -> None:
    """R and T are of no camera alone; lists are nested as those of OpenCV's arrays."""
    left, right = (take_apart(name, config) for name, config in rig().items())
    rotation = right.rotation @ left.rotation.T
    document = {"M1": left.matrix, "D1": left.coefficients[None], "M2": right.matrix, "D2": right.coefficients[None]}
    document |= {"R": rotation, "T": (right.translation - rotation @ left.translation)[:, None]}
    path = tmp_path / "stereo.json"
    path.write_text(json.dumps({key: value.tolist() for key, value in document.items()}))
    assert recognises_cameras(path)
    path.write_text(json.dumps({"M1": left.matrix.tolist(), "M2": right.matrix.tolist()}))
    assert not recognises_cameras(path)


def test_json_of_plain_lists_a_file_a_camera(tmp_path: Path) -> None:
    paths = []
    for name, config in rig().items():
        parts = take_apart(name, config)
        values = {"K": parts.matrix, "dist": parts.coefficients, "R": parts.rotation, "t": parts.translation}
        paths.append(tmp_path / f"{name}.json")
        document = {key: value.tolist() for key, value in values.items()}
        paths[-1].write_text(json.dumps({**document, "image_size": list(parts.size)}))
        assert recognises_cameras(paths[-1])
    assert_same_cameras(read(paths, ImportOptions()).cameras, rig())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": None}, "expected a pose .* found its translation alone"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "determinant -1"),
        ({"dist": [0] * 8 + [0.1]}, "thin prisms"),
        ({"K": [[500, 2, 300], [0, 500, 200], [0, 0, 1]]}, "without skew"),
        ({"image_size": None}, "expected the size of the images"),
    ],
)
def test_what_cannot_be_held_is_refused_with_the_reason(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    values: dict[str, object] = {
        "K": [[500, 0, 300], [0, 500, 200], [0, 0, 1]],
        "dist": [0.1],
        "R": np.eye(3).tolist(),
        "t": [0, 0, 1],
        "image_size": [640, 480],
    }
    values = {key: value for key, value in {**values, **change}.items() if value is not None}
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(values))
    with pytest.raises(InputError, match=message):
        read([path], ImportOptions())


@pytest.mark.parametrize("board", [{}, {"rvecs": [[0, 0, 0]], "tvecs": [[0, 0, 1]]}])
def test_without_any_pose_they_are_unknown(tmp_path: Path, board: dict[str, object]) -> None:
    """As `calibrateCamera` returns them, with the poses of its board: `calibrate` finds those of the cameras."""
    values = {"K": [[500, 0, 300], [0, 510, 200], [0, 0, 1]], "D": [-0.1], "image_size": [640, 480], **board}
    (tmp_path / "left.json").write_text(json.dumps(values))
    recording = read([tmp_path / "left.json"], ImportOptions())
    camera = recording.cameras["left"]
    assert camera.pose.unknown
    assert (camera.build("left").fy, camera.build("left").lens.k1) == (510.0, -0.1)
    assert any("left: its pose is unknown" in text for text in recording.assumed)
    assert not any("poses map" in text for text in recording.assumed)
    told = read_foreign("opencv", [tmp_path / "left.json"], ImportOptions()).assumed
    assert any("pose is unknown" in text for text in told)
    assert not any("lengths are" in text for text in told)


def test_native_cameras_are_not_taken_for_opencv(tmp_path: Path) -> None:
    from stereophd.io.cameras.writing import write_cameras

    path = tmp_path / "cameras.yaml"
    write_cameras(path, rig(), "cm")
    assert not recognises_cameras(path)
    assert list(load_cameras(path).cameras) == ["left", "right"]
