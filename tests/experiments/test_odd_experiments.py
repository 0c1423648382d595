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


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("figure4", "cameras.left.image_size_px=[3, 3]", "experiment.scenario: expected a Gaussian partly in view"),
    ],
)
@pytest.mark.usefixtures("without_figure")
def test_an_experiment_is_refused(tmp_path: Path, name: str, override: str, message: str) -> None:
    small = ["experiment.runs=1"]
    if name == "figure4":
        small.append("experiment.scenario.reference_samples=2000")
    with pytest.raises(InputError, match=message):
        experiment(load_config(PAPER / f"{name}.yaml", [*small, override]), tmp_path / "out")
