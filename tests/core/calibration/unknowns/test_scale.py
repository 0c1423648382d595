"""How near together the prior allows cameras to lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.pose import CENTER
from stereophd.core.calibration.unknowns.scale import collapse, log_probability_of_nearness
from tests.core.calibration.problems import make_parameters

# Of the centre of the right camera, which lies at (20, 0, 0) under the prior; the left one is known, at (-20, 0, 0).
STD = np.array([25.0, 20.0, 15.0])


@pytest.fixture
def parameters() -> ParameterSet:
    made = make_parameters()
    rows = list(made.parameters)
    for column, std in zip(made.index("right", CENTER).tolist(), STD.tolist(), strict=True):
        rows[column] = replace(rows[column], std=std)
    return ParameterSet(made.cameras, tuple(rows))


def values_at(parameters: ParameterSet, center: list[float]) -> np.ndarray:
    values = np.zeros(parameters.size)
    values[parameters.index("right", CENTER)] = np.array(center) - [20.0, 0.0, 0.0]
    return values


def test_the_probability_is_that_of_draws_from_the_prior(parameters: ParameterSet) -> None:
    offset = np.array([2.0, 1.0, 0.5])
    found = log_probability_of_nearness(parameters, 0, values_at(parameters, (offset + [-20.0, 0.0, 0.0]).tolist()))
    draws = np.random.default_rng(3).normal([40.0, 0.0, 0.0], STD, (1_000_000, 3))
    count = int((np.linalg.norm(draws, axis=1) < np.linalg.norm(offset)).sum())
    # some 90 draws; the prior's density changes over the ball
    assert np.exp(found) * len(draws) == pytest.approx(count, rel=0.35)


@pytest.mark.parametrize(
    ("center", "refused"),
    [([20.0, 0.0, 0.0], False), ([-19.0, 0.0, 0.0], False), ([-19.97, 0.0, 0.0], True), ([-20.0, 0.0, 0.0], True)],
)
def test_cameras_in_one_place_are_refused(parameters: ParameterSet, center: list[float], refused: bool) -> None:
    assert (collapse(parameters, 0, values_at(parameters, center)) is not None) == refused


def test_cameras_whose_distance_is_known_are_not(parameters: ParameterSet) -> None:
    known = ParameterSet(parameters.cameras, tuple(row for row in parameters.parameters if row.name not in CENTER))
    assert log_probability_of_nearness(known, 0, np.zeros(known.size)) == 0.0
