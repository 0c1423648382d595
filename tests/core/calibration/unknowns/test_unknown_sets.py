"""Sets of unknowns: stages, and what is held."""

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.adjustment import normal_equations
from stereophd.core.calibration.adjustment.problem import Loss
from stereophd.core.calibration.adjustment.solver import adjust
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.pose import CENTER
from stereophd.core.calibration.unknowns.unknown_sets import default_stages, stages_named
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
