"""Rolling shutter: detections after the time of their frame, in the likelihoods, the updates and the births.

A reading is the delay of a detection and, where the camera moves meanwhile, the change of its pixel with the disparity.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from stereophd.core.disparity.events import make_event
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.disparity.rolling import NO_READINGS
from stereophd.core.multi.association.likelihoods import ALL_PAIRS, REACH_SIGMAS, kalman_updates, pair_likelihoods
from stereophd.core.multi.build import small_filter
from stereophd.core.multi.filter_settings.common import BirthPrior
from tests.core.disparity.cases import LENSES, birth_moments, make_camera, make_space
from tests.core.multi.association.test_likelihoods import pairs_of


def observation(reading: np.ndarray, size: int = 6) -> np.ndarray:
    matrix = np.zeros((2, 6))
    matrix[:, :2], matrix[:, 2], matrix[:, 3:5] = np.eye(2), reading[1:], reading[0] * np.eye(2)
    return matrix[:, :size]


def random_readings(rng: np.random.Generator, count: int) -> np.ndarray:
    """Delays of either sign and changes of tens of pixels: components end up far from where they were."""
    return np.column_stack([rng.uniform(-0.3, 0.7, count), rng.uniform(-3.0, 3.0, (count, 2))])


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("seed", range(4))
def test_pair_likelihoods(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    means, covariances, seen, points, noises, areas = pairs_of(rng, size)
    means[:, 3:] -= 50.0
    readings = random_readings(rng, len(points))
    components, detections, densities = pair_likelihoods(
        means, covariances, seen, points, noises, areas, readings, ALL_PAIRS
    )
    found = np.zeros((len(means), len(points)))
    found[components, detections] = densities
    for k in range(len(means)):
        for j in range(len(points)):
            h = observation(readings[j], size)
            covariance = h @ covariances[k] @ h.T + noises[j]
            difference = points[j] - h @ means[k]
            squared = difference @ np.linalg.solve(covariance, difference)
            # near the end of the reach rounding decides
            if seen[k] and squared < 0.999 * REACH_SIGMAS**2:
                expected = areas[j] * multivariate_normal.pdf(difference, np.zeros(2), covariance)
                assert found[k, j] == pytest.approx(expected, rel=1e-9)
            elif not seen[k] or squared > 1.001 * REACH_SIGMAS**2:
                assert found[k, j] == 0.0
    assert np.count_nonzero(found) > 20


@pytest.mark.parametrize("size", [3, 6])
def test_kalman_updates(size: int) -> None:
    rng = np.random.default_rng(5)
    means, covariances, _, points, noises, _ = pairs_of(rng, size)
    readings = random_readings(rng, len(points))
    components, detections = rng.integers(0, 20, 50), rng.integers(0, 30, 50)
    found_means, found, rows = kalman_updates(means, covariances, components, detections, points, noises, readings)
    found_covariances = found[rows]
    for i, (k, j) in enumerate(zip(components, detections, strict=True)):
        h = observation(readings[j], size)
        gain = covariances[k] @ h.T @ np.linalg.inv(h @ covariances[k] @ h.T + noises[j])
        joseph = np.eye(size) - gain @ h
        expected = joseph @ covariances[k] @ joseph.T + gain @ noises[j] @ gain.T
        np.testing.assert_allclose(found_means[i], means[k] + gain @ (points[j] - h @ means[k]), rtol=1e-9)
        np.testing.assert_allclose(found_covariances[i], expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("size", [3, 6])
def test_no_delay_is_no_delay_to_the_last_bit(size: int) -> None:
    rng = np.random.default_rng(6)
    arrays = pairs_of(rng, size)
    without = pair_likelihoods(*arrays, NO_READINGS, ALL_PAIRS)
    # static objects have not moved, whatever the delay
    readings = np.zeros((30, 3))
    readings[:, 0] = 0.0 if size == 6 else rng.uniform(0.0, 0.1, 30)
    for a, b in zip(without, pair_likelihoods(*arrays, readings, ALL_PAIRS), strict=True):
        np.testing.assert_array_equal(a, b)
    means, covariances, _, points, noises, _ = arrays
    pairs = rng.integers(0, 20, 50), rng.integers(0, 30, 50)
    (one, spreads, rows), (other, other_spreads, other_rows) = (
        kalman_updates(means, covariances, *pairs, points, noises, read) for read in (NO_READINGS, readings)
    )
    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(spreads[rows], other_spreads[other_rows])


def test_kernels_have_no_form_of_their_own_for_rolling_shutters() -> None:
    """Each would be compiled for them, for up to a minute."""
    multi_filter, pixels = small_filter("pmb"), np.array([[700.0, 599.5], [10.0, 0.0]])
    cameras = [replace(multi_filter.rig.cameras[0], readout_s=readout_s) for readout_s in (0.0, 0.03)]
    detections = [multi_filter.detections(make_event(camera, 0, 5.0, pixels))[0] for camera in cameras]
    assert [len(one.readings) for one in detections] == [0, 2]
    assert numba.typeof(detections[0]) == numba.typeof(detections[1])


@pytest.mark.parametrize("lens", ["none", "fisheye"])
@pytest.mark.parametrize("readout_s", [0.03, -0.02])
def test_delays_of_an_event_follow_the_row_in_the_image(lens: str, readout_s: float) -> None:
    camera = replace(make_camera(lens=LENSES[lens]), readout_s=readout_s)
    pixels = np.array([[700.0, 599.5], [10.0, 0.0], [350.0, 300.0]])
    event = make_event(camera, 0, 5.0, pixels)
    assert event.delays is not None
    # ordered by u: rows 0, 300, 599.5 of 600, as distorted
    np.testing.assert_allclose(event.delays, np.array([0.0, 300.0, 599.5]) / 600.0 * readout_s, rtol=1e-12)
    assert make_event(replace(camera, readout_s=0.0), 0, 5.0, pixels).delays is None


def test_births_are_taken_back_to_the_time_of_the_frame() -> None:
    camera = make_camera((0.3, -0.4, 0.2), (5.0, -6.0, 7.0))
    prior = BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=2.0), velocity_std=1.5)
    space = make_space(camera).packed()
    pixels = np.array([[10.0, 15.0], [400.0, 300.0], [790.0, 40.0]])
    means, covariances = birth_moments(make_event(camera, 0, 0.0, pixels), space, prior, 6)
    # a readout of minutes, so that the delay matters at these speeds
    event = make_event(replace(camera, readout_s=20.0), 0, 0.0, pixels)
    assert event.delays is not None
    found_means, found_covariances = birth_moments(event, space, prior, 6)
    np.testing.assert_array_equal(found_means, means)
    for k in range(3):
        back = np.eye(6)
        back[:3, 3:] = -event.delays[k] * np.eye(3)
        np.testing.assert_allclose(found_covariances[k], back @ covariances[k] @ back.T, rtol=1e-12, atol=1e-12)
        # seen again at its own delay it is where it was detected
        h = observation(np.array([event.delays[k], 0.0, 0.0]))
        np.testing.assert_allclose(h @ found_covariances[k] @ h.T, event.covariances[k], rtol=1e-9, atol=1e-9)
