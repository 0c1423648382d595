"""Cameras and logs for the tests of the files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.core.geometry.camera import Camera
from stereophd.io.cameras.models import CameraConfig

WIDTH, HEIGHT = 640, 480
TYPES = {
    "time_s": pa.float64(),
    "camera": pa.string(),
    "frame": pa.int64(),
    "u_px": pa.float64(),
    "v_px": pa.float64(),
    "sigma_u_px": pa.float64(),
    "sigma_v_px": pa.float64(),
    "object_id": pa.int64(),
}


def make_camera(name: str, offset_s: float = 0.0, rate: float = 1.0) -> Camera:
    """Return a camera of which the reader needs the name, the image and the clock."""
    config = CameraConfig.model_validate(
        {
            "image_size_px": [WIDTH, HEIGHT],
            "intrinsics": {"fx": 500, "fy": 500, "cx": 320, "cy": 240},
            "pose": {"center": [0, 0, 0]},
            "detector": {"sigma_px": [1, 1], "p_detect": 0.9, "clutter_per_frame": 1},
            "clock": {"offset_s": offset_s, "rate": rate},
        }
    )
    return config.build(name)


@pytest.fixture
def cameras() -> list[Camera]:
    """Two cameras with exact clocks."""
    return [make_camera("left"), make_camera("right")]


@pytest.fixture
def write_rows(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes rows (dicts) as a log, with Arrow directly: not the code under test."""

    def write(
        rows: Sequence[Mapping[str, Any]],
        types: Mapping[str, pa.DataType] | None = None,
        name: str = "log.parquet",
    ) -> Path:
        kinds = {**TYPES, **(types or {})}
        names = list(rows[0]) if rows else list(TYPES)[:5]
        table = pa.table({key: pa.array([row[key] for row in rows], kinds[key]) for key in names})
        path = tmp_path / name
        pq.write_table(table, path)
        return path

    return write


def row(time_s: Any, camera: Any, frame: Any, u: Any = None, v: Any = None, **more: Any) -> dict[str, Any]:
    """Return one row of a log."""
    return {"time_s": time_s, "camera": camera, "frame": frame, "u_px": u, "v_px": v, **more}
