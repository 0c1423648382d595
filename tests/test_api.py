"""The public interface: every name is there, importing it is light, and the examples of docs/reference/api.md run."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import stereophd
from stereophd import Camera, Clock, Detector, InputError, Lens, Pose

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "reference" / "api.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("name", stereophd.__all__)
def test_every_public_name_is_there_and_documented(name: str) -> None:
    value = getattr(stereophd, name)
    assert name in dir(stereophd)
    if name != "__version__":
        assert value.__doc__
        assert re.search(rf"\b{name}\b", PAGE), f"docs/reference/api.md does not name {name}"


def test_star_imports_the_public_names() -> None:
    names: dict[str, object] = {}
    exec("from stereophd import *", names)
    assert {"track", "Camera", "__version__"} <= names.keys()
    assert set(stereophd.__all__) <= names.keys()


def test_other_names_are_errors() -> None:
    with pytest.raises(AttributeError, match="no attribute 'trakc'"):
        stereophd.trakc  # noqa: B018


def test_python_m_stereophd() -> None:
    words = [sys.executable, "-m", "stereophd", "--version"]
    result = subprocess.run(words, capture_output=True, text=True, check=True)
    assert result.stdout == f"stereophd {stereophd.__version__}\n"


def test_a_filter_over_arrays_takes_fifteen_lines() -> None:
    assert "make_filter" in BLOCKS[0]
    assert len([line for line in BLOCKS[0].splitlines() if line.strip()]) <= 15


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("pandas", "duckdb"):
        pytest.importorskip(name, reason=f"{name} is in the extra dev")
    shutil.copytree(ROOT / "sample_data", tmp_path / "sample_data")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    outputs = []
    for number, block in enumerate(BLOCKS):
        exec(compile(block, f"docs/reference/api.md, block {number + 1}", "exec"), names)
        outputs.append(capsys.readouterr().out)
    last = outputs[0].splitlines()[-1]
    assert f"`{last}`" in PAGE
    assert "80 detections, 80 frames" in outputs[2]
    assert "3 tracks" in outputs[3]
    assert "no_such_log.parquet" in outputs[4]


def moving_camera() -> Camera:
    rotation = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    pose = Pose(rotation=rotation, center=[1.0, 2.0, 3.0], velocity=[0.1, 0.0, 0.0], time_s=2.5)
    detector = Detector([0.7, 1.3], 0.9, 0.25)
    lens = Lens("fisheye", k1=0.01, k2=-0.002)
    return Camera("turning", 640, 480, 500.0, 510.0, 320.0, 240.0, pose, lens, detector, 25.0, 0.01, Clock(0.5, 1.001))


def test_cameras_come_back_equal(tmp_path: Path) -> None:
    path = tmp_path / "cameras.yaml"
    cameras = (*stereophd.read_cameras(ROOT / "sample_data" / "hall" / "cameras.yaml"), moving_camera())
    stereophd.write_cameras(path, cameras, "m")
    assert stereophd.read_cameras(path) == cameras
    with pytest.raises(InputError, match="the file exists"):
        stereophd.write_cameras(path, cameras, "m")


def columns(**changes: object) -> dict[str, object]:
    found: dict[str, object] = {
        "time_s": [0.1, 0.0, 0.0],
        "camera": ["left", "left", "right"],
        "frame": [1, 0, 0],
        "u_px": [10.0, np.nan, 5.0],
        "v_px": [20.0, np.nan, 6.0],
    }
    return {name: value for name, value in {**found, **changes}.items() if value is not None}


def test_a_log_from_columns_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    cameras = stereophd.read_cameras(ROOT / "sample_data" / "hall" / "cameras.yaml")
    stereophd.write_log(path, columns(object_id=[4, np.nan, -1], sigma_u_px=[1, 1, 2], sigma_v_px=[1, 1, 3]))
    frames = list(stereophd.read_log(path, cameras))
    assert [(f.time_s, f.camera, f.frame, f.pixels.tolist()) for f in frames] == [
        (0.0, 0, 0, []),
        (0.0, 1, 0, [[5.0, 6.0]]),
        (0.1, 0, 1, [[10.0, 20.0]]),
    ]
    assert frames[2].object_id is not None
    assert frames[2].object_id.tolist() == [4]
    assert frames[1].sigma is not None
    assert frames[1].sigma.tolist() == [[2.0, 3.0]]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (columns(v_px=None), "found no v_px"),
        (columns(speed=[1, 2, 3]), "found also speed"),
        (columns(u_px=[1.0, 2.0]), "columns of one length"),
        (columns(time_s=[0.0, np.nan, 1.0]), "column time_s: expected a number in every row"),
        (columns(u_px=["a", "b", "c"]), "column u_px: expected numbers"),
    ],
)
def test_columns_that_are_no_log(tmp_path: Path, table: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        stereophd.write_log(tmp_path / "log.parquet", table)
    assert list(tmp_path.iterdir()) == []


def test_settings_in_memory_are_checked_as_those_of_a_file() -> None:
    cameras = stereophd.read_cameras(ROOT / "sample_data" / "hall" / "cameras.yaml")
    with pytest.raises(InputError, match=r"make_filter: filter\.survival: unknown key.*survival_per_s"):
        stereophd.make_filter(cameras, "pmb", birth={"depth_range": (3, 14), "velocity_std": 1}, survival=0.9)
    with pytest.raises(InputError, match=r"filter\.birth\.velocity_std"):
        stereophd.make_filter(cameras, "phd", birth={"depth_range": np.array([3.0, 14.0])})


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the target has a name of x86 processors")
def test_the_portable_target_is_set_for_numba_and_blas() -> None:
    """One switch in the environment; a variable that is set already keeps its value."""
    names = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")
    code = f"import os, stereophd; print([os.environ.get(name) for name in {names}])"
    plain = {k: v for k, v in os.environ.items() if k not in (*names, "STEREOPHD_TARGET")}
    without = "X86_V4 AVX512F AVX512CD AVX512_SKX AVX512_ICL AVX512_SPR"
    for more, expected in (
        ({}, [None, None, None, None]),
        ({"STEREOPHD_TARGET": "portable"}, ["haswell", "", "Haswell", without]),
        ({"STEREOPHD_TARGET": "portable", "NUMBA_CPU_NAME": "generic"}, ["generic", None, "Haswell", without]),
    ):
        found = subprocess.run(
            [sys.executable, "-c", code], env={**plain, **more}, capture_output=True, text=True, check=True
        )
        assert found.stdout.strip() == str(expected)


def test_a_command_takes_a_path_for_a_configuration(tmp_path: Path) -> None:
    folder = ROOT / "sample_data"
    report = stereophd.check(folder / "hall.yaml", folder / "hall" / "detections.parquet")
    loaded = stereophd.load_config(folder / "hall.yaml")
    assert report == stereophd.check(loaded, folder / "hall" / "detections.parquet")


@pytest.mark.parametrize("command", ["track", "simulate", "calibrate", "check", "experiment", "track_logs"])
def test_a_configuration_of_another_type_is_an_input_error(command: str, tmp_path: Path) -> None:
    arguments = (3, "log.parquet", tmp_path) if command not in ("check", "simulate", "experiment") else (3, tmp_path)
    with pytest.raises(stereophd.InputError, match=r"expected a path, a mapping or what .* returns, found int"):
        getattr(stereophd, command)(*arguments)
