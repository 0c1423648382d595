"""`track` with ``filter.kind: single``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.errors import InputError

pytestmark = pytest.mark.usefixtures("without_checks")

CONFIG = Path(__file__).parents[2] / "configs" / "paper" / "single_object.yaml"
# RMSE from 10 s on, cm. The bound goes from 0.6 cm at 10 s to 1.4 cm at 30 s: five times as much is lost, not
# noisy. A particle filter starts with no particle near the object and may miss it: of six seeds the errors were 1 to
# 97 cm.
ESTIMATORS = (
    ("{kind: disparity}", 5.0),
    ("{kind: particle, particles: 2000, regularised: true}", 150.0),
    ("{kind: inverse_depth}", 5.0),
    ("{kind: cartesian, rule: extended}", 5.0),
    ("{kind: cartesian, rule: unscented}", 5.0),
)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirty seconds of the object, one in ten frames without a detection."""
    folder = tmp_path_factory.mktemp("log")
    misses = [f"cameras.{name}.detector.p_detect=0.9" for name in ("left", "right")]
    simulate(load_config(CONFIG, ["simulate.duration_s=30.0", *misses]), folder / "out")
    return folder / "out"


def run(log: Path, out: Path, *overrides: str, seed: int | None = None) -> dict[str, Any]:
    return track(load_config(CONFIG, list(overrides), seed), log / "detections.parquet", out)


@pytest.mark.parametrize(("estimator", "limit"), ESTIMATORS)
def test_one_track(estimator: str, limit: float, log: Path, tmp_path: Path) -> None:
    report = run(log, tmp_path / "out", f"filter.estimator={estimator}")
    assert [t["track_id"] for t in report["tracks"]] == [0]
    assert json.loads((tmp_path / "out" / "report.json").read_text())["events"] == 120
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet").to_pydict()
    scans = pq.read_table(tmp_path / "out" / "scans.parquet").to_pydict()
    assert set(tracks["track_id"]) == {0}
    assert set(tracks["existence"]) == {1.0}
    assert len(scans["time_s"]) == 120
    assert 90 < sum(scans["n_detections"]) < 120
    assert np.isfinite(scans["log_likelihood"]).all()
    scores = evaluate(tmp_path / "out" / "tracks.parquet", log / "truth.parquet", from_s=10.0, cutoff=1000.0)
    assert scores["rmse"]["position"] < limit
    assert scores["identity_switches"] == 0


def test_reports_on_a_grid_smoothed_and_of_greatest_density(log: Path, tmp_path: Path) -> None:
    run(log, tmp_path / "grid", "report.times=grid 0.3", "filter.point=map")
    times = pq.read_table(tmp_path / "grid" / "tracks.parquet").to_pydict()["time_s"]
    np.testing.assert_allclose(np.diff(times), 0.3)
    run(log, tmp_path / "filtered")
    run(log, tmp_path / "smoothed", "report.smooth={}")
    truth = log / "truth.parquet"
    filtered, smoothed = (
        evaluate(tmp_path / name / "tracks.parquet", truth)["rmse"]["position"] for name in ("filtered", "smoothed")
    )
    assert smoothed < filtered


def test_same_seed_same_bytes(log: Path, tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        run(log, tmp_path / name, "filter.estimator={kind: particle, particles: 100}", seed=seed)
    a, b, c = ((tmp_path / name / "tracks.parquet").read_bytes() for name in "abc")
    assert a == b
    assert a != c


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["filter.prior={disparity: {mean_px: 9, std_px: 3}}"], "filter.prior: expected velocity_std"),
        (["filter.estimator={kind: rectified}"], "expected right to be rectified with left"),
        (["filter.prior={velocity_std: 3}"], "exactly one of disparity and depth_range"),
        (["detector=estimate"], "detector: expected given where filter.kind is single, found estimate"),
        (["cameras.right.readout_s=0.01"], "cameras.right.readout_s: expected 0 where filter.kind is single"),
    ],
)
def test_bad_configurations(overrides: list[str], message: str, log: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        run(log, tmp_path / "out", *overrides)
    assert not (tmp_path / "out").exists()


def test_several_detections_in_a_frame(tmp_path: Path) -> None:
    clutter = [f"cameras.{name}.detector.clutter_per_frame=3.0" for name in ("left", "right")]
    simulate(load_config(CONFIG, ["simulate.duration_s=5.0", *clutter]), tmp_path / "log")
    with pytest.raises(InputError, match=r"detections.parquet: frame \d+ of \w+ at .* at most one detection"):
        run(tmp_path / "log", tmp_path / "out")
    assert not (tmp_path / "out").exists()
