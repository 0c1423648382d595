"""Braid, flydra and OpenPTV: files written from cameras that are known."""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError
from stereophd.io.interchange.cameras import take_apart

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
        np.testing.assert_allclose(found, pinhole(camera, POINTS)[frame - 100], atol=1e-6)
    assert any("trigger" in sentence for sentence in report["assumed"])
    assert any("undistorted" in sentence for sentence in report["assumed"]) == bool(shift)


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


@pytest.mark.parametrize("added", ["0 0 0 0 0 1 0", "-4e-5 1e-7 0 1e-4 -2e-4 1.002 0.001"])
def test_openptv_in_one_medium(tmp_path: Path, imported: Import, added: str) -> None:
    path = write_openptv(tmp_path, added=added)
    report, out = imported("openptv", path, rates=50.0)
    rows = log_rows(out / "detections.parquet")
    assert [row[1:3] for row in rows if row[3] is None] == [("cam1", 10002)]
    cameras = cameras_of(out)
    for time, name, frame, u, v in (row for row in rows if row[3] is not None):
        assert time == pytest.approx(frame / 50)
        expected = pinhole(cameras[name].build(name), POINTS)[frame - 10001]
        np.testing.assert_allclose([u, v], expected, atol=1e-6)
    assert report["length_unit"] == "mm"


def test_openptv_through_glass_is_refused_with_the_reason(tmp_path: Path, imported: Import) -> None:
    with pytest.raises(InputError, match=r"expected one medium .* found 1, 1.46, 1.33: rays through glass"):
        imported("openptv", write_openptv(tmp_path, indices="1 1.46 1.33"), rates=50.0)
