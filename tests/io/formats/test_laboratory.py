"""Braid, flydra, OpenPTV and MyPTV: files written from cameras that are known."""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.optimize import minimize

from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError
from stereophd.io.interchange.cameras import take_apart
from stereophd.pipeline.batch.names import expand

from .conftest import assert_same_cameras, cameras_of, log_rows, rig

Import = Callable[..., tuple[dict[str, Any], Path]]
POINTS = np.random.default_rng(5).normal(0, 0.2, (4, 3))


def pinhole(camera: Camera, points: np.ndarray) -> np.ndarray:
    inside = camera.pose.to_camera(points)
    return inside[:, :2] / inside[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def calibration_xml(shift: float) -> str:
    """Write flydra's XML; the principal point of the lens differs from the projection's by `shift`."""
    elements = []
    for name, config in rig(lens=(-0.1, 0.02, 1e-3, -2e-3)).items():
        parts = take_apart(name, config)
        matrix = parts.matrix @ np.column_stack([parts.rotation, parts.translation]) * 0.7
        rows = "; ".join(" ".join(map(repr, row)) for row in matrix.tolist())
        k = parts.matrix
        lens = {"fc1": k[0, 0], "fc2": k[1, 1], "cc1": k[0, 2] + shift, "cc2": k[1, 2]}
        lens |= dict(zip(("k1", "k2", "p1", "p2"), parts.coefficients, strict=False))
        elements.append(
            f"<single_camera_calibration><cam_id>{name}</cam_id><calibration_matrix>{rows}</calibration_matrix>"
            f"<resolution>{parts.size[0]} {parts.size[1]}</resolution><non_linear_parameters>"
            + "".join(f"<{key}>{float(value)!r}</{key}>" for key, value in lens.items())
            + "</non_linear_parameters></single_camera_calibration>"
        )
    return f"<multi_camera_reconstructor>{''.join(elements)}</multi_camera_reconstructor>"


def write_braidz(path: Path, shift: float) -> Path:
    lines = ["camn,frame,timestamp,cam_received_timestamp,x,y,frame_pt_idx"]
    for camn, (_, config) in enumerate(rig(lens=(-0.1, 0.02, 1e-3, -2e-3)).items()):
        camera = config.build("c")
        flat = (pinhole(camera, POINTS) - [camera.cx + shift, camera.cy]) / [camera.fx, camera.fy]
        pixels = camera.lens.distort(flat)[0] * [camera.fx, camera.fy] + [camera.cx + shift, camera.cy]
        for frame, (u, v) in enumerate(pixels.tolist()):
            seen = f"{u!r},{v!r}" if (camn, frame) != (1, 2) else "nan,nan"
            lines.append(f"{camn},{frame + 100},{1.5e9 + frame / 4!r},{1.5e9 + frame / 4 + 0.01!r},{seen},0")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data2d_distorted.csv.gz", gzip.compress("\n".join(lines).encode()))
        archive.writestr("cam_info.csv.gz", gzip.compress(b"camn,cam_id\n0,left\n1,right\n"))
        archive.writestr("calibration.xml", calibration_xml(shift))
    return path


@pytest.mark.parametrize("shift", [0.0, 4.0])
def test_a_braidz_with_its_calibration(tmp_path: Path, imported: Import, shift: float) -> None:
    report, out = imported("braid", write_braidz(tmp_path / "fly.braidz", shift))
    rows = log_rows(out / "detections.parquet")
    assert [row[:3] for row in rows[:3]] == [(1.5e9, "left", 100), (1.5e9, "right", 100), (1.5e9 + 0.25, "left", 101)]
    assert [row[2] for row in rows if row[3] is None] == [102]
    cameras = cameras_of(out)
    if not shift:
        assert_same_cameras(cameras, rig(lens=(-0.1, 0.02, 1e-3, -2e-3)))
    for _, name, frame, u, v in (row for row in rows if row[3] is not None):
        camera = cameras[name].build(name)
        flat = camera.lens.undistort((np.array([[u, v]]) - [camera.cx, camera.cy]) / [camera.fx, camera.fy])[0]
        found = flat[0] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        np.testing.assert_allclose(found, pinhole(camera, POINTS)[frame - 100], atol=0.05 if shift else 1e-6)
    assert any("trigger" in sentence for sentence in report["assumed"])
    assert any("residual" in sentence for sentence in report["assumed"]) == bool(shift)


PIXEL = 0.01


def write_openptv(folder: Path, indices: str = "1 1 1", added: str = "-4e-5 1e-7 0 1e-4 -2e-4 1.002 0.001") -> Path:
    """Write a project of two cameras, and targets of the points as OpenPTV's own model projects them."""
    k1, k2, k3, p1, p2, scale, shear = map(float, added.split())
    names = []
    for k, (_, config) in enumerate(rig(lens=(0.0,)).items()):
        camera = config.build("c")
        # OpenPTV's camera axes: x right, y up, looking along -z; rotation from camera to world
        dm = (np.diag([1.0, -1, -1]) @ camera.pose.rotation).T
        xh, yh, cc = 0.12, -0.07, 5.1
        (folder / "cal").mkdir(exist_ok=True)
        (folder / "img").mkdir(exist_ok=True)
        matrix = "\n".join(" ".join(f"{x:.12f}" for x in row) for row in dm)
        center = " ".join(map(repr, camera.pose.center.tolist()))
        (folder / f"cal/cam{k}.ori").write_text(f"{center}\n0 0 0\n\n{matrix}\n\n{xh} {yh}\n{cc}\n\n0 0 1\n")
        (folder / f"cal/cam{k}.addpar").write_text(added)
        names += [f"img/cam{k}.1000{1}", f"cal/cam{k}"]
        for frame, point in enumerate(POINTS):
            a, b, c = (point - camera.pose.center) @ dm
            x, y = -cc * a / c + xh, -cc * b / c + yh
            r = x * x + y * y
            radial = 1 + k1 * r + k2 * r * r + k3 * r**3
            xd = x * radial + p1 * (r + 2 * x * x) + 2 * p2 * x * y
            yd = y * radial + p2 * (r + 2 * y * y) + 2 * p1 * x * y
            xd, yd = scale * xd - np.sin(shear) * yd, np.cos(shear) * yd
            u, v = xd / PIXEL + 640 / 2, 480 / 2 - yd / PIXEL
            text = f"1\n   0 {u:.10f} {v:.10f} 10 3 3 500 -1\n" if (k, frame) != (0, 1) else "0\n"
            (folder / f"img/cam{k}.1000{frame + 1}_targets").write_text(text)
    (folder / "parameters").mkdir(exist_ok=True)
    path = folder / "parameters" / "ptv.par"
    body = "\n".join(indices.split())
    path.write_text("2\n" + "\n".join(names) + f"\n1\n0\n1\n640\n480\n{PIXEL}\n{PIXEL}\n0\n{body}\n1\n")
    return path


def read_targets(path: Path) -> np.ndarray:
    return np.array([line.split()[1:3] for line in path.read_text().splitlines()[1:]], dtype=float)


@pytest.mark.parametrize("added", ["0 0 0 0 0 1 0", "-4e-5 1e-7 0 1e-4 -2e-4 1.002 0.001"])
def test_openptv_in_one_medium(tmp_path: Path, imported: Import, added: str) -> None:
    path = write_openptv(tmp_path, added=added)
    report, out = imported("openptv", path, rates=50.0)
    rows = log_rows(out / "detections.parquet")
    assert [row[1:3] for row in rows if row[3] is None] == [("cam1", 10002)]
    cameras = cameras_of(out)
    for time, name, frame, u, v in (row for row in rows if row[3] is not None):
        assert time == pytest.approx(frame / 50)
        target = read_targets(tmp_path / f"img/cam{int(name[3]) - 1}.{frame}_targets")[0]
        np.testing.assert_allclose([u, v], target - 0.5, atol=1e-9)
        expected = cameras[name].build(name).project(POINTS[[frame - 10001]])[0]
        np.testing.assert_allclose([u, v], expected, atol=1e-6 if added.startswith("0") else 0.2)
    assert report["length_unit"] == "mm"
    assert not report["models"]


THICKNESS, INDICES = 6.0, (1.0, 1.46, 1.33)
CORNERS = [(-160.0, -20.0, -560.0), (150.0, 30.0, -580.0)]


def through_glass(center: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the direction in which a camera sees a point behind glass: the light's fastest way (Fermat)."""
    surfaces = -125.0 - THICKNESS, -125.0

    def way(places: np.ndarray) -> float:
        a, b = np.append(places[:2], surfaces[0]), np.append(places[2:], surfaces[1])
        legs = (a - center, b - a, point - b)
        return float(sum(n * np.linalg.norm(leg) for n, leg in zip(INDICES, legs, strict=True)))

    parts = [(surface - center[2]) / (point[2] - center[2]) for surface in surfaces]
    start = np.concatenate([(center + part * (point - center))[:2] for part in parts])
    places = minimize(way, start, method="BFGS", options={"gtol": 1e-10}).x
    return np.append(places[:2], surfaces[0]) - center


def write_tank(folder: Path) -> np.ndarray:
    """Write a project of two cameras in air before a tank of water; returns points in it, targets and all."""
    points = np.random.default_rng(7).uniform([-35, -25, -18], [35, 25, 18], (5, 3))
    (folder / "cal").mkdir()
    (folder / "img").mkdir()
    (folder / "parameters").mkdir()
    for k, center in enumerate(map(np.array, CORNERS), start=1):
        forward = -center / np.linalg.norm(center)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        # OpenPTV's camera axes: x right, y up, looking along -z
        dm = np.column_stack([-right, np.cross(forward, right), -forward])
        matrix = "\n".join(" ".join(map(repr, row)) for row in dm.tolist())
        words = " ".join(map(repr, center.tolist()))
        (folder / f"cal/cam{k}.ori").write_text(f"{words}\n0 0 0\n\n{matrix}\n\n0 0\n70\n\n0 0 -125\n")
        for frame, point in enumerate(points):
            a, b, c = through_glass(center, point) @ dm
            u, v = -70 * a / c / 0.012 + 640, 512 + 70 * b / c / 0.012
            for number in (frame, 123456789):
                (folder / f"img/cam{k}.{number}_targets").write_text(f"1\n 0 {float(u)!r} {float(v)!r} 9 3 3 99 -1\n")
    names = "".join(f"img/cam{k}.0\ncal/cam{k}\n" for k in (1, 2))
    par = folder / "parameters"
    par.joinpath("ptv.par").write_text(f"2\n{names}1\n0\n1\n1280\n1024\n0.012\n0.012\n0\n1\n1.46\n1.33\n6\n")
    par.joinpath("sequence.par").write_text("img/cam1.%d\nimg/cam2.%d\n0\n4\n")
    par.joinpath("criteria.par").write_text("-40\n-20\n20\n40\n-20\n20\n0.02\n")
    return points


def test_openptv_without_targets_where_the_sequence_names_them(tmp_path: Path, imported: Import) -> None:
    """The public test case names images of one run and has targets of another: `--fps` was said to have no effect."""
    write_tank(tmp_path)
    (tmp_path / "parameters/sequence.par").write_text("run2/cam1.%d\nrun2/cam2.%d\n0\n4\n")
    with pytest.raises(InputError, match=r"format openptv without targets \(.*run2/cam1\.\*_targets\), found one"):
        imported("openptv", tmp_path, rates=50.0)
    report, _ = imported("openptv", tmp_path)
    assert [text for text in report["assumed"] if text.startswith("cameras alone, without targets (")]


def test_openptv_through_glass_and_water(tmp_path: Path, imported: Import) -> None:
    points = write_tank(tmp_path)
    (tmp_path / "res").mkdir()
    for frame, point in enumerate(points):
        link = f"{0 if frame else -1} {0 if frame < 4 else -2}"
        words = " ".join(map(repr, point.tolist()))
        (tmp_path / f"res/ptv_is.{frame}").write_text(f"1\n{link} {words}\n")
    report, out = imported("openptv", tmp_path, rates=50.0, truth=tmp_path / "res")
    rows = log_rows(out / "detections.parquet")
    assert sorted({row[2] for row in rows}) == [0, 1, 2, 3, 4]
    for name, config in cameras_of(out).items():
        seen = np.array([row[3:] for row in rows if row[1] == name])
        error = np.linalg.norm(config.build(name).project(points) - seen, axis=1)
        assert error.max() < 0.5
    assert report["models"]["cam1"]["refractive_indices"] == list(INDICES)
    assert any("skipped" in sentence for sentence in report["assumed"])
    truth = pq.read_table(out / "truth.parquet").to_pylist()
    assert {row["object_id"] for row in truth} == {0}
    np.testing.assert_allclose([[row[axis] for axis in "xyz"] for row in truth], points, atol=1e-12)


def test_openptv_through_glass_needs_its_volume(tmp_path: Path, imported: Import) -> None:
    write_tank(tmp_path)
    (tmp_path / "parameters" / "criteria.par").unlink()
    with pytest.raises(InputError, match=r"expected criteria\.par beside it"):
        imported("openptv", tmp_path, rates=50.0)


def test_myptv(tmp_path: Path, imported: Import) -> None:
    (tmp_path / "blobs_left").write_text("181.10\t377.85\t3\t3\t144\t0\n205.60\t75.03\t2\t3\t120\t2\n")
    trajectories = tmp_path / "trajectories"
    trajectories.write_text(
        "3\t6.5\t17.5\t-3.5\t49\t36\t0.020\t0.0\n3\t6.6\t17.5\t-3.5\t49\t36\t0.020\t2.0\n-1\t1.0\t2.0\t3.0\t1\t2\t0.1\t2.0\n"
    )
    _, out = imported("myptv", tmp_path / "blobs_left", rates=50.0, truth=trajectories)
    assert log_rows(out / "detections.parquet") == [
        (0.0, "left", 0, 377.85, 181.10),
        (0.02, "left", 1, None, None),
        (0.04, "left", 2, 75.03, 205.60),
    ]
    truth = pq.read_table(out / "truth.parquet").to_pydict()
    assert truth["object_id"] == [3, 3, 4]
    assert truth["time_s"] == [0.0, 0.04, 0.04]
    assert truth["x"] == [6.5, 6.6, 1.0]


def test_an_imported_folder_is_a_log(tmp_path: Path, imported: Import) -> None:
    (tmp_path / "blobs_left").write_text("181.10\t377.85\t3\t3\t144\t0\n")
    _, out = imported("myptv", tmp_path / "blobs_left", rates=50.0)
    assert expand([out, out / "detections.parquet", tmp_path]) == [out / "detections.parquet"] * 2 + [tmp_path]
