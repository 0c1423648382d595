"""Sets of unknowns: stages, what is held, and the choice by held-out stretches."""

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.adjustment import normal_equations
from stereophd.core.calibration.adjustment.problem import Loss, Observations, Problem
from stereophd.core.calibration.adjustment.selection import STRETCHES, choice, compare, stretches_of
from stereophd.core.calibration.adjustment.solver import adjust
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.pose import CENTER
from stereophd.core.calibration.unknowns.unknown_sets import candidates, default_stages, stages_named
from tests.core.calibration.adjustment.test_solver import solve
from tests.core.calibration.scenes import make_problem

FLOOR = Loss(normal_equations.FLOOR, 1e-3)


def with_lens(parameters: ParameterSet) -> ParameterSet:
    """The same cameras, with a focal length and a principal point that are unknown too."""
    lens = (("focal", 0.05), ("principal_point_u", 20.0), ("principal_point_v", 20.0))
    more = tuple(Parameter(name, "right", 0.0, std) for name, std in lens)
    return ParameterSet(parameters.cameras, (*parameters.parameters, *more))


def test_stages_free_the_frame_first_and_everything_last() -> None:
    parameters = with_lens(make_problem(1).parameters)
    stages = default_stages(parameters)
    assert [len(stage.names) for stage in stages] == [6, 7, 9]
    assert stages[0].names[:3] == CENTER
    assert stages[1].names[-1] == "focal"
    assert stages[-1].free.all()
    assert len(default_stages(make_problem(1).parameters)) == 1
    named = stages_named(parameters, [["rotation"], ["focal"]])
    assert [int(stage.free.sum()) for stage in named] == [3, 4, 9]
    with pytest.raises(ValueError, match="found readout"):
        stages_named(parameters, [["readout"]])


def test_held_values_stay_and_keep_the_covariance_of_the_prior() -> None:
    made = make_problem(1, objects=4)
    problem, found = solve(made)
    held = np.array([True, False, False, False, False, True])
    begin = np.where(held, 0.3 * problem.parameters.prior_std, found.values)
    fixed = adjust(replace(problem, held=held), begin, found.states)
    assert (fixed.values[held] == begin[held]).all()
    assert (fixed.values[~held] != begin[~held]).all()
    np.testing.assert_allclose(np.diag(fixed.covariance)[held], problem.parameters.prior_std[held] ** 2)
    assert (fixed.covariance[np.ix_(held, ~held)] == 0.0).all()
    assert fixed.cost >= found.cost - 1e-9


def test_stretches_hold_as_many_detections_each() -> None:
    times = np.random.default_rng(0).uniform(0.0, 10.0, 120)
    stretches = stretches_of(times)
    assert (np.bincount(stretches) == 120 // STRETCHES).all()
    assert times[stretches == 0].max() <= times[stretches == 1].min()


def test_all_unknowns_are_chosen_where_the_model_is_right() -> None:
    made = make_problem(2, objects=6)
    parameters = with_lens(made.parameters)
    whole, found = solve(replace(made, parameters=parameters))
    problem = Problem(parameters, 0, whole.knots, whole.observations, FLOOR)
    result = compare(problem, found.values, found.states, candidates(parameters))
    assert result is not None
    assert result.sets[result.chosen].free.all()
    assert result.losses.shape == (3, STRETCHES)
    assert result.errors[-1] == 0.0


def test_a_smaller_set_is_chosen_where_it_predicts_better_by_more_than_the_standard_error() -> None:
    rng = np.random.default_rng(1)
    everything = 100.0 + 5.0 * rng.standard_normal(STRETCHES)
    change = rng.standard_normal(STRETCHES)
    change -= change.mean()
    error = change.std(ddof=1) * np.sqrt(STRETCHES)
    for gain, chosen in ((1.2 * error, 0), (0.8 * error, 2), (-error, 2)):
        few = everything + change - gain / STRETCHES
        losses = np.stack([few, everything + 50.0, everything])
        assert choice(losses) == chosen


def test_no_comparison_of_a_single_set_or_a_short_log() -> None:
    made = make_problem(2, objects=3)
    problem, found = solve(made)
    assert compare(problem, found.values, found.states, candidates(problem.parameters)) is None
    few = {name: value[:50] for name, value in vars(problem.observations).items() if value is not None}
    short = replace(problem, observations=Observations(**few), parameters=with_lens(problem.parameters))
    assert compare(short, np.zeros(9), found.states, candidates(short.parameters)) is None
