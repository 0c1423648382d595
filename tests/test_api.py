"""The public interface: every name is there, importing it is light, and the examples of docs/reference/api.md run."""

from __future__ import annotations

import importlib
import inspect
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from numpy.typing import ArrayLike

import stereophd
from stereophd import Camera, Clock, Detector, InputError, Lens, Pose
from stereophd.commands.demo import config_text
from stereophd.core.arrays import Array

from .conftest import leave_out_rendering

ROOT = Path(__file__).resolve().parent.parent
QUICKSTART = ROOT / "configs" / "quickstart.yaml"
PAGE = (ROOT / "docs" / "reference" / "api.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("name", stereophd.__all__)
def test_every_public_name_is_there_and_documented(name: str) -> None:
    value = getattr(stereophd, name)
    assert name in dir(stereophd)
    if name != "__version__":
        assert value.__doc__
        assert re.search(rf"\b{name}\b", PAGE), f"docs/reference/api.md does not name {name}"


@pytest.mark.parametrize("name", [name for name in stereophd.__all__ if is_dataclass(getattr(stereophd, name))])
def test_help_names_every_field(name: str) -> None:
    value = getattr(stereophd, name)
    missing = [f.name for f in fields(value) if f.name[0] != "_" and not re.search(rf"\b{f.name}\b", value.__doc__)]
    assert not missing


def test_cameras_are_made_of_lists() -> None:
    """Type checkers of users read these signatures; the arrays are kept as arrays."""
    made: list[tuple[type, tuple[str, ...]]] = [
        (Pose, ("rotation", "center", "velocity", "rotation_rate")), (Detector, ("sigma",))
    ]  # fmt: skip
    for kind, names in made:
        taken, kept = inspect.get_annotations(kind.__init__, eval_str=True), get_type_hints(kind)  # type: ignore[misc]
        assert {name: (taken[name], kept[name]) for name in names} == dict.fromkeys(names, (ArrayLike, Array))


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


def test_from_a_data_frame_to_a_plot_takes_ten_lines() -> None:
    assert "run.plot()" in BLOCKS[0]
    assert len([line for line in BLOCKS[0].splitlines() if line.strip()]) <= 10


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., object]:
    """Return a `stereophd.demo` that copies a short demonstration, so that several pages need not run it again."""
    folder = tmp_path_factory.mktemp("demonstration")
    short = re.sub(r"duration_s: [\d.]+", "duration_s: 2.0", config_text())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stereophd.commands.demo.config_text", lambda: short)
        leave_out_rendering(patch)
        stereophd.demo(folder)
    return lambda out, force=False: shutil.copytree(folder, out)


def test_the_examples_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], demo: Callable[..., object]
) -> None:
    for name in ("pandas", "duckdb"):
        pytest.importorskip(name, reason=f"{name} is in the extra dev")
    shutil.copytree(ROOT / "sample_data", tmp_path / "sample_data")
    for name in ("detections", "truth"):  # the page says nothing of the length; for so long that rays meet
        path = tmp_path / "sample_data" / "hall" / f"{name}.parquet"
        table = pq.read_table(path)
        pq.write_table(table.filter(pc.less(table["time_s"], 8.0)), path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stereophd, "demo", demo, raising=False)
    leave_out_rendering(monkeypatch)
    names: dict[str, object] = {}
    outputs = []
    for number, block in enumerate(BLOCKS):
        exec(compile(block, f"docs/reference/api.md, block {number + 1}", "exec"), names)
        outputs.append(capsys.readouterr().out)
    assert "3 tracks" in outputs[0]
    assert "mean OSPA" in outputs[1]
    assert "no_such_log.parquet" in outputs[3]
    last = outputs[4].splitlines()[-1]
    assert f"`{last}`" in PAGE
    assert "expected number of objects: 1." in outputs[5]


@pytest.mark.usefixtures("without_checks")
@pytest.mark.parametrize("script", sorted((ROOT / "docs" / "notebooks").glob("*.py")), ids=lambda path: path.stem)
def test_the_notebooks_run_and_are_those_of_the_scripts(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, demo: Callable[..., object]
) -> None:
    """Each is a page of the site: its commands must work. This takes some seconds, because they simulate and track."""
    pytest.importorskip("pandas")
    monkeypatch.syspath_prepend(ROOT / "docs")
    make_notebooks = importlib.import_module("make_notebooks")
    cells = make_notebooks.cells(script.read_text())
    notebook = json.loads(script.with_suffix(".ipynb").read_text())
    assert [(cell["cell_type"], cell["source"]) for cell in notebook["cells"]] == cells
    page = script.with_suffix(".md").read_text()
    assert all(source in page for _, source in cells)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stereophd, "demo", demo, raising=False)
    names: dict[str, object] = {}
    shown = [make_notebooks.shown(make_notebooks.run(source, names)[1]) for kind, source in cells if kind == "code"]
    assert any(text or picture for text, picture in shown)


