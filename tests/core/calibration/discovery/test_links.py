"""Cameras joined by pairs: the pose for which several pairs speak, and optima that chance made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.discovery import rig, two_cameras
from stereophd.core.calibration.discovery.essential import essential_of
from stereophd.core.calibration.discovery.pair_fit import SIZE, PairFit, PairPrior, PairState
from stereophd.core.calibration.discovery.pair_search import Hypothesis
from stereophd.core.calibration.discovery.tracks import slope_tracks
from stereophd.core.calibration.discovery.two_cameras import Link, PairResult
from stereophd.core.calibration.discovery.verdict import doubts_of_pair, sentences
from stereophd.core.geometry.pose import Pose, rotation_from_vector

from .rooms import cameras, curved, tracks_of, views_of

NAMES = ("cam0", "cam1", "cam2")
X, Y = np.eye(3)[:2]


def optimum(turn: float, gain: float, offset: float = 0.0, front: float = 1.0, std: float = 0.01) -> PairFit:
    """An optimum that turns the second camera by an angle, rad, about y, and is known to a deviation."""
    state = PairState(rotation_from_vector(turn * Y), X, offset, 1.0, 0.0, np.ones(2), np.zeros(2))
    nothing = np.empty((0, 3))
    return PairFit(state, 2.5, gain, 9.0, front, np.full(SIZE, std), nothing[:, :2], nothing, nothing, 1.0, 0.2)


def joined(results: dict[tuple[int, int], PairResult]) -> tuple:
    """Doubts, pair and place of the third camera; the second is turned by 0.3 rad, and its clock 2 s late."""
    start = rig._Place(np.eye(3), 0.0, 1.0, np.zeros(3), ())
    placed = {0: start, 1: start.of_other(optimum(0.3, 1.0, 2.0), 0, is_second=True)}
    return rig._link(results, placed, 2, NAMES)


def test_two_optima_of_one_pair_are_doubted() -> None:
    results = {(0, 2): PairResult((optimum(0.8, 20.0, 5.0), optimum(-0.5, 15.0, 5.0)), 0.1)}
    doubts, pair, _ = joined(results)
    assert pair.gains == pytest.approx((20.0, 15.0))
    assert "another pose of cam0 and cam2 explains 75 % as much, turned by 74 degrees" in doubts[0][0]


def test_a_remedy_is_said_once_of_all_cameras() -> None:
    few, one = replace(optimum(0.8, 20.0), pieces=1.5), 0.1
    doubts = [
        doubt
        for two in ((0, 1), (0, 2), (0, 1))
        for doubt in doubts_of_pair(Link(two, replace(few, parallax=one), (18.0, 2.0), (1.0, 0.0), 1, 0), NAMES)
    ]
    (said,) = sentences(doubts)
    assert said.count("record objects that turn") == 1
    assert [said.count(f"cam0 and {name} share") for name in ("cam1", "cam2")] == [1, 1]


def test_what_follows_from_tracks_that_agree_by_chance_is_not_said() -> None:
    """Residuals, another optimum and other pairs followed in nine clauses."""
    by_chance = replace(optimum(0.8, 20.0), front=0.6, residual=4.0)
    ((what, remedy),) = doubts_of_pair(Link((0, 1), by_chance, (12.0, 10.0), (1.0, 0.5), 1, 2), NAMES)
    assert what == "the tracks of cam0 and cam1 agree by chance (60 % of the points lie in front of both)"
    assert remedy.startswith("record the same moving objects with both")


@pytest.mark.parametrize("is_stated", [True, False])
def test_a_remedy_names_a_clock_or_a_lens_only_where_it_is_stated(is_stated: bool) -> None:
    """Cameras whose clocks are known were to "state the clock"."""
    best = optimum(0.8, 20.0)
    best = replace(best, stds=best.stds * (np.arange(SIZE) < 5) if is_stated else best.stds, residual=4.0)
    link = Link((0, 1), best, (12.0, 10.0), (1.0, 0.5), 2, 0)
    (_, unlike), (another, remedy) = doubts_of_pair(link, NAMES)
    assert ("a clock" in unlike, "a lens" in unlike) == (is_stated, is_stated)
    assert ("state the clock" in remedy, "0.50 s away" in another) == (not is_stated, not is_stated)


def test_another_pair_decides_between_two_optima() -> None:
    results = {
        (0, 2): PairResult((optimum(0.8, 16.0, 5.0), optimum(-0.5, 15.0, 5.0)), 0.1),
        (1, 2): PairResult((optimum(-0.8, 19.0, 3.0, std=0.001), optimum(1.5, 12.0, 3.0)), 0.1),
    }
    doubts, pair, place = joined(results)
    assert not doubts
    assert pair.gains == pytest.approx((15.0 + 19.0, 16.0))
    assert pair.agreeing == 2
    np.testing.assert_allclose(place.rotation, rotation_from_vector(-0.5 * Y), atol=1e-9)
    assert place.later == pytest.approx(5.0)


def test_a_pair_whose_depths_are_wrong_speaks_for_its_turn_and_clock() -> None:
    results = {
        (0, 2): PairResult((optimum(0.8, 20.0, 5.0, front=0.7),), 0.1),
        (1, 2): PairResult((optimum(0.5, 19.0, 3.0),), 0.1),
    }
    doubts, pair, _ = joined(results)
    assert not doubts
    assert (pair.cameras, pair.agreeing, pair.opposed) == ((1, 2), 2, 0)


def test_optima_without_points_in_front_gain_nothing_beside_one_that_both_agree_with() -> None:
    """The group about such an optimum was the first of two equal ones: a ZeroDivisionError ended the command."""
    nothing = (optimum(0.3, 20.0, 5.0, front=0.0, std=0.5), optimum(1.5, 15.0, 5.0, front=0.0, std=0.8))
    results = {(0, 2): PairResult(nothing, 0.1), (1, 2): PairResult((optimum(0.5, 40.0, 3.0),), 0.1)}
    doubts, pair, _ = joined(results)
    assert not doubts
    assert (pair.cameras, pair.gains) == ((1, 2), (40.0, 0.0))
    assert "explains 0 % as much" in doubts_of_pair(replace(pair, gains=(0.0, 0.0)), NAMES)[0][0]


def test_a_clock_that_differs_is_another_pose() -> None:
    results = {
        (0, 2): PairResult((optimum(0.8, 20.0, 5.0),), 0.1),
        (1, 2): PairResult((optimum(0.5, 19.0, 4.0),), 0.1),
    }
    doubts, pair, _ = joined(results)
    assert (pair.agreeing, pair.opposed) == (1, 1)
    assert "+1.00 s away" in doubts[0][0]
    assert "contradicts other pairs of cameras (1)" in doubts[1][0]


def test_optima_of_the_pairs_that_agree_move_the_camera_otherwise() -> None:
    same = PairResult((optimum(0.8, 20.0, 5.0), optimum(0.8, 12.0, 5.0)), 0.1)
    other = PairResult((optimum(0.5, 10.0, 3.0),), 0.1)
    assert joined({(0, 2): same})[1].gains == pytest.approx((20.0, 12.0))
    assert joined({(0, 2): same, (1, 2): other})[1].gains == pytest.approx((30.0, 12.0))


def test_what_two_poses_share_counts_for_neither() -> None:
    # the second pair is 6 degrees from either optimum of the first, and says nothing of which is right
    results = {
        (0, 2): PairResult((optimum(0.8, 20.0, 5.0), optimum(0.59, 12.0, 5.0)), 0.1),
        (1, 2): PairResult((optimum(0.395, 30.0, 3.0),), 0.1),
    }
    doubts, pair, _ = joined(results)
    assert pair.agreeing == 2
    assert pair.gains == pytest.approx((20.0, 12.0))
    assert "another pose of" in doubts[0][0]


def test_optima_that_move_the_camera_apart_are_two_poses() -> None:
    results = {
        (0, 2): PairResult((optimum(0.8, 20.0, 5.0), optimum(0.66, 15.0, 5.0)), 0.1),
        (1, 2): PairResult((optimum(0.5, 20.0, 3.0), optimum(0.64, 15.0, 3.0)), 0.1),
    }
    assert joined(results)[1].gains == pytest.approx((40.0, 15.0))


def test_one_open_pair_is_doubted_and_two_are_not() -> None:
    wide = PairResult((optimum(0.8, 20.0, 5.0, std=0.2),), 0.1)
    assert "open by 11.5 degrees in rotation" in joined({(0, 2): wide})[0][0][0]
    other = PairResult((optimum(0.5, 10.0, 3.0, std=0.2),), 0.1)
    assert not joined({(0, 2): wide, (1, 2): other})[0]


@pytest.mark.parametrize(("gain", "is_believed"), [(14.0, True), (21.0, False)])
def test_an_optimum_with_points_behind_the_cameras_shows_what_chance_gains(gain: float, is_believed: bool) -> None:
    """Two cameras without a common object were believed: the others of their optima had points behind a camera."""
    results = {(0, 2): PairResult((optimum(0.8, 20.0, 5.0), optimum(-0.5, gain, 5.0, front=0.6)), 0.1)}
    doubts, pair, _ = joined(results)
    assert pair.gains == pytest.approx((20.0, 0.6 * gain))
    assert (not doubts) == is_believed


@pytest.mark.parametrize(
    ("gain", "other", "is_believed"), [(27.0, 16.0, True), (14.0, 5.0, False), (90.0, 75.0, False)]
)
def test_a_lead_is_one_over_chance_and_a_part_of_the_gain(gain: float, other: float, is_believed: bool) -> None:
    results = {(0, 2): PairResult((optimum(0.8, gain, 5.0), optimum(-0.5, other, 5.0)), 0.1)}
    assert (not joined(results)[0]) == is_believed


def test_the_optimum_leads_whose_points_in_front_of_both_cameras_gain_most(monkeypatch: pytest.MonkeyPatch) -> None:
    true = cameras()[:2]
    found = slope_tracks(
        [view.camera for view in views_of(true)],
        tracks_of(true, [curved(np.random.default_rng(1))], np.random.default_rng(1)),
    )
    optima = {0.0: optimum(0.0, 10.0), 5.0: optimum(0.0, 15.0, front=0.6), 9.0: optimum(0.0, 20.0, front=0.6)}
    hypotheses = [Hypothesis(essential_of(np.eye(3), X), offset, 1.0) for offset in optima]
    monkeypatch.setattr(two_cameras.PairSearch, "hypotheses", lambda *_: hypotheses)
    monkeypatch.setattr(
        two_cameras.PairProblem, "fitted", lambda _, state, __: replace(optima[state.offset_s], state=state)
    )
    prior = PairPrior(offset_is_known=False, rate_std=0.0, focal_std=(0.0, 0.0), lens_unknown=(False, False))
    result = two_cameras.find_pair(found, (0, 1), prior, 0.0, np.random.default_rng(0))
    assert [fit.gain for fit in result.fits] == [20.0, 10.0, 15.0]


def test_two_pairs_that_agree_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def find(tracks, two, *rest):
        searched.append(two)
        return two_cameras.find_pair(tracks, two, *rest)

    monkeypatch.setattr(rig, "find_pair", find)
    rng = np.random.default_rng(2)
    true = (*cameras(), replace(cameras()[1], name="cam3", pose=cameras()[1].pose))
    true = (*true[:3], replace(true[3], pose=Pose(true[3].pose.rotation, true[3].pose.center + [-2.0, 0.5, -1.0])))
    raw = tracks_of(true, [curved(rng) for _ in range(3)], np.random.default_rng(1))
    discovery = rig.discover(views_of(true), raw, 1, np.random.default_rng(0))
    assert not discovery.reason
    assert searched == [(0, 1), (1, 2), (0, 2), (1, 3), (0, 3)]


@pytest.mark.parametrize(("missed", "behind"), [((0, 2), None), ((1, 2), (0, 1))])
def test_an_optimum_that_the_search_of_a_pair_missed_is_found_where_the_others_place_the_camera(
    monkeypatch: pytest.MonkeyPatch, missed: tuple[int, int], behind: tuple[int, int] | None
) -> None:
    def find(tracks, two, *rest):
        result = two_cameras.find_pair(tracks, two, *rest)
        if two == behind:
            result = replace(result, fits=tuple(replace(fit, front=0.9) for fit in result.fits))
        return PairResult(result.fits[1:], result.step) if two == missed else result

    monkeypatch.setattr(rig, "find_pair", find)
    rng = np.random.default_rng(2)
    raw = tracks_of(cameras(), [curved(rng) for _ in range(3)], np.random.default_rng(1))
    discovery = rig.discover(views_of(cameras()), raw, 1, np.random.default_rng(0))
    assert not discovery.reason
    assert discovery.rig is not None
    assert discovery.rig.pairs[1].agreeing == 2
