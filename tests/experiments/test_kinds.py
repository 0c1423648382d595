"""The kinds of scenario: in agreement with the commands, with the bounds, and with closed forms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.evaluate import evaluate
from stereophd.commands.experiment import experiment
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import LoadedConfig, load_config, variant
from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Series
from stereophd.experiments.kinds import calibration, localisation, move, multi_object, static_scene, tracking

from .conftest import Load

PAPER = Path(__file__).parent.parent.parent / "configs" / "paper"

# What makes an experiment of the paper small, and the quantities that its figure shows.
SMALL = {
    "static_scene": ["experiment.runs=1", "experiment.scenario.bound_scenes=1", "experiment.cases={}"],
    "table2": ["experiment.runs=1"],
    "figure4": ["experiment.runs=1", "experiment.scenario.reference_samples=20000"],
    "figure7": ["experiment.runs=1", "experiment.scenario.reference_samples=20000"],
    "figure10": ["experiment.runs=1"],
    "figure11": ["experiment.runs=1", "experiment.scenario.steps=6", "experiment.scenario.bound_trajectories=2"],
    "figure12": ["experiment.runs=1", "simulate.duration_s=10"],
    "figure13": [
        "experiment.runs=1",
        "simulate.duration_s=20",
        "experiment.scenario={kind: calibration, every_s: 10, bound_scenes: 1}",
        "calibration.annealed.starts=1",
        "calibration.sequential={moves: none, particles: 4, likelihood: phd, samples: 16}",
        "experiment.methods.sequential={calibration.method: sequential, calibration.sequential: "
        "{moves: rerun, particles: 4, first_particles: 4, moves_per_step: 1, inflation: [2], block_events: 20}}",
    ],
}


def by_name(series: list[Series]) -> dict[str, Array]:
    """Return name -> values."""
    return {one.quantity: one.values for one in series}


@pytest.mark.parametrize("name", SMALL)
def test_experiments_of_the_paper_run_small(name: str, tmp_path: Path) -> None:
    results = experiment(load_config(PAPER / f"{name}.yaml", SMALL[name]), tmp_path / "out")
    assert results.config.table is None or {quantity.rsplit("_at_", 1)[0] for quantity in results.config.table} & {
        one.quantity for one in results.summaries
    }
    assert (tmp_path / "out" / "figure.png").stat().st_size > 10_000
    rows = pq.read_table(tmp_path / "out" / "runs.parquet")
    assert {row["method"] for row in rows.to_pylist()} == set(results.config.methods)


def test_all_experiments_of_the_paper_are_tested() -> None:
    experiments = {p.stem for p in PAPER.glob("*.yaml") if load_config(p).config.experiment is not None}
    assert experiments == set(SMALL)


class TestManyObjects:
    @pytest.mark.usefixtures("without_checks")
    @pytest.mark.parametrize("smooth", [False, True])
    def test_as_simulate_track_and_evaluate(self, load: Load, tmp_path: Path, smooth: bool) -> None:
        loaded = load(*(["report.smooth={}"] if smooth else []))
        simulate(loaded, tmp_path / "scenes", runs=2)
        scene = tmp_path / "scenes" / "run-0001"
        track(loaded, scene / "detections.parquet", tmp_path / "tracks")
        evaluate(
            tmp_path / "tracks" / "tracks.parquet",
            scene / "truth.parquet",
            tmp_path / "scores",
            order=2,
            cutoff=20,
            plots=False,
        )
        expected = pq.read_table(tmp_path / "scores" / "per_scan.parquet").column("ospa").to_numpy()
        found = {one.quantity: one for one in multi_object.run(loaded, 1)}
        np.testing.assert_allclose(found["ospa_p2_c20"].values, expected, rtol=1e-12)
        times = found["ospa_p2_c20"].times_s
        assert times is not None
        np.testing.assert_array_equal(times, np.arange(8.0))

    def test_known_association_is_the_limit(self, load: Load) -> None:
        # 10 scenes, 40 s: the filter is worse on average; more data make the limit smaller
        known = load("experiment.scenario.tracker=known_association", "simulate.duration_s=40")
        tracked = load("simulate.duration_s=40")
        errors = {
            name: np.array([by_name(multi_object.run(loaded, run))["ospa_p2_c20"] for run in range(10)])
            for name, loaded in (("known", known), ("tracked", tracked))
        }
        assert errors["known"].mean() < errors["tracked"].mean()
        assert errors["known"][:, 30:].mean() < errors["known"][:, :5].mean() / 2


def single(**estimator: object) -> LoadedConfig:
    """Return Table II's configuration with an estimator, 150 cm away, QMC."""
    loaded = load_config(PAPER / "table2.yaml", ["moments={method: qmc, samples: 64}"])
    return variant(loaded, [("test", {"experiment.scenario.position.2": 150.0, "filter.estimator": estimator})])


