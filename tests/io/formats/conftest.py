"""A rig of two cameras and what they see, for the tests of foreign formats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.importing import import_recording
from stereophd.config.loading import load_cameras
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.interchange.base import ImportOptions, PerCamera
from stereophd.io.interchange.cameras import Parts, put_together
from stereophd.io.interchange.registry import find

SIZES = {"left": (640, 480), "right": (800, 600)}


def rig(fisheye: bool = False, lens: Sequence[float] = (-0.11, 0.02, 1e-3, -2e-3, 0.003)) -> dict[str, CameraConfig]:
    """Return two cameras that look at the origin from a distance of about 2."""
    cameras = {}
    for k, (name, size) in enumerate(SIZES.items()):
        rotation = rotation_from_vector(np.array([0.1, 0.4 - 0.8 * k, -0.05]))
        center = -rotation.T @ np.array([0.03, -0.02, 2.0 + k])
        matrix = np.array([[510.25 + k, 0, 321.5 + 80 * k], [0, 505.125, 238.75 + 60 * k], [0, 0, 1.0]])
        coefficients = np.array(lens[:4] if fisheye else lens)
        parts = Parts(matrix, coefficients, fisheye, rotation, center, size)
        cameras[name] = put_together(name, parts, ImportOptions(), "test")
    return cameras


def assert_same_cameras(found: dict[str, CameraConfig], expected: dict[str, CameraConfig], atol: float = 1e-9) -> None:
    """Compare everything that a camera file holds, by name."""
    assert list(found) == list(expected)
    for name, camera in expected.items():
        a, b = found[name].build(name), camera.build(name)
        assert (a.width, a.height) == (b.width, b.height)
        np.testing.assert_allclose([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy], rtol=0, atol=atol)
        np.testing.assert_allclose(a.pose.rotation, b.pose.rotation, rtol=0, atol=atol)
        np.testing.assert_allclose(a.pose.center, b.pose.center, rtol=0, atol=atol)
        np.testing.assert_allclose(a.lens.coefficients, b.lens.coefficients, rtol=0, atol=atol)
        assert a.lens.model == b.lens.model or not a.lens.coefficients.any()


def log_rows(path: Path) -> list[tuple[Any, ...]]:
    """Return the rows of a log as tuples (time, camera, frame, u, v)."""
    table = pq.read_table(path, columns=["time_s", "camera", "frame", "u_px", "v_px"])
    return list(zip(*(column.to_pylist() for column in table.columns), strict=True))


@pytest.fixture
def imported(tmp_path: Path) -> Callable[..., tuple[dict[str, Any], Path]]:
    """Return a function that imports sources into a new folder, and returns the report and the folder."""

    def function(form: str, *sources: Path, cameras: Path | None = None, **stated: Any) -> tuple[dict[str, Any], Path]:
        for key in ("rates", "offsets", "frames", "image_sizes"):
            if key in stated:
                value = stated[key]
                stated[key] = PerCamera(value) if isinstance(value, dict) else PerCamera(other=value)
        out = tmp_path / "imported"
        report = import_recording(form, sources, out, ImportOptions(**stated), cameras, force=True)
        return report, out

    return function


def round_trip(form: str, cameras: dict[str, CameraConfig], folder: Path, name: str) -> dict[str, CameraConfig]:
    """Write cameras in a format, and read them again."""
    target = folder / name
    writer, reader = find(form).write_cameras, find(form).read
    assert writer is not None
    assert reader is not None
    writer(cameras, "cm", target)
    return reader([target], ImportOptions(length_unit="cm")).cameras


def cameras_of(out: Path) -> dict[str, CameraConfig]:
    """Return the cameras of an import."""
    return dict(load_cameras(out / "cameras.yaml").cameras)
