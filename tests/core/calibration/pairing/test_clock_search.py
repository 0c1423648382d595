"""Offsets of clocks from speed profiles: found where objects speed up and slow down, left open where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.pairing.clock_search import search_offsets
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.two_views.track_rays import RawTracks
from tests.scenes import AROUND, build_camera

RATES = (10.0, 7.0, 5.0)
TRUE = (0.0, 2.3, -1.1)


def cameras() -> tuple[Camera, ...]:
    """Three cameras around a stage, their clocks unknown by seconds."""
    same = {"noise": 0.5, "p_detect": 1.0, "clutter": 0.0}
    return tuple(
        build_camera(f"cam{k}", *place, **same, frame_rate_hz=rate)
        for k, (place, rate) in enumerate(zip(AROUND, RATES, strict=True))
    )


def tracks(uniform: bool) -> RawTracks:
    """Two objects for a minute; each is one track of each camera, the clocks of which are off by `TRUE`."""
    rng = np.random.default_rng(1)
    of_camera, first, times, pixels = [], [0], [], []
    phase, pace = rng.uniform(0.0, 6.0, (2, 3, 3)), rng.uniform(0.2, 1.2, (2, 3, 3))
    for k, camera in enumerate(cameras()):
        for j in range(2):
            log_times = np.arange(0.0, 60.0, 1.0 / RATES[k])
            true = TRUE[k] + log_times
            path = 0.7 * np.sin(pace[j] * true[:, None, None] + phase[j]).sum(axis=1)
            if uniform:
                path = np.array([0.02, 0.01, 0.0]) * true[:, None] * (1.0 - 2.0 * j)
            seen = camera.project(path) + 0.5 * rng.standard_normal((len(true), 2))
            of_camera.append(k)
            times.append(log_times)
            pixels.append(seen)
            first.append(first[-1] + len(seen))
    joined = np.concatenate(pixels)
    return RawTracks(np.array(of_camera), np.array(first), np.concatenate(times), joined, joined[:, 1] / 600.0)


def parameters() -> ParameterSet:
    return ParameterSet(cameras(), tuple(Parameter("clock_offset", f"cam{k}", 0.0, 2.0) for k in (1, 2)))


def test_offsets_of_seconds_are_found() -> None:
    found = search_offsets(parameters(), tracks(uniform=False))
    # to two steps of the slowest camera: pairing and adjustment refine it
    np.testing.assert_allclose(found.offsets, TRUE, atol=0.4)
    assert found.scores[0] == 0.0
    assert (found.scores[1:] > 6.0).all()


def test_a_prior_far_wider_than_the_log() -> None:
    """Only shifts at which tracks overlap are tried."""
    wide = ParameterSet(cameras(), tuple(Parameter("clock_offset", f"cam{k}", 0.0, 1e12) for k in (1, 2)))
    np.testing.assert_allclose(search_offsets(wide, tracks(uniform=False)).offsets, TRUE, atol=0.4)


def test_uniform_motion_shows_no_clock() -> None:
    found = search_offsets(parameters(), tracks(uniform=True))
    np.testing.assert_array_equal(found.offsets, 0.0)
    np.testing.assert_array_equal(found.scores, 0.0)


def test_offsets_are_those_from_the_prior_mean() -> None:
    guess = tuple(replace(camera, clock=Clock(0.5 if k else 0.0)) for k, camera in enumerate(cameras()))
    found = search_offsets(replace(parameters(), cameras=guess), tracks(uniform=False))
    assert found.offsets[1:] + 0.5 == pytest.approx(TRUE[1:], abs=0.4)
