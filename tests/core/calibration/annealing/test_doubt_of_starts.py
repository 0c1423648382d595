"""A best start that no other one confirms is not trusted, where poses alone are unknown; agreement and rivals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.solver import Adjustment
from stereophd.core.calibration.adjustment.suspicions import Suspicion
from stereophd.core.calibration.annealing import starts as start_module
from stereophd.core.calibration.annealing.method import (
    Believed,
    Remark,
    doubt_of_starts,
    fitting,
    motion_remarks,
    statement_remarks,
    why_none_succeeded,
)
from stereophd.core.calibration.annealing.starts import agree, best_of, compared, distinct, rival_of, run_start
from stereophd.core.calibration.annealing.task import SUCCEEDED, Fit, Start, Task
from stereophd.core.calibration.pairing.choice import Pairing
from stereophd.core.calibration.settings import AnnealedSettings
from stereophd.core.calibration.time_limit import ENDLESS
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement

SIZE = 6
FAILED = "residuals are 3.0 times the detector's noise"


def start(number: int, place: float | None, evidence: float = -100.0, squared: float = 2.0, std: float = 1.0) -> Start:
    """A start that ended at a place, which it knows to `std`, or failed; its squared residuals are 2 by their noise."""
    values = np.full(SIZE, place or 0.0)
    adjustment = Adjustment(values, np.empty((0, 2, 3)), std**2 * np.eye(SIZE), 0.0, np.full(4, squared), True)
    fit = cast("Fit", SimpleNamespace(adjustment=adjustment))
    outcome = FAILED if place is None else SUCCEEDED
    return Start(number, outcome, np.empty((0, SIZE)), fit, evidence, 0.0, 1.0, "pairing 0")


def doubt(
    starts: list[Start], only_moves: bool = True, count: int | None = None, is_sampled: bool = False
) -> tuple[str, tuple[Remark, ...]]:
    settings, parameters = AnnealedSettings(starts=count), SimpleNamespace(only_moves=only_moves, only_poses=only_moves)
    task = SimpleNamespace(settings=settings, parameters=parameters, most_starts=most_starts(settings, parameters))
    return doubt_of_starts(cast("Task", task), starts, starts[0], is_sampled)


def most_starts(settings: AnnealedSettings, parameters: SimpleNamespace) -> int:
    """`Task.most_starts` of a task with these."""
    assert Task.most_starts.fget is not None
    return int(Task.most_starts.fget(SimpleNamespace(settings=settings, parameters=parameters)))


@pytest.mark.parametrize(("kind", "is_proposed"), [(None, True), ("speed", True), ("length", False)])
def test_a_length_is_not_proposed_where_one_is_known(kind: str | None, is_proposed: bool) -> None:
    known = None if kind is None else ScaleMeasurement(kind, 1.0, 0.1)
    answer = SimpleNamespace(motion_factors=np.full(3, 0.05), knots=SimpleNamespace(noise_std=np.full(3, 0.1)))
    (remark,) = motion_remarks(cast("Fit", answer), np.log(1.3), known)
    assert "by 0.13 length/s^2, 0.065 times as much" in remark.text
    assert ("scale.kind: length" in remark.text) == is_proposed


def test_more_starts_are_made_where_they_are_cheap() -> None:
    poses, lenses = SimpleNamespace(only_poses=True), SimpleNamespace(only_poses=False)
    assert most_starts(AnnealedSettings(), poses) == 24
    assert most_starts(AnnealedSettings(), lenses) == 8
    assert most_starts(AnnealedSettings(starts=3), poses) == 3


def test_starts_that_agree_are_trusted() -> None:
    assert doubt([start(0, 0.0), start(1, 0.5)]) == ("", ())


def test_residuals_beyond_the_stated_noise_leave_a_reservation() -> None:
    why, (remark,) = doubt([start(0, 0.0, squared=8.0), start(1, 0.5, squared=8.0)])
    assert (why, remark.topic, remark.is_reservation) == ("", "noise", True)
    assert remark.text.startswith("residuals were 2.0 times the expected noise")


def test_a_best_start_that_stands_alone_is_doubted() -> None:
    why, _ = doubt([start(0, 0.0), *(start(k, None) for k in range(1, 8))])
    assert why.startswith("only 1 of 8 starts found these cameras")
    # one that is asked for alone is not, and neither is one beside the full posterior
    assert doubt([start(0, 0.0)], count=1) == ("", ())
    assert doubt([start(0, 0.0), start(1, None)], is_sampled=True)[0] == ""


def test_with_other_unknowns_a_lone_start_is_a_remark() -> None:
    why, (remark,) = doubt([start(0, 0.0), start(1, 3.0, -200.0)], only_moves=False)
    assert why == ""
    assert remark.text.startswith("only 1 of 2 starts found these cameras")
    assert not remark.is_reservation


def test_a_rival_is_named() -> None:
    starts = [start(0, 0.0), start(1, 0.1), start(2, 9.0, -102.0)]
    assert doubt(starts)[0].startswith("starts 0 and 2 agree with the data alike")
    assert rival_of(starts) is starts[2]


def test_what_is_near_or_unlikely_is_no_rival() -> None:
    # 4 standard deviations apart in the root mean square are too near, 6 nats below the best too unlikely
    assert rival_of([start(0, 0.0), start(1, 4.0, -100.5)]) is None
    assert rival_of([start(0, 0.0), start(1, 9.0, -106.0)]) is None
    assert rival_of([start(0, 0.0), start(1, 9.0, -104.0)]) is not None


def test_starts_agree_within_one_standard_deviation_in_the_root_mean_square() -> None:
    assert agree(start(0, 0.0), start(1, 0.99))
    assert not agree(start(0, 0.0), start(1, 1.01))
    assert agree(start(0, 0.0), start(1, 4.9), within=5.0)


def test_a_start_that_leaves_more_open_agrees_as_far_as_both_state() -> None:
    best, other = start(0, 0.0), start(1, 2.2, std=3.0)
    assert agree(best, other)
    assert agree(other, best)
    assert not agree(best, start(1, 2.3, std=3.0))


def test_starts_have_evidence_where_they_do_not_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start_module, "evidence", lambda _, fit: -fit.adjustment.values[0])
    task = cast("Task", None)
    alike = [start(0, None), start(1, 5.0, np.nan), start(2, 5.0, np.nan)]
    assert compared(task, alike) is alike
    assert best_of(alike) is alike[1]
    different = compared(task, [*alike, start(3, 9.0, np.nan), start(4, 5.0, -7.0)])
    assert [one.log_evidence for one in different[1:]] == [-5.0, -5.0, -9.0, -7.0]
    assert best_of(different) is different[1]


def test_the_best_of_each_kind_is_distinct() -> None:
    starts = [start(0, 0.0, -103.0), start(1, 0.2, -101.0), start(2, 8.0, -102.0), start(3, None)]
    assert [s.number for s in distinct(starts)] == [1, 2]
    assert best_of(starts) is starts[1]
    assert best_of([start(0, None)]) is None


def test_the_most_frequent_failure_is_named() -> None:
    assert f"most often (2): {FAILED}" in why_none_succeeded([start(0, None), start(1, None)])


@pytest.mark.parametrize("is_timed", [True, False])
@pytest.mark.parametrize("is_searched", [True, False])
def test_a_remedy_follows_from_what_is_unknown(is_timed: bool, is_searched: bool) -> None:
    """Of cameras from nothing it proposed `pose: unknown`, and to compare clocks that are unknown."""
    said = why_none_succeeded([start(0, None)], is_timed, is_searched)
    assert ("compares clocks" in said, "pose: unknown" in said) == (is_timed, not is_searched)


def test_what_two_cameras_do_not_show_has_a_remedy_to_paste() -> None:
    group = SimpleNamespace(names=("left.focal", "right.focal"), quantity="focal")
    held = SimpleNamespace(group=group, is_contradicted=False, expected_move=0.5, moves=3.0)
    pose = SimpleNamespace(camera="right", name="rotation_x")
    task = SimpleNamespace(parameters=SimpleNamespace(cameras=("left", "right"), parameters=(pose,)))
    believed = cast("Believed", SimpleNamespace(held=(held,), given_up=(), task=task))
    (remark,) = statement_remarks(believed, is_doubted=False)
    assert remark.topic == "sensitivity"
    assert "calibration.priors.left.focal_std and calibration.priors.right.focal_std" in remark.text


def test_of_what_is_contradicted_together_what_is_clear_is_named() -> None:
    group = SimpleNamespace(names=("left.k1", "left.p1", "right.clock_offset"))
    values, stds = np.array([-0.3, 2e-4, -0.02]), np.array([0.02, 1e-3, 0.002])
    suspicion = cast("Suspicion", SimpleNamespace(group=group, values=values, stds=stds))
    assert fitting(suspicion) == "left.k1 -0.3 +- 0.02, right.clock_offset -0.02 +- 0.002"
    assert fitting(suspicion, is_doubted=True) == "another left.k1, right.clock_offset"
    unclear = cast("Suspicion", SimpleNamespace(group=group, values=values, stds=stds + 1.0))
    assert fitting(unclear, is_doubted=True) == "another left.k1, left.p1, right.clock_offset"


@pytest.mark.parametrize(("explained", "origins"), [(0.8, ["pairing 0"]), (0.4, ["pairing 0", "wide"])])
def test_a_start_is_followed_from_its_own_values_where_no_pairing_explains_the_log(
    monkeypatch: pytest.MonkeyPatch, explained: float, origins: list[str]
) -> None:
    begun = list[str]()

    def follow(_task: Task, number: int, origin: str, *_: object) -> Start:
        begun.append(origin)
        return replace(start(number, None), explained=explained, origin=origin)

    monkeypatch.setattr(start_module, "_follow", follow)
    monkeypatch.setattr(start_module, "paired_fit", lambda *_: None)
    settings = SimpleNamespace(min_tracked=0.5)
    task = cast("Task", SimpleNamespace(limit=ENDLESS, most_starts=1, settings=settings))
    found = run_start(task, 0, np.zeros(3), [Pairing(np.zeros(3), np.array([0]), 100.0)])
    assert begun == origins
    assert found.origin == "pairing 0"
