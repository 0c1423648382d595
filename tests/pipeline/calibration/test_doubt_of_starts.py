"""A best start that no other one confirms is not trusted, where poses alone are unknown."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from stereophd.config.loading import load_config
from stereophd.core.calibration.adjustment.solver import Adjustment
from stereophd.core.calibration.annealing.task import SUCCEEDED, Fit, Start, Task
from stereophd.core.calibration.settings import AnnealedSettings
from stereophd.pipeline.calibration.inputs import calibration_section
from stereophd.pipeline.calibration.methods import doubt_of_starts

CONFIG = Path(__file__).parents[3] / "configs" / "paper" / "calibration.yaml"
SIZE = 6


def start(number: int, place: float | None, evidence: float = -100.0) -> Start:
    """A start that ended at a place, in standard deviations, or failed."""
    values = np.full(SIZE, place or 0.0)
    adjustment = Adjustment(values, np.empty((0, 2, 3)), np.eye(SIZE), 0.0, np.empty(0), 1, True)
    fit = cast("Fit", SimpleNamespace(adjustment=adjustment))
    outcome = "residuals are 3.0 times the detector's noise" if place is None else SUCCEEDED
    return Start(number, outcome, values, np.empty((0, SIZE)), fit, evidence, 0.0, 1.0, "pairing 0")


def doubt(starts: list[Start], only_moves: bool = True, changes: tuple[str, ...] = ()) -> str:
    section = calibration_section(load_config(CONFIG, changes))
    settings, parameters = section.annealed, SimpleNamespace(only_moves=only_moves, only_poses=only_moves)
    task = SimpleNamespace(settings=settings, parameters=parameters, most_starts=most_starts(settings, parameters))
    return doubt_of_starts(section, cast("Task", task), starts, starts[0])


def most_starts(settings: AnnealedSettings, parameters: SimpleNamespace) -> int:
    """`Task.most_starts` of a task with these."""
    assert Task.most_starts.fget is not None
    return int(Task.most_starts.fget(SimpleNamespace(settings=settings, parameters=parameters)))


def test_more_starts_are_made_where_they_are_cheap() -> None:
    poses, lenses = SimpleNamespace(only_poses=True), SimpleNamespace(only_poses=False)
    assert most_starts(AnnealedSettings(), poses) == 24
    assert most_starts(AnnealedSettings(), lenses) == 8
    assert most_starts(AnnealedSettings(starts=3), poses) == 3


def test_starts_that_agree_are_trusted() -> None:
    assert doubt([start(0, 0.0), start(1, 0.5)]) == ""


def test_a_best_start_that_stands_alone_is_doubted() -> None:
    found = doubt([start(0, 0.0), *(start(k, None) for k in range(1, 8))])
    assert found.startswith("only 1 of 8 starts found these cameras")
    # one that is asked for alone is not, and neither is one beside the full posterior
    assert doubt([start(0, 0.0)], changes=("calibration.annealed.starts=1",)) == ""
    assert doubt([start(0, 0.0), start(1, None)], changes=("calibration.posterior=smc",)) == ""


def test_with_other_unknowns_a_lone_start_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="stereophd"):
        assert doubt([start(0, 0.0), start(1, 3.0, -200.0)], only_moves=False) == ""
    assert "only 1 of 2 starts found these cameras" in caplog.text


def test_a_rival_is_named() -> None:
    found = doubt([start(0, 0.0), start(1, 0.1), start(2, 9.0, -102.0)])
    assert found.startswith("starts 0 and 2 agree with the data alike")
