"""DLTdv, Argus, easyWand: files written as their programs write them, from cameras that are known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError
from stereophd.io.cameras.writing import cameras_text

from .conftest import SIZES, cameras_of, log_rows, rig

Import = Callable[..., tuple[dict[str, Any], Path]]
STATED = {"rates": 100.0, "image_sizes": {f"cam{k + 1}": size for k, size in enumerate(SIZES.values())}}
MIRROR = np.diag([1.0, 1.0, -1.0])


def cameras() -> list[Camera]:
    return [config.build(name) for name, config in rig(lens=(0.0,)).items()]


def from_below(camera: Camera) -> np.ndarray:
    """Return the projection (3, 4) to pixels that count from (1, 1) in the lower left."""
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    pose = np.column_stack([camera.pose.rotation, -camera.pose.rotation @ camera.pose.center])
    return np.array([[1.0, 0, 1], [0, -1, camera.height], [0, 0, 1]]) @ matrix @ pose


def write_coefficients(path: Path, projections: list[np.ndarray]) -> Path:
    np.savetxt(path, np.array([(p / p[2, 3]).ravel()[:11] for p in projections]).T, delimiter=",", fmt="%.17g")
    return path


def write_points(path: Path, pixels: np.ndarray, argus: bool = False) -> Path:
    """Write (frames, points, cameras, 2) as DLTdv or Argus do."""
    frames, points, count, _ = pixels.shape
    pattern = "Track {p}_cam_{c}_{a}" if argus else "pt{p}_cam{c}_{a}"
    names = [
        pattern.format(p=p + 1, c=c + 1, a=a if argus else a.upper())
        for p in range(points)
        for c in range(count)
        for a in "xy"
    ]
    rows = [",".join("NaN" if np.isnan(x) else repr(x) for x in row) for row in pixels.reshape(frames, -1).tolist()]
    path.write_text("\n".join([",".join(names), *rows]) + "\n")
    return path


def scene(mirror: bool = False, skew: float = 0.0) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Return world points (frames, points, 3), projections, and the pixels in them (frames, points, cameras, 2)."""
    points = np.random.default_rng(3).normal(0, 0.2, (6, 3, 3))
    projections = [from_below(camera) for camera in cameras()]
    if skew:
        projections = [np.array([[1, skew, 0], [0, 1, 0], [0, 0, 1.0]]) @ p for p in projections]
    if mirror:
        projections = [p @ np.diag([1.0, 1, -1, 1]) for p in projections]
        points = points @ MIRROR
    homogeneous = np.concatenate([points, np.ones((6, 3, 1))], axis=2)
    images = [homogeneous @ p.T for p in projections]
    return points, projections, np.stack([image[..., :2] / image[..., 2:] for image in images], axis=2)