@pytest.fixture(scope="module")
def run() -> stereophd.Outputs:
    return stereophd.track(ROOT / "sample_data" / "hall", ROOT / "sample_data" / "hall.yaml")


class TestOutputs:
    HALL = ROOT / "sample_data" / "hall"

    def test_are_those_of_the_command(self, run: stereophd.Outputs, tmp_path: Path) -> None:
        """The same tables, from a path, from a table in memory and from cameras in memory; written only if asked."""
        log = pq.read_table(self.HALL / "detections.parquet")
        cameras = stereophd.read_cameras(self.HALL / "cameras.yaml")
        out = tmp_path / "out"
        given = stereophd.track(log, ROOT / "sample_data" / "hall.yaml", cameras, out=out)
        assert run.tracks.equals(given.tracks)
        assert run.scans.equals(pq.read_table(out / "scans.parquet"))
        assert list(tmp_path.iterdir()) == [out]
        assert run.covariances.shape == (len(run.tracks), 6, 6)
        assert len(run.report["tracks"]) == 3

    @pytest.mark.usefixtures("without_checks")
    def test_vanish_with_the_object_and_not_before(self) -> None:
        scene = stereophd.simulate(QUICKSTART, overrides=["simulate.duration_s=0.5"])
        run = stereophd.track(scene, QUICKSTART, scene)
        folders = [scene.folder, run.folder]
        del scene
        assert all(folder.exists() for folder in folders)  # the run names the log of the scene
        del run
        assert not any(folder.exists() for folder in folders)

    def test_show_a_summary_and_a_page_in_a_notebook(self, run: stereophd.Outputs) -> None:
        assert "3 tracks in" in run._repr_html_()
        assert repr(run) == "Outputs(report.json, scans.parquet, tracks.parquet)"
        pytest.importorskip("plotly")
        page = stereophd.report_page(run, self.HALL)
        assert page._repr_html_().startswith("<iframe srcdoc=")

    def test_a_truth_in_memory_is_that_of_the_file(self, run: stereophd.Outputs) -> None:
        path = self.HALL / "truth.parquet"
        scores = [stereophd.evaluate(run, truth, cutoff=1.0).report for truth in (path, pq.read_table(path), self.HALL)]
        assert scores[0]["ospa"] == scores[1]["ospa"] == scores[2]["ospa"]

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda run: stereophd.track(3), "detections: expected a path, outputs or a table, found int"),
            (lambda run: stereophd.track(run.scans, 3), "found no u_px, v_px"),
            (lambda run: stereophd.track(ROOT, cameras=3), "cameras: expected a path, outputs or `Camera` objects"),
            (lambda run: stereophd.track(ROOT, run, job=3), "`job`: unknown argument; did you mean jobs?"),
            (lambda run: stereophd.evaluate(run, {"x": [1]}), "missing columns time_s"),
            (lambda run: stereophd.evaluate(run, 3), "truth: expected a path, outputs or a table, found int"),
            (lambda run: stereophd.report_page(3), "expected a path or outputs, found int"),
            (lambda run: run.table("nothing"), "expected the table nothing, found scans, tracks"),
            (lambda run: run.plot("front"), "plot: expected one of top, side, timelines, residuals, found front"),
            (lambda run: run.cameras, "cameras.yaml"),
        ],
    )
    def test_what_is_wrong_is_an_input_error(
        self, run: stereophd.Outputs, call: Callable[[stereophd.Outputs], object], message: str
    ) -> None:
        with pytest.raises(InputError, match=re.escape(message)):
            call(run)


def moving_camera() -> Camera:
    rotation = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    pose = Pose(rotation=rotation, center=[1.0, 2.0, 3.0], velocity=[0.1, 0.0, 0.0], time_s=2.5)
    detector = Detector([0.7, 1.3], 0.9, 0.25, (0.1, 0.2, 0.3, 0.4))
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


def test_a_configuration_is_a_path_values_or_loaded() -> None:
    folder = ROOT / "sample_data"
    loaded = stereophd.load_config(folder / "hall.yaml")
    first, *others = (stereophd.check(folder / "hall", config) for config in (folder / "hall.yaml", loaded))
    assert [first.report] == [other.report for other in others]
    values = {**loaded.tree.data}
    assert stereophd.check(folder / "hall", values).report["checks"] == first.report["checks"]


@pytest.mark.parametrize("command", ["track", "simulate", "calibrate", "check", "experiment"])
def test_a_configuration_of_another_type_is_an_input_error(command: str) -> None:
    arguments = (3,) if command in ("simulate", "experiment") else ("log.parquet", 3)
    with pytest.raises(stereophd.InputError, match=r"expected a path, a mapping or what .* returns, found int"):
        getattr(stereophd, command)(*arguments)