class TestLocalisation:
    def test_disparity_space_reaches_the_bound(self) -> None:
        # the mean of 400 runs has a standard error of 3.7 % (standard deviation over mean 0.75)
        loaded = single(kind="disparity")
        errors = [by_name(localisation.run(loaded, run))["final_position_error"][0] for run in range(400)]
        bound = by_name(localisation.bounds(loaded))["final_position_error"][0]
        assert bound == pytest.approx(1.40, abs=0.005)
        assert np.mean(errors) == pytest.approx(bound, rel=0.11)

    def test_methods_see_the_same_detections(self) -> None:
        one, other = (localisation.run(single(kind=kind), 3) for kind in ("disparity", "inverse_depth"))
        first = [by_name(series)["position_error"][0] for series in (one, other)]
        last = [by_name(series)["position_error"][1] for series in (one, other)]
        # two cameras leave little room for a prior: both estimates are near the same triangulated point
        assert first[0] != first[1]
        assert last[0] == pytest.approx(last[1], rel=0.5)

    @pytest.mark.parametrize(
        ("override", "message"),
        [
            ("experiment.scenario.sequence=[left, middle]", r"expected one of the cameras left, right, found middle"),
            ("experiment.cases={}", None),
            ("experiment.scenario.position=[0, 0, -5]", "expected an object in view of left"),
            ("filter=null", "expected a filter of kind single for one object, found none"),
        ],
    )
    def test_faults(self, override: str, message: str | None) -> None:
        overrides = ["experiment.methods={a: {}}", "experiment.figure={}", "experiment.cases={}", override]
        loaded = load_config(PAPER / "table2.yaml", overrides)
        if message is None:
            localisation.check(loaded)
            return
        with pytest.raises(InputError, match=message):
            localisation.check(loaded)


def test_tracking_stays_near_its_bound() -> None:
    overrides = ["moments={method: qmc, samples: 64}", "experiment.scenario.steps=40"]
    loaded = load_config(PAPER / "figure11.yaml", overrides)
    errors = np.array([by_name(tracking.run(loaded, run))["position_error"] for run in range(20)])
    bound = by_name(tracking.bounds(loaded))["position_rmse"]
    ratio = np.sqrt((errors[:, 20:] ** 2).mean()) / np.sqrt((bound[20:] ** 2).mean())
    # 20 runs, errors correlated over time: a few dozen degrees of freedom, 10 % standard error
    assert 0.7 < ratio < 1.3


def test_moves_are_compared_with_one_reference() -> None:
    overrides = ["experiment.scenario.reference_samples=100000"]
    loaded = load_config(PAPER / "figure7.yaml", overrides)
    assert loaded.config.experiment is not None
    divergence = {}
    for name, settings in loaded.config.experiment.methods.items():
        config = variant(loaded, [("test", settings)])
        divergence[name] = by_name(move.run(config, 0))["divergence"][0]
        assert by_name(move.bounds(config))["mean_u"] == by_name(move.bounds(loaded))["mean_u"]
    # the reference itself is known to some 3e-4 nat
    assert max(divergence["512 QMC"], divergence["64 QMC"]) < 1e-3
    assert 1e-3 < divergence["linear (EKF)"] < divergence["500 particles"]
    with pytest.raises(
        InputError, match=r"experiment.scenario.home: expected one of the cameras left, right, found top"
    ):
        move.check(load_config(PAPER / "figure7.yaml", ["experiment.scenario.home=top"]))


