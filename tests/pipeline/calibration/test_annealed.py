"""Which starts are run, and which of them are judged at larger noise."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.recording import Recording
from stereophd.core.calibration.adjustment.solver import Adjustment
from stereophd.core.calibration.annealing.task import SUCCEEDED, Fit, Start, Task
from stereophd.core.calibration.time_limit import ENDLESS, TimeLimit
from stereophd.core.calibration.unknowns.held import is_of_maker
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.pipeline.calibration import annealed
from stereophd.pipeline.calibration.problem import CalibrationProblem, CalibrationRun
from tests.scenes import build_camera

COUNT, AGREEING = 8, 2


def start(number: int, place: float | None, noise: float = 1.0) -> Start:
    """A start that ended at a place at a noise, or failed and can be judged at larger noise."""
    values = np.full(3, place or 0.0)
    adjustment = Adjustment(values, np.empty((0, 2, 3)), np.eye(3), 0.0, np.full(4, 2.0), True)
    fit = cast("Fit", SimpleNamespace(adjustment=adjustment))
    outcome = "it failed" if place is None else SUCCEEDED
    made = Start(number, outcome, values, np.empty((0, 3)), fit, -100.0, 0.0, 1.0, "pairing 0", noise)
    return replace(made, looser=(made,)) if place is None else made


@dataclass
class Limit:
    """A time that is over once a number of starts has begun."""

    begun: list[int]
    last: int

    @property
    def is_over(self) -> bool:
        return len(self.begun) >= self.last


@pytest.fixture
def run_all(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[list[Start], list[int]]]:
    """A function of where starts end, and from which kept ones to go on; also which were judged at larger noise."""

    def run(
        places: list[float | None],
        loose: float | None,
        kept: list[Start] | None = None,
        keep: Callable[[str, list[Start]], None] = lambda *_: None,
        last: int = COUNT + 1,
        posterior: str = "laplace",
    ) -> Any:
        judged, begun = list[int](), list[int]()

        def judge(task: Task, failed: Start) -> Start:
            judged.append(failed.number)
            return replace(start(failed.number, loose, 2.0), looser=())

        def begin(task: Task, number: int, *_: Any) -> Start:
            begun.append(number)
            return start(number, places[number])

        monkeypatch.setattr(annealed, "start_values", lambda *_: np.zeros((COUNT, 3)))
        monkeypatch.setattr(annealed, "run_start", begin)
        monkeypatch.setattr(annealed, "at_larger_noise", judge)
        settings, motion = SimpleNamespace(agreeing_starts=AGREEING), SimpleNamespace(motion=None)
        task = SimpleNamespace(most_starts=COUNT, settings=settings, parameters=None, filter=motion)
        unfinished = SimpleNamespace(read=lambda *_: kept, keep=keep)
        of_run = SimpleNamespace(
            loaded=SimpleNamespace(config=SimpleNamespace(seed=1)), jobs=1, limit=Limit(begun, last),
            unfinished=unfinished, progress=lambda *_: None, section=SimpleNamespace(posterior=posterior),
        )  # fmt: skip
        return annealed._all_starts(cast("CalibrationRun", of_run), cast("Task", task)), judged

    return run


def test_where_enough_starts_agree_none_is_judged_at_larger_noise(run_all: Any) -> None:
    starts, judged = run_all([None, 5.0, None, None, None, 5.0, 5.0, 5.0], 7.0)
    assert [one.number for one in starts] == [0, 1, 2, 3, 4, 5]
    assert judged == []


def test_where_none_of_the_first_succeeds_they_are_judged_at_larger_noise_at_once(run_all: Any) -> None:
    starts, judged = run_all([None] * COUNT, 7.0)
    assert judged == [0, 1, 2, 3]  # twice as many as at the stated noise are to agree
    assert [one.noise for one in starts] == [2.0] * 4
    starts, judged = run_all([None] * 4 + [5.0] * 4, None)
    assert judged == [0, 1, 2, 3]
    assert [one.number for one in starts] == [0, 1, 2, 3, 4, 5]


def test_where_all_starts_do_not_agree_those_that_failed_are_judged_at_larger_noise(run_all: Any) -> None:
    starts, judged = run_all([5.0, *[None] * 7], 7.0)
    assert len(starts) == COUNT
    assert judged == list(range(1, 8))


def test_a_run_that_is_continued_judges_the_same_starts(run_all: Any) -> None:
    first = [replace(start(0, 7.0, 2.0), looser=()), *(start(number, None) for number in (1, 2, 3))]
    starts, judged = run_all([None] * COUNT, 7.0, first)
    assert judged == [1, 2, 3]
    assert len(starts) == 4


def test_what_the_time_has_cut_short_is_not_kept(run_all: Any) -> None:
    """What is kept may be written later, after an interrupt, and must not change until then."""
    kept: dict[str, list[Start]] = {}
    starts, _ = run_all([5.0, 9.0, 13.0, *[None] * 5], 7.0, keep=kept.__setitem__, last=3)
    assert [one.number for one in starts] == [0, 1, 2]
    assert [one.number for one in kept["starts"]] == [0, 1]


def test_where_the_time_is_over_before_a_start_has_succeeded_one_is_judged_at_larger_noise(run_all: Any) -> None:
    kept: dict[str, list[Start]] = {}
    starts, judged = run_all([None] * COUNT, 7.0, keep=kept.__setitem__, last=2)
    assert judged == [0]
    assert [one.noise for one in starts] == [2.0, 1.0]
    assert all(one.looser for one in kept["starts"])


def test_particles_need_no_starts_at_larger_noise(run_all: Any) -> None:
    starts, judged = run_all([None] * COUNT, 7.0, posterior="smc")
    assert (len(starts), judged) == (COUNT, [])


@dataclass(frozen=True)
class Run:
    """What is read of a run whose starts all fail."""

    problem: CalibrationProblem
    section: Any
    limit: TimeLimit = ENDLESS


@pytest.mark.parametrize(("model", "expected"), [("lenses", [1, 9]), ("as_stated", [1])])
def test_where_no_start_succeeds_what_nobody_measured_is_unknown(
    monkeypatch: pytest.MonkeyPatch, model: str, expected: list[int]
) -> None:
    left = build_camera("left")
    assert is_of_maker(left)
    two = (left, replace(left, name="right"))
    known = (Parameter("focal", "right", 0.0, 0.01),)
    recording = cast("Recording", SimpleNamespace(periods=lambda count: np.full(count, 0.1)))
    problem = CalibrationProblem(ParameterSet(two, known), 0, recording, None, {})
    sizes = list[int]()

    def fail(run: Any, task: Any, *_: str) -> list[Start]:
        sizes.append(run.problem.parameters.size)
        return [start(0, None)]

    monkeypatch.setattr(annealed, "_task", lambda _: SimpleNamespace(stages=()))
    monkeypatch.setattr(annealed, "_clock_report", lambda _: {})
    monkeypatch.setattr(annealed, "_start_report", lambda *_: {})
    monkeypatch.setattr(annealed, "_all_starts", fail)
    outcome = annealed.annealed_outcome(cast("CalibrationRun", Run(problem, SimpleNamespace(model=model))))
    assert sizes == expected  # with four and three values of the images, and the offset of one clock
    assert len(outcome.details["starts"]) == len(expected)
    assert outcome.reason.startswith("none of 1 starts agrees with the data")
