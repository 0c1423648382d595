"""The files of docs/start/import.md: what its script writes is imported as what it came from."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.cli.flags import with_flags
from stereophd.io.cameras.models import CameraConfig

from .conftest import assert_same_cameras, cameras_of, log_rows

Import = Callable[..., tuple[dict[str, Any], Path]]
SCRIPT = Path(__file__).parents[3] / "docs" / "make_import_files.py"
PAGE = SCRIPT.parent / "start" / "import.md"


def script() -> Any:
    spec = importlib.util.spec_from_file_location("make_import_files", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def scene_cameras(document: dict[str, Any]) -> dict[str, CameraConfig]:
    return {name: CameraConfig.model_validate(values) for name, values in document["cameras"].items()}


def assert_page_has(report: dict[str, Any], folder: Path) -> None:
    """The page printed notes in another order, and words that had changed since."""
    notes = [with_flags(sentence).replace(f"{folder}/", "") for sentence in report["assumed"]]
    assert "".join(f"assumed: {note}\n" for note in notes) in PAGE.read_text()


def test_a_table_and_an_opencv_calibration(tmp_path: Path, imported: Import) -> None:
    module = script()
    module.main("insects", str(tmp_path / "insects"))
    folder = tmp_path / "insects"
    offsets = {name: offset + 0.0031 for name, offset in module.OFFSETS_S.items()}
    report, out = imported(
        "csv", folder / "points.csv", cameras=folder / "calibration.yml", rates=60.0, offsets=offsets
    )
    lens = {"model": "brown_conrady", "k1": -0.21, "k2": 0.06, "p1": 0.0004, "p2": -0.0003}
    assert_same_cameras(cameras_of(out), scene_cameras(module.scene(list(module.OFFSETS_S), 0.93, 1.5, lens)))
    assert report["detections"] == len((folder / "points.csv").read_text().splitlines()) - 1
    times = np.array([row[0] for row in log_rows(out / "detections.parquet")])
    assert (np.diff(times) >= 0).all()
    assert report["warnings"] == []
    assert_page_has(report, folder)


def test_dltdv_in_a_left_handed_world(tmp_path: Path, imported: Import) -> None:
    module = script()
    module.main("dltdv", str(tmp_path))
    sources = tmp_path / "flight-xypts.csv", tmp_path / "flight-dltCoefs.csv"
    report, out = imported("dltdv", *sources, rates=60.0, image_sizes=(1920, 1080), length_unit="m")
    expected = scene_cameras(module.scene(["cam1", "cam2", "cam3"], 0.9, 0.0, {"model": "none"}))
    # the coefficients have twelve digits
    assert_same_cameras(cameras_of(out), expected, atol=1e-6)
    assert any("left-handed" in sentence for sentence in report["assumed"])
    assert report["warnings"] == []
    assert_page_has(report, tmp_path)