def test_calibration_errors_are_those_of_the_guess_before_any_data() -> None:
    loaded = load_config(PAPER / "figure13.yaml", ["simulate.duration_s=9"])
    scene, guessed, parameters, reference, true = calibration._setting(loaded, 0)
    assert scene.cameras == parameters.build(true) or all(
        np.allclose(a.pose.center, b.pose.center) and np.allclose(a.pose.rotation, b.pose.rotation)
        for a, b in zip(scene.cameras, parameters.build(true), strict=True)
    )
    assert guessed.config.seed != loaded.config.seed
    covariance = np.diag(parameters.prior_std**2)
    history = [calibration.HistoryRow(0.0, np.zeros(6), covariance)]
    limits = np.stack([covariance / 4.0] * 2)
    found = by_name(calibration._errors(loaded, parameters, reference, true, history, limits))
    assert found["center_error"] == pytest.approx(np.full(2, np.linalg.norm(true[:3])))
    assert found["right_rotation_y_error"] == pytest.approx(np.full(2, np.rad2deg(abs(true[4]))))
    assert found["center_std"] == pytest.approx(np.full(2, 5.0 * np.sqrt(3.0)))
    assert found["rotation_error_ratio"] == pytest.approx(2.0 * found["rotation_error"] / found["rotation_std"])
    in_prior_stds = np.abs(true / parameters.prior_std)
    assert found["nees"] == pytest.approx(np.full(2, (in_prior_stds**2).sum()))
    assert found["coverage_90"] == pytest.approx(np.full(2, (in_prior_stds <= 1.6449).mean()))
    assert found["scale_std_ratio"] == pytest.approx(np.ones(2))


@pytest.mark.usefixtures("without_figure")
def test_the_table_as_json(load: Load, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from stereophd.cli.app import run

    words = ["experiment", str(PAPER / "table2.yaml"), "--out", str(tmp_path / "out"), "--set", "experiment.runs=2"]
    assert run([*words, "--json", "--set", "experiment.methods={disparity space: {}}"]) == 0
    report = json.loads(capsys.readouterr().out)
    rows = [row for row in report["summary"] if row["quantity"] == "final_position_error"]
    assert len(rows) == 9
    assert {row["runs"] for row in rows} == {2}
    assert rows[0]["bound"] == pytest.approx(0.200, abs=0.001)
    assert set(report["timing"]["cpu_s_per_run"]) == {"disparity space"}
    assert run([*words, "--resume", "--set", "experiment.methods={disparity space: {}}"]) == 0
    printed = capsys.readouterr().out
    assert "final_position_error [cm]" in printed
    assert "object at 150 cm, prior 8 (7.1)" in printed


class TestStaticScene:
    def test_points_of_a_video_are_all_found_and_told_apart(self) -> None:
        loaded = load_config(PAPER / "static_scene.yaml", ["simulate.objects.count=10", "simulate.duration_s=12"])
        found = by_name(static_scene.run(loaded, 0))
        assert found["points_found"] == 1.0
        assert found["points_false"] == 0.0
        assert found["correspondence_right"] > 0.98
        assert found["correspondence_wrong"] < 0.02
        assert 0.4 < found["error_over_bound"][0] < 1.6  # ten points: five standard errors
        assert found["cardinality_bias"][-1] == 0.0

    def test_objects_that_move_are_refused(self) -> None:
        loaded = load_config(PAPER / "static_scene.yaml", ["motion={model: constant_velocity, acceleration_std: 1.0}"])
        with pytest.raises(InputError, match=r"motion.model: expected static, found constant_velocity"):
            static_scene.check(loaded)
