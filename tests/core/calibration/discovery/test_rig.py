"""Cameras from nothing: found where the motion shows them, and doubted where it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.discovery.rig import Discovery, discover
from stereophd.core.calibration.discovery.tracks import count_pieces
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.geometry.pose import Pose, rotation_to_vector

from .rooms import NOISE, cameras, curved, still, straight, tracks_of, views_of


def found(true: tuple[Camera, ...], paths: list, seed: int = 1, **known) -> Discovery:
    raw = tracks_of(true, paths, np.random.default_rng(seed))
    return discover(views_of(true, **known), raw, 0, np.random.default_rng(0))


def largest_error_deg(discovery: Discovery, true: tuple[Camera, ...]) -> float:
    """Largest error of a rotation, or of the direction of a centre, from the first camera."""
    first, errors = true[0].pose, []
    for one, other in zip(discovery.rig.cameras[1:], true[1:], strict=True):
        turn = other.pose.rotation @ first.rotation.T
        center = first.rotation @ (other.pose.center - first.center)
        cosine = one.pose.center @ center / np.linalg.norm(center) / np.linalg.norm(one.pose.center)
        errors += [np.linalg.norm(rotation_to_vector(one.pose.rotation @ turn.T)), np.arccos(min(cosine, 1.0))]
    return float(np.rad2deg(max(errors)))


def test_two_cameras_before_one_curve() -> None:
    discovery = found(cameras()[:2], [curved(np.random.default_rng(1))])
    rig = discovery.rig
    assert not rig.doubts
    assert np.linalg.norm(rig.cameras[1].pose.center) == pytest.approx(1.0)
    # the target for a focal length within 5 %
    assert largest_error_deg(discovery, cameras()[:2]) < 3.0


def test_straight_tracks_of_several_objects() -> None:
    rng = np.random.default_rng(0)
    discovery = found(cameras()[:2], [straight(rng) for _ in range(5)])
    assert not discovery.rig.doubts
    assert largest_error_deg(discovery, cameras()[:2]) < 3.0


def test_straight_tracks_show_a_clock_where_they_fit_to_their_noise() -> None:
    # seconds later other straight tracks meet to a few pixels
    true, rng = cameras((0.0, 2.7, 0.0))[:2], np.random.default_rng(0)
    discovery = found(true, [straight(rng) for _ in range(5)], clocks=True)
    assert not discovery.rig.doubts
    assert largest_error_deg(discovery, true) < 3.0


def found_seconds_off() -> Discovery:
    return found(cameras((0.0, 2.7, 0.0))[:2], [curved(np.random.default_rng(1))], clocks=True)


@pytest.fixture(scope="module")
def seconds_off() -> Discovery:
    return found_seconds_off()


def test_a_clock_that_is_seconds_off(seconds_off: Discovery) -> None:
    true, rig = cameras((0.0, 2.7, 0.0))[:2], seconds_off.rig
    assert not rig.doubts
    assert rig.cameras[1].clock.offset_s == pytest.approx(2.7, abs=0.02)
    assert largest_error_deg(seconds_off, true) < 3.0


def test_three_cameras_have_one_scale() -> None:
    rng = np.random.default_rng(2)
    true = cameras()
    discovery = found(true, [curved(rng) for _ in range(3)])
    rig = discovery.rig
    assert not rig.doubts
    assert largest_error_deg(discovery, true) < 4.0
    lengths = [float(np.linalg.norm(camera.pose.center)) for camera in rig.cameras[1:]]
    expected = [float(np.linalg.norm(camera.pose.center)) for camera in true[1:]]
    assert lengths[0] / lengths[1] == pytest.approx(expected[0] / expected[1], rel=0.04)


def test_objects_that_stand_still_show_nothing() -> None:
    rng = np.random.default_rng(3)
    discovery = found(cameras()[:2], [still(rng) for _ in range(4)])
    assert discovery.rig is None
    assert "nothing moves before cam0, cam1" in discovery.reason


def test_one_straight_line_is_not_believed() -> None:
    for seed in range(3):
        discovery = found(cameras()[:2], [straight(np.random.default_rng(seed))])
        assert discovery.reason or discovery.rig.doubts


def test_cameras_at_one_place_are_named() -> None:
    rng = np.random.default_rng(4)
    first, second = cameras()[:2]
    turned = replace(second, pose=Pose(second.pose.rotation @ second.pose.rotation.T, first.pose.center))
    discovery = found((first, turned), [curved(rng) for _ in range(3)])
    assert any("stand at one place" in doubt for doubt in discovery.rig.doubts)


def test_no_common_times() -> None:
    true = cameras()[:2]
    raw = tracks_of(true, [curved(np.random.default_rng(5))], np.random.default_rng(1))
    late = replace(raw, log_times=raw.log_times + np.where(raw.cameras == 1, 100.0, 0.0).repeat(np.diff(raw.first)))
    discovery = discover(views_of(true), late, 0, np.random.default_rng(0))
    assert discovery.rig is None
    assert "no tracks of cam1 agree with those of cam0" in discovery.reason


def test_the_same_tracks_give_the_same_cameras(seconds_off: Discovery) -> None:
    one, other = seconds_off.rig.cameras[1], found_seconds_off().rig.cameras[1]
    np.testing.assert_array_equal(one.pose.rotation, other.pose.rotation)
    assert one.clock == other.clock
    assert isinstance(one.clock, Clock)


@pytest.mark.parametrize(("turns", "least", "most"), [(0.0, 1, 1), (3.0, 4, 20)])
def test_pieces_of_a_curve(turns: float, least: int, most: int) -> None:
    times = np.linspace(0.0, 10.0, 300)
    angle = 2.0 * np.pi * turns * times / 10.0
    pixels = np.column_stack([200.0 * np.sin(angle) + 20.0 * times, 200.0 * np.cos(angle)])
    pixels += NOISE * np.random.default_rng(0).standard_normal(pixels.shape)
    assert least <= count_pieces(times, pixels, 3.0) <= most
