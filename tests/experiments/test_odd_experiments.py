"""Settings that no experiment has are refused with their place, or give a result; a run never fails again and again.

Each row is of a class of configurations that ended otherwise when `tests/fuzz` tried it first.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from stereophd.commands.experiment import experiment
from stereophd.config.loading import load_config
from stereophd.errors import InputError

PAPER = Path(__file__).parents[2] / "configs" / "paper"
SMALL = {
    "figure4": ["experiment.scenario.reference_samples=2000"],
    "figure11": [
        "experiment.scenario.steps=5",
        "experiment.scenario.bound_trajectories=2",
        "experiment.windows={}",
        "experiment.table=[position_rmse]",
    ],
    "figure12": ["simulate.duration_s=3", "experiment.windows={}"],
}

FEW_PARTICLES = (
    "{annealed: {}, plain: {calibration.method: sequential, calibration.sequential.particles: 8}, sequential: "
    "{calibration.method: sequential, calibration.sequential: {moves: rerun, particles: 8, first_particles: 8, "
    "moves_per_step: 1}}}"
)


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("figure4", "cameras.left.image_size_px=[3, 3]", "experiment.scenario: expected a Gaussian partly in view"),
        ("figure4", "experiment.scenario.velocity=[1e9, 0, 0]", "too far apart"),
        ("figure11", "motion={model: damped_velocity, time_constant_s: 1e-9, acceleration_std: 1}", "too far apart"),
        ("figure12", "disparity.baseline=1e-12", "too far apart"),
        # sizes that were not estimated before work began
        ("table2", "experiment.scenario.rounds=1000000000", "rounds: expected a number <= 1000000"),
        ("table2", "experiment.scenario.rounds=1000000", "fits into the memory"),
        ("figure11", "experiment.scenario.steps=1000000", "fits into the memory"),
        ("figure13", "experiment.scenario.every_s=1e-5", "fits into the memory"),
        ("figure13", "simulate.objects.count=10000", "fits into the memory"),
        ("figure13", "calibration.sequential.particles=100000", "fits into the memory"),
    ],
)
@pytest.mark.usefixtures("without_figure")
def test_an_experiment_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, override: str, message: str
) -> None:
    monkeypatch.setattr("stereophd.pipeline.runs.sizes.available_memory", lambda: 1e9)
    small = ["experiment.runs=1", *SMALL.get(name, ())]
    with pytest.raises(InputError, match=message):
        experiment(load_config(PAPER / f"{name}.yaml", [*small, override]), tmp_path / "out")


@pytest.mark.parametrize(
    "overrides",
    [
        ("figure13", "simulate.objects.count=0", "simulate.duration_s=9", f"experiment.methods={FEW_PARTICLES}"),
        ("static_scene", "simulate.objects.count=0", "experiment.scenario.bound_scenes=1"),
    ],
)
@pytest.mark.usefixtures("without_figure")
def test_an_experiment_without_objects_gives_a_result(tmp_path: Path, overrides: tuple[str, ...]) -> None:
    name, *settings = overrides
    config = load_config(PAPER / f"{name}.yaml", ["experiment.runs=1", *settings])
    assert experiment(config, tmp_path / "out")
