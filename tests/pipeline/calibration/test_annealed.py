"""Which starts are run, and with what unknown."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.recording import Recording
from stereophd.core.calibration.adjustment.solver import Adjustment
from stereophd.core.calibration.annealing.task import SUCCEEDED, Fit, Start, Task
from stereophd.core.calibration.pairing.choice import Pairing
from stereophd.core.calibration.time_limit import ENDLESS, TimeLimit
from stereophd.core.calibration.unknowns.held import is_of_maker
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.pipeline.calibration import annealed
from stereophd.pipeline.calibration.problem import CalibrationProblem, CalibrationRun
from tests.scenes import build_camera

COUNT, AGREEING = 8, 2


def start(number: int, place: float | None, explained: float = 0.1) -> Start:
    """A start that ended at a place, or failed, having explained a part of the log."""
    values = np.full(3, place or 0.0)
    adjustment = Adjustment(values, np.empty((0, 2, 3)), np.eye(3), 0.0, np.full(4, 2.0), True)
    fit = cast("Fit", SimpleNamespace(adjustment=adjustment))
    outcome = "it failed" if place is None else SUCCEEDED
    return Start(number, outcome, np.empty((0, 3)), fit, -100.0, 0.0, explained if place is None else 1.0, "pairing 0")


@dataclass
class Limit:
    """A time that is over once a number of starts has begun."""

    begun: list[int]
    last: int

    @property
    def is_over(self) -> bool:
        return len(self.begun) >= self.last

    def begin(self, stage: str) -> bool:
        return bool(stage) and not self.is_over


@pytest.fixture
def run_all(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Start]]:
    """A function of where starts end, and from which kept ones to go on."""

    def run(
        places: list[float | None],
        kept: list[Start] | None = None,
        keep: Callable[[str, list[Start]], None] = lambda *_: None,
        last: int = COUNT + 1,
        pairings: list[Pairing] | None = None,
        jobs: int = 1,
        taken: int = 0,
        explained: float = 0.1,
        may_refuse: bool = False,
        processes: Callable[..., Any] | None = None,
    ) -> Any:
        begun = list[int]()

        def begin(task: Task, number: int, *_: Any) -> Start:
            begun.append(number)
            return replace(start(number, places[number], explained), pairing=pairings[taken] if pairings else None)

        monkeypatch.setattr(annealed, "start_values", lambda *_: np.zeros((COUNT, 3)))
        monkeypatch.setattr(annealed, "paired", lambda _task, number, *_: (pairings or [])[taken if number else 0 :])
        monkeypatch.setattr(annealed, "run_start", begin)
        prior = SimpleNamespace(prior_std=np.ones(3))
        settings, motion = SimpleNamespace(agreeing_starts=AGREEING, min_tracked=0.5), SimpleNamespace(motion=None)
        task = SimpleNamespace(most_starts=COUNT, settings=settings, parameters=prior, filter=motion)
        unfinished = SimpleNamespace(read=lambda *_: kept, keep=keep)
        of_run = SimpleNamespace(
            loaded=SimpleNamespace(config=SimpleNamespace(seed=1)), jobs=jobs, limit=Limit(begun, last),
            unfinished=unfinished, progress=lambda *_: None,
        )  # fmt: skip
        monkeypatch.setattr(annealed, "worker_processes", processes or (lambda *_: nullcontext(map)))
        found = annealed._all_starts(cast("CalibrationRun", of_run), cast("Task", task), may_refuse)
        return (found, begun) if pairings else found

    return run


def test_no_more_starts_are_run_than_are_to_agree(run_all: Any) -> None:
    starts = run_all([None, 5.0, None, None, None, 5.0, 5.0, 5.0])
    assert [one.number for one in starts] == [0, 1, 2, 3, 4, 5]
    assert len(run_all([5.0, *[None] * 7])) == COUNT


@pytest.mark.parametrize("jobs", [1, 2, 3])
@pytest.mark.parametrize(
    ("places", "second_gain", "expected"),
    [
        ([5.0, 9.0], 10.0, [0]),
        ([5.0, 9.0, 5.0], 95.0, [0, 1, 2]),  # a second pairing nearly as good is followed by each start
        ([None, 5.0, 9.0], 10.0, [0, 1]),  # a start that failed shows nothing of others
    ],
)
def test_starts_of_one_pairing_are_followed_once(
    run_all: Any, places: list[float | None], second_gain: float, expected: list[int], jobs: int
) -> None:
    pairings = [Pairing(np.zeros(3), np.array([0, 2]), 100.0), Pairing(np.ones(3), np.array([1]), second_gain)]
    starts, begun = run_all([*places, *[None] * 6], pairings=pairings, jobs=jobs)
    assert [one.number for one in starts] == list(range(len(places)))
    assert begun == expected
    assert {one.fit.adjustment.values[0] for one in starts if one.succeeded} == {places[k] for k in expected} - {None}


def test_processes_begin_after_the_second_start(run_all: Any) -> None:
    counts = list[int]()

    def began(count: int, *_: Any) -> Any:
        counts.append(count)
        return nullcontext(map)

    assert len(run_all([5.0, 5.0, *[None] * 6], jobs=3, processes=began)) == 2
    assert not counts
    assert len(run_all([5.0, None, None, 5.0, *[None] * 4], jobs=3, processes=began)) == 4
    assert counts == [3]


@pytest.mark.parametrize(
    ("explained", "may_refuse", "count"), [(0.8, True, 2), (0.8, False, COUNT), (0.4, True, COUNT)]
)
def test_starts_that_explain_the_log_and_are_ruled_out_end_the_others(
    run_all: Any, explained: float, may_refuse: bool, count: int
) -> None:
    assert len(run_all([None] * COUNT, explained=explained, may_refuse=may_refuse)) == count
    assert len(run_all([None, 5.0, None, 5.0, *[None] * 4], explained=explained, may_refuse=may_refuse)) == 4


@pytest.mark.parametrize("jobs", [1, 2, 3])
@pytest.mark.parametrize(("explained", "expected"), [(0.8, [0]), (0.4, list(range(COUNT)))])
def test_a_pairing_that_explains_the_log_and_is_ruled_out_is_followed_once(
    run_all: Any, explained: float, expected: list[int], jobs: int
) -> None:
    pairings = [Pairing(np.zeros(3), np.array([0, 2]), 100.0), Pairing(np.ones(3), np.array([1]), 10.0)]
    starts, begun = run_all([None] * COUNT, pairings=pairings, jobs=jobs, explained=explained)
    assert [one.number for one in starts] == list(range(COUNT))
    assert begun == expected
    # the others are ended by as many as are to agree, whatever the processes
    starts, _ = run_all([None] * COUNT, pairings=pairings, jobs=jobs, explained=explained, may_refuse=True)
    assert len(starts) == (AGREEING if explained > 0.5 else COUNT)


@pytest.mark.parametrize("jobs", [1, 2, 3])
def test_what_counts_of_a_start_does_not_depend_on_the_processes(run_all: Any, jobs: int) -> None:
    """The first start ends at its second pairing, to which alone the next one is led: it is followed in vain."""
    pairings = [Pairing(np.zeros(3), np.array([0, 2]), 100.0), Pairing(np.ones(3), np.array([1]), 10.0)]
    starts, _ = run_all([5.0, 5.5, *[None] * 6], pairings=pairings, jobs=jobs, taken=1)
    assert [one.number for one in starts] == [0, 1]
    assert [one.fit.adjustment.values[0] for one in starts] == [5.0, 5.0]


def test_a_run_that_is_continued_goes_on_after_the_starts_that_are_kept(run_all: Any) -> None:
    first = [start(0, 5.0), start(1, None)]
    assert [one.number for one in run_all([5.0, None, None, 5.0, *[None] * 4], first)] == [0, 1, 2, 3]
    agreeing = [start(0, 5.0), start(1, 5.0)]
    assert run_all([None] * COUNT, agreeing) == agreeing
    refused = [start(0, None, 0.8), start(1, None, 0.8)]
    assert run_all([5.0] * COUNT, refused, may_refuse=True) == refused
    # the run was interrupted after the last of all
    assert run_all([None] * COUNT, [start(k, None) for k in range(COUNT)])[-1].number == COUNT - 1


def test_what_the_time_has_cut_short_is_not_kept(run_all: Any) -> None:
    """What is kept may be written later, after an interrupt, and must not change until then."""
    kept: dict[str, list[Start]] = {}
    starts = run_all([5.0, 9.0, 13.0, *[None] * 5], keep=kept.__setitem__, last=3)
    assert [one.number for one in starts] == [0, 1, 2]
    assert [one.number for one in kept["starts"]] == [0, 1]


@dataclass(frozen=True)
class Run:
    """What is read of a run whose starts all fail."""

    problem: CalibrationProblem
    section: Any
    limit: TimeLimit = ENDLESS
    is_searched: bool = False


@pytest.mark.parametrize(("model", "expected"), [("lenses", [1, 20]), ("as_stated", [1])])
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

    def fail(run: Any, task: Any, *_: bool, **__: str) -> list[Start]:
        sizes.append(run.problem.parameters.size)
        return [start(0, None)]

    monkeypatch.setattr(annealed, "_task", lambda _: SimpleNamespace())
    monkeypatch.setattr(annealed, "part_used", lambda *_: {})
    monkeypatch.setattr(annealed, "_start_report", lambda *_: {})
    monkeypatch.setattr(annealed, "_all_starts", fail)
    outcome = annealed.annealed_outcome(cast("CalibrationRun", Run(problem, SimpleNamespace(model=model))))
    assert sizes == expected  # with eight and seven values of the images, two readouts, one clock
    assert len(outcome.details["starts"]) == len(expected)
    assert outcome.reason.startswith("none of 1 starts agrees with the data")