def assert_cameras_see_the_points(out: Path, points: np.ndarray, missing: int = 0) -> None:
    """The imported cameras project the points to the imported pixels."""
    rows = log_rows(out / "detections.parquet")
    assert sum(row[3] is not None for row in rows) == 36 - missing
    for name, config in cameras_of(out).items():
        camera = config.build(name)
        inside = camera.pose.to_camera(points.reshape(-1, 3))
        assert (inside[:, 2] > 0).all()
        flat = inside[:, :2] / inside[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        expected = flat.reshape(6, 3, 2)
        for time, _, frame, u, v in (row for row in rows if row[1] == name and row[3] is not None):
            assert time == pytest.approx(frame / 100)
            assert np.abs(expected[frame] - [u, v]).max(axis=1).min() < 1e-7


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("argus", [False, True])
@pytest.mark.parametrize("skew", [0.0, 0.01])
def test_points_and_coefficients(tmp_path: Path, imported: Import, mirror: bool, argus: bool, skew: float) -> None:
    points, projections, pixels = scene(mirror, skew)
    pixels[2, 1, 0] = np.nan
    pixels[4, :, 1] = np.nan
    files = (
        write_points(tmp_path / "flight-xypts.csv", pixels, argus),
        write_coefficients(tmp_path / "dlt.csv", projections),
    )
    report, out = imported("dltdv", *files, **STATED)
    # a left-handed world comes back with its z axis reversed
    assert_cameras_see_the_points(out, points @ MIRROR if mirror else points, missing=4)
    assert any("left-handed" in sentence for sentence in report["assumed"]) == mirror
    assert any("skew" in sentence for sentence in report["assumed"]) == bool(skew)
    assert report["cameras"]["cam2"]["empty_frames"] == 1
    assert report["labels"]["0"] == ("Track 1" if argus else "pt1")


def test_rows_that_count_from_the_other_side_mirror_the_world(tmp_path: Path, imported: Import) -> None:
    """No ray shows it: the sentence says that it may be so, and which option would be right."""
    points, projections, pixels = scene()
    files = write_points(tmp_path / "xypts.csv", pixels), write_coefficients(tmp_path / "dlt.csv", projections)
    report, out = imported("dltdv", *files, **(STATED | {"rows_from": "top"}))
    assert_cameras_see_the_points(out, points @ MIRROR)
    assert any("(`rows_from` bottom)" in sentence for sentence in report["assumed"])


def test_sparse_points(tmp_path: Path, imported: Import) -> None:
    points, projections, pixels = scene()
    flat = pixels.reshape(6, -1)
    lines = [f"{i + 1}\t{j + 1}\t{flat[i, j]:.12f}" for j in range(flat.shape[1]) for i in range(6)]
    (tmp_path / "xypts.tsv").write_text("\n".join(["xypts", f"6\t{flat.shape[1]}\t{flat.size}", *lines]) + "\n")
    _, out = imported("dltdv", tmp_path / "xypts.tsv", write_coefficients(tmp_path / "dlt.csv", projections), **STATED)
    assert_cameras_see_the_points(out, points)


def distorted_scene(tmp_path: Path, focal: float) -> tuple[np.ndarray, np.ndarray, tuple[Path, Path, Path]]:
    """Write points seen through lenses, coefficients and a profile; returns the points, and their native pixels."""
    points, projections, pixels = scene()
    rows, native = [], []
    for k, camera in enumerate(cameras()):
        # the lens is stated in pixels from below, about a principal point and a focal length of its own
        center = np.array([camera.width / 2 + 3, camera.height / 2 - 2])
        k1, p1, p2 = -0.05, 2e-3, -1e-3
        x, y = np.moveaxis((pixels[:, :, k] - center) / focal, -1, 0)
        r = x * x + y * y
        xd = x * (1 + k1 * r) + 2 * p1 * x * y + p2 * (r + 2 * x * x)
        yd = y * (1 + k1 * r) + p1 * (r + 2 * y * y) + 2 * p2 * x * y
        pixels[:, :, k] = np.stack([xd, yd], axis=-1) * focal + center
        native.append(pixels[:, :, k] * [1, -1] + [-1, camera.height])
        rows.append([k + 1, focal, camera.width, camera.height, *center, 1, k1, 0, p1, p2, 0])
    np.savetxt(tmp_path / "profile.txt", rows, fmt="%.17g")
    files = write_points(tmp_path / "xypts.csv", pixels), write_coefficients(tmp_path / "dlt.csv", projections)
    return points, np.stack(native, axis=2), (*files, tmp_path / "profile.txt")


@pytest.mark.parametrize("focal", [505.0, 400.0])
def test_a_camera_profile_becomes_the_lens(tmp_path: Path, imported: Import, focal: float) -> None:
    points, native, sources = distorted_scene(tmp_path, focal)
    report, out = imported("dltdv", *sources, rates=100.0)
    assert not report["warnings"]
    rows = log_rows(out / "detections.parquet")
    for k, (name, config) in enumerate(cameras_of(out).items()):
        logged = np.array([row[3:] for row in rows if row[1] == name]).reshape(6, 3, 2)
        np.testing.assert_allclose(logged, native[:, :, k], atol=1e-9)
        seen = config.build(name).project(points.reshape(-1, 3)).reshape(6, 3, 2)
        assert np.abs(seen - native[:, :, k]).max() < 0.05
    assert any("residual" in sentence for sentence in report["assumed"])


def test_a_profile_alone_leaves_the_poses_unknown(tmp_path: Path, imported: Import) -> None:
    _, _, (points, _, profile) = distorted_scene(tmp_path, 505.0)
    report, out = imported("dltdv", points, profile, rates=100.0)
    assert any("unknown" in sentence for sentence in report["assumed"])
    assert all(config.pose.unknown and config.distortion.k1 == -0.05 for config in cameras_of(out).values())


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("mirror", [False, True])
def test_points_in_space_become_a_truth(tmp_path: Path, imported: Import, sparse: bool, mirror: bool) -> None:
    points, projections, pixels = scene(mirror)
    flat = points.reshape(6, -1)
    flat[2, 3:6] = np.nan
    truth = tmp_path / "flight-xyzpts.csv"
    names = ",".join(f"pt{k + 1}_{axis}" for k in range(3) for axis in "XYZ")
    np.savetxt(truth, flat, delimiter=",", header=names, comments="")
    if sparse:
        entries = [(i + 1, j + 1, flat[i, j]) for j in range(9) for i in range(6) if np.isfinite(flat[i, j])]
        truth.write_text(f"xyzpts\n6\t9\t{len(entries)}\n" + "".join(f"{i}\t{j}\t{v:.12f}\n" for i, j, v in entries))
    files = write_points(tmp_path / "xypts.csv", pixels), write_coefficients(tmp_path / "dlt.csv", projections)
    _, out = imported("dltdv", *files, truth=truth, **STATED)
    table = pq.read_table(out / "truth.parquet").to_pylist()
    assert len(table) == 17
    expected = points @ MIRROR if mirror else points
    for row in table:
        frame = round(row["time_s"] * 100)
        np.testing.assert_allclose([row[axis] for axis in "xyz"], expected[frame, row["object_id"]], atol=1e-9)


def test_what_is_missing_is_named(tmp_path: Path, imported: Import, caplog: pytest.LogCaptureFixture) -> None:
    _, projections, pixels = scene()
    points, coefficients = write_points(tmp_path / "p.csv", pixels), write_coefficients(tmp_path / "c.csv", projections)
    with pytest.raises(InputError, match="expected the size of the images"):
        imported("dltdv", points, coefficients, rates=100.0)
    with pytest.raises(InputError, match="expected times or `rates`"):
        imported("dltdv", points, coefficients, image_sizes=STATED["image_sizes"])
    one = write_coefficients(tmp_path / "one.csv", projections[:1])
    report, _ = imported("dltdv", points, one, rates=100.0, image_sizes=SIZES["left"], length_unit="m")
    assert report["warnings"] == ["p.csv, one.csv: cam2 and later have no calibration: their points are left out"]
    caplog.clear()
    with pytest.raises(InputError, match=r"expected one of the cameras cam1 of .*, found cam2"):
        imported("dltdv", points, one, rates=100.0, image_sizes=STATED["image_sizes"], length_unit="m")
    assert caplog.messages == report["warnings"]  # what explains the error
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="expected points"):
        imported("dltdv", tmp_path / "x.csv", rates=100.0)


def test_native_cameras_state_the_size_of_the_images(tmp_path: Path, imported: Import) -> None:
    """Rows count from the bottom: the points are the same with sizes from the file of cameras as with stated ones."""
    points = write_points(tmp_path / "xypts.csv", scene()[2])
    native = tmp_path / "guess.yaml"
    named = dict(zip(("cam1", "cam2", "cam3"), rig(lens=(0.0,)).values(), strict=False))
    native.write_text(cameras_text(named, "m"))
    expected = log_rows(imported("dltdv", points, **STATED)[1] / "detections.parquet")
    _, out = imported("dltdv", points, cameras=native, rates=100.0)
    assert log_rows(out / "detections.parquet") == expected
