"""Experiments from a configuration to files: plan, results, resuming, failures, interruption."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.experiment import experiment, finished_runs
from stereophd.errors import InputError, StereophdError
from stereophd.experiments.engine import work
from stereophd.experiments.engine.base import Kind, Series, method_clock
from stereophd.experiments.engine.execution import unfinished_experiment
from stereophd.experiments.engine.work import cases_of
from stereophd.experiments.kinds import multi_object
from stereophd.io.outputs.provenance import METADATA_KEY
from stereophd.io.outputs.saved import MARK
from stereophd.pipeline.workers import places

from .conftest import Load

PARQUET = ("runs.parquet", "summary.parquet")


def contents(folder: Path) -> dict[str, bytes]:
    """Return the tables of an experiment."""
    return {name: (folder / name).read_bytes() for name in PARQUET}


class FakeKind:
    """A kind of scenario whose runs are noted, and may fail."""

    def __init__(self) -> None:
        self.runs: list[int] = []
        self.fail: dict[int, Sequence[BaseException]] = {}

    def run(self, loaded: Any, number: int) -> list[Series]:
        self.runs.append(number)
        errors = list(self.fail.get(number, ()))
        if errors:
            self.fail[number] = errors[1:]
            raise errors[0]
        value = np.random.default_rng([loaded.config.seed, number]).normal(size=3)
        times = np.arange(3.0)
        return [Series("position_error", "cm", np.abs(value), times), Series("final", "1", value[-1:])]

    def bounds(self, loaded: Any) -> list[Series]:
        times = np.arange(3.0)
        return [Series("position_error", "cm", times + 1, times), Series("position_rmse", "cm", times + 2, times)]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeKind:
    """Replace the kind of the small experiment."""
    kind = FakeKind()
    monkeypatch.setattr(multi_object, "KIND", Kind(kind.run, kind.bounds, lambda loaded: None))
    return kind


class TestResults:
    def test_files_are_as_documented(self, load: Load, tmp_path: Path) -> None:
        loaded = load()
        experiment(loaded, tmp_path / "out")
        assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(
            ["figure.png", "figure.svg", "timing.json", *PARQUET]
        )
        runs = pq.read_table(tmp_path / "out" / "runs.parquet")
        assert [(f.name, str(f.type)) for f in runs.schema] == [
            ("experiment", "string"),
            ("method", "string"),
            ("case", "string"),
            ("run", "int64"),
            ("seed", "int64"),
            ("time_s", "double"),
            ("quantity", "string"),
            ("unit", "string"),
            ("value", "double"),
        ]
        # 2 methods, 2 cases, 5 runs; 8 times of 2 quantities, and each over the window
        assert runs.num_rows == 2 * 2 * 5 * (8 * 2 + 2)
        assert set(runs.column("case").to_pylist()) == {"right camera at 0 cm", "right camera at 5 cm"}
        assert set(runs.column("experiment").to_pylist()) == {"small"}
        # a seed a run, the same for all methods and cases
        assert (
            len({(row["run"], row["seed"]) for row in runs.to_pylist()})
            == len(set(runs.column("seed").to_pylist()))
            == 5
        )
        summary = pq.read_table(tmp_path / "out" / "summary.parquet")
        assert summary.schema.names == [
            *("experiment", "method", "case", "time_s", "quantity", "unit"),
            *("runs", "mean", "std", "ci_low", "ci_high", "bound"),
        ]
        assert summary.column("bound").null_count == summary.num_rows
        for table in (runs, summary):
            record = json.loads(table.schema.metadata[METADATA_KEY])
            assert record["config_sha256"] == loaded.sha256
            assert record["seed"] == 3

    @pytest.mark.usefixtures("without_figure")
    def test_summary_is_that_of_the_runs(self, load: Load, tmp_path: Path) -> None:
        experiment(load(), tmp_path / "out")
        runs = pq.read_table(tmp_path / "out" / "runs.parquet").to_pylist()
        summary = pq.read_table(tmp_path / "out" / "summary.parquet").to_pylist()
        for row in (summary[0], summary[17], summary[-1]):
            keys = ("method", "case", "time_s", "quantity")
            values = [r["value"] for r in runs if all(r[key] == row[key] for key in keys)]
            assert row["runs"] == len(values) == 5
            assert row["mean"] == pytest.approx(np.mean(values))
            half = 2.7764451 * np.std(values, ddof=1) / np.sqrt(5)  # Student's t, 4 degrees of freedom
            assert row["ci_low"] == pytest.approx(np.mean(values) - half)

    @pytest.mark.usefixtures("fake", "without_figure")
    def test_bounds_root_mean_squares_and_windows(self, load: Load, tmp_path: Path) -> None:
        results = experiment(load("experiment.windows={late: [1, 2]}"), tmp_path / "out")
        values = np.abs([np.random.default_rng([3, run]).normal(size=3) for run in range(5)])
        first = results.summaries[0]
        found = {one.quantity: one for one in results.summaries if (one.method, one.case) == (first.method, first.case)}
        assert found["position_error"].mean == pytest.approx(values.mean(axis=0))
        assert found["position_error"].bound.tolist() == [1, 2, 3]
        assert found["position_rmse"].mean == pytest.approx(np.sqrt((values**2).mean(axis=0)))
        assert found["position_rmse"].bound.tolist() == [2, 3, 4]
        assert found["position_error_late"].mean == pytest.approx([values[:, 1:].mean()])
        assert found["position_error_late"].bound.tolist() == [2.5]
        assert found["position_rmse_late"].mean == pytest.approx([np.sqrt((values[:, 1:] ** 2).mean())])
        assert found["position_rmse_late"].bound == pytest.approx([np.sqrt((9 + 16) / 2)])
        assert found["final"].times_s is None

    @pytest.mark.usefixtures("without_figure")
    def test_methods_see_the_same_data_whatever_the_number_of_runs(self, load: Load, tmp_path: Path) -> None:
        experiment(load(), tmp_path / "five")
        experiment(load("experiment.runs=2", "experiment.methods={filter: {}}"), tmp_path / "two")
        five, two = (pq.read_table(tmp_path / name / "runs.parquet").to_pylist() for name in ("five", "two"))
        same = [row for row in five if row["method"] == "filter" and row["run"] < 2]
        assert two == same

    def test_the_time_is_that_of_the_method(self, load: Load, monkeypatch: pytest.MonkeyPatch) -> None:
        def busy(seconds: float) -> None:
            start = time.thread_time()
            while time.thread_time() < start + seconds:
                pass

        def run(loaded: Any, number: int) -> list[Series]:
            busy(0.2)
            if number == 0:
                return []
            with method_clock():
                busy(0.02)
            with method_clock():
                busy(0.02)
            return []

        monkeypatch.setattr(multi_object, "KIND", Kind(run, lambda loaded: [], lambda loaded: None))
        part = work.Part("a", "all", "multi_object", load())
        whole, method = work.run_chunk(work.Chunk(part, (0, 1)))
        assert whole.cpu_s >= 0.2
        assert 0.04 <= method.cpu_s < 0.2


class TestPlan:
    def test_cases_are_all_combinations(self, load: Load) -> None:
        loaded = load(
            "experiment.cases={at: {key: cameras.right.pose.center.0, values: [1, 2.5], unit: cm}, "
            "noise: {settings: {low: {motion.acceleration_std: 0.1}, high: {motion.acceleration_std: 1.0}}}}"
        )
        assert loaded.config.experiment is not None
        found = cases_of(loaded.config.experiment)
        assert [name for name, _, _ in found] == [
            *("at 1 cm, noise low", "at 1 cm, noise high", "at 2.5 cm, noise low", "at 2.5 cm, noise high")
        ]
        assert found[2][1] == ("2.5 cm", "low")

    @pytest.mark.parametrize(
        ("override", "message"),
        [
            ("experiment.methods={a: {motion.max_sped: 3}}", "experiment.methods.a: motion.max_sped: unknown key"),
            (
                "experiment.methods={a: {moments.samples: 17}}",
                "samples: expected a power of two of at least 64 for method qmc, found 17",
            ),
            ("experiment.cases={b: {key: seed, values: [x]}}", "experiment.cases.b: seed: expected an integer"),
            ("experiment.cases={b: {key: seed}}", "expected key and values, or settings"),
            ("experiment.figure.over=b", "figure.over: expected the name of an axis"),
            ("experiment.scenario.kind=multi", "experiment.scenario.kind: expected one of multi_object"),
            (
                "simulate.acceleration_std=0.1",
                "simulate.acceleration_std: expected 0 with the tracker known_association",
            ),
            ("simulate=null", "simulate: expected a section"),
            ("experiment=null", "experiment: expected a section"),
        ],
    )
    def test_faults_are_found_before_anything_runs(
        self, load: Load, tmp_path: Path, override: str, message: str
    ) -> None:
        with pytest.raises(InputError, match=message.replace("[", r"\[")):
            experiment(load(override), tmp_path / "out")
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize("key", ["table", "figure.quantities"])
    def test_an_unknown_quantity_is_found_after_the_first_runs(
        self, load: Load, tmp_path: Path, fake: FakeKind, key: str
    ) -> None:
        out = tmp_path / "out"
        with pytest.raises(InputError, match=rf"experiment\.{key}: unknown quantity position_eror_late; did you mean"):
            experiment(load(f"experiment.{key}=[position_eror_late]"), out)
        # the first run of two methods in two cases
        assert fake.runs == [0, 0, 0, 0]
        experiment(load(f"experiment.{key}=[position_error_late]"), out, resume=True)
        assert len(fake.runs) == 20


@pytest.mark.usefixtures("without_figure")
class TestResume:
    def test_an_interrupted_experiment_goes_on(self, load: Load, tmp_path: Path, fake: FakeKind) -> None:
        loaded, out = load(), tmp_path / "out"
        experiment(loaded, tmp_path / "whole")
        fake.runs.clear()

        def interrupt(done: int, total: int) -> None:
            assert total == 22
            if done == 7:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            experiment(loaded, out, progress=interrupt)
        assert [p.name for p in out.iterdir()] == [unfinished_experiment(loaded, out).folder.name]
        assert finished_runs(loaded, out) == 5  # and the bounds of both cases
        with pytest.raises(InputError, match="unfinished run; use `resume=True` to continue it, or `force=True`"):
            experiment(loaded, out)
        before = len(fake.runs)
        experiment(loaded, out, resume=True)
        assert before == 5
        assert len(fake.runs) == 20
        assert contents(out) == contents(tmp_path / "whole")

    @pytest.mark.usefixtures("fake")
    def test_more_runs_may_be_asked_for_but_not_another_scene(self, load: Load, tmp_path: Path) -> None:
        out = tmp_path / "out"

        def interrupt(done: int, total: int) -> None:
            if done == 7:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            experiment(load(), out, progress=interrupt)
        with pytest.raises(InputError, match="unfinished run of another configuration"):
            experiment(load("seed=4"), out, resume=True)
        experiment(load("experiment.runs=6"), out, resume=True)
        experiment(load("experiment.runs=6"), tmp_path / "whole")
        assert contents(out) == contents(tmp_path / "whole")

    def test_a_finished_experiment_is_read(self, load: Load, tmp_path: Path, fake: FakeKind) -> None:
        loaded, out = load(), tmp_path / "out"
        first = experiment(loaded, out)
        fake.runs.clear()
        with pytest.raises(InputError, match=r"already holds runs\.parquet; use `force=True`"):
            experiment(loaded, out)
        with pytest.raises(InputError, match="results of another configuration"):
            experiment(load("seed=4"), out, resume=True)
        again = experiment(loaded, out, resume=True)
        assert fake.runs == []
        assert again.timing == first.timing
        for x, y in zip(first.summaries, again.summaries, strict=True):
            assert (x.method, x.case, x.quantity, x.unit) == (y.method, y.case, y.quantity, y.unit)
            np.testing.assert_array_equal(x.mean, y.mean)
            np.testing.assert_array_equal(x.bound, y.bound)
        experiment(loaded, out, force=True)
        assert len(fake.runs) == 20


@pytest.mark.usefixtures("without_figure")
class TestFailures:
    def test_a_failed_run_is_reported_and_tried_again(
        self, load: Load, tmp_path: Path, fake: FakeKind, caplog: pytest.LogCaptureFixture
    ) -> None:
        experiment(load(), tmp_path / "whole")
        fake.runs.clear()
        fake.fail = {3: [ValueError("odd"), ZeroDivisionError("odder")]}
        experiment(load(), tmp_path / "out")
        assert "filter, right camera at 0 cm, run 3: failed, will be tried again: ValueError: odd" in caplog.text
        assert "ZeroDivisionError: odder" in caplog.text
        assert len(fake.runs) == 22
        assert contents(tmp_path / "out") == contents(tmp_path / "whole")

    def test_it_gives_up_in_the_end_and_keeps_the_others(self, load: Load, tmp_path: Path, fake: FakeKind) -> None:
        fake.fail = {3: [ValueError("odd")] * 3}
        loaded, out = load("experiment.cases={}", "experiment.methods={a: {}}"), tmp_path / "out"
        with pytest.raises(StereophdError, match="a, all, run 3: failed 3 times: ValueError: odd"):
            experiment(loaded, out)
        assert finished_runs(loaded, out) == 4
        fake.runs.clear()
        experiment(loaded, out, resume=True)
        assert fake.runs == [3]

    def test_a_fault_of_the_configuration_is_not_tried_again(self, load: Load, tmp_path: Path, fake: FakeKind) -> None:
        fake.fail = {0: [InputError("simulate.objects: too many")]}
        with pytest.raises(InputError, match=r"filter, right camera at 0 cm, run 0: simulate\.objects: too many"):
            experiment(load(), tmp_path / "out")
        assert fake.runs == [0]

    def test_workers_of_another_version_are_refused(
        self, load: Load, tmp_path: Path, fake: FakeKind, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(places, "_numbered", lambda function, numbered: ("9.9", numbered[0], function(numbered[1])))
        with pytest.raises(InputError, match=r"expected stereophd .*, found 9\.9"):
            experiment(load(), tmp_path / "out")


def test_a_damaged_part_is_an_error_that_names_it(load: Load, tmp_path: Path) -> None:
    loaded, out = load(), tmp_path / "out"
    part = unfinished_experiment(loaded, out).folder / "a.saved"
    part.parent.mkdir(parents=True)
    part.write_bytes(MARK + b"no more")
    with pytest.raises(InputError, match=r"a\.saved: expected an unfinished run of this configuration"):
        experiment(loaded, out, resume=True)


def test_files_of_others_are_left_alone(load: Load, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("dear")
    with pytest.raises(InputError, match="which this command does not write"):
        experiment(load(), tmp_path / "out", force=True)
    assert (tmp_path / "out" / "thesis.tex").read_text() == "dear"


@pytest.mark.parametrize("name", ["partial-of-my-thesis", "partial-0123456789abcdef"])
def test_a_folder_that_only_looks_like_ours_is_left_alone(load: Load, tmp_path: Path, name: str) -> None:
    foreign = tmp_path / "out" / name / "data.saved"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("dear")
    with pytest.raises(InputError, match=rf"holds {name}/data\.saved, which is no part of an unfinished run"):
        experiment(load(), tmp_path / "out", force=True)
    assert foreign.read_text() == "dear"
