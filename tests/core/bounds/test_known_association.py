"""Least squares with known associations: exact without noise, and honest about its spread with it."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.bounds.known_association import noiseless_paths, sight
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.filter_settings.common import BirthPrior
from tests import scenes

STARTS = np.array([[5.0, -3.0, 120.0], [-10.0, 8.0, 90.0]])
VELOCITIES = np.array([[0.5, 0.2, -0.8], [0.3, -0.4, 1.0]])
TIMES = np.arange(12.0)


def camera(name: str, x: float, lens: Lens) -> Camera:
    """Return one of two parallel cameras."""
    detector = {"noise": (1.0, 2.0), "p_detect": 1.0, "clutter": 0.0}
    return scenes.build_camera(name, [x, 0.0, 0.0], size=(640, 480), focal=500.0, **detector, lens=lens)


def estimate(prior: BirthPrior, noise: float, seed: int, lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states, covariances and what was seen; the second object is not seen in the first three seconds."""
    rng = np.random.default_rng(seed)
    cameras = camera("left", -10.0, lens), camera("right", 10.0, lens)
    parts = []
    first: list[tuple[DisparitySpace, float, np.ndarray] | None] = [None, None]
    for time_s in TIMES.tolist():
        rows = np.arange(2 if time_s >= 3 else 1)
        for one in cameras:
            pixels = one.project(STARTS[rows] + time_s * VELOCITIES[rows])
            pixels = pixels + noise * np.array(one.detector.sigma) * rng.standard_normal(pixels.shape)
            parts.append(sight(one, time_s, pixels, rows))
            for row, point in zip(rows.tolist(), parts[-1].points, strict=True):
                if first[row] is None:
                    first[row] = DisparitySpace(one), time_s, point
    sightings = parts[0].join(*parts[1:])
    return noiseless_paths(sightings, first, prior, TIMES, ConstantVelocity())


@pytest.mark.parametrize("lens", [Lens(), Lens("radial", k1=-0.1)], ids=["pinhole", "radial"])
def test_without_noise_it_finds_the_truth(lens: Lens) -> None:
    # the prior, which pulls towards rest, is too weak to matter
    states, _, seen = estimate(
        BirthPrior(disparity=DisparityPrior(mean_px=5.0, std_px=1e5), velocity_std=1e5), 0.0, 0, lens
    )
    assert seen[:, 0].all()
    assert seen[:, 1].tolist() == [False] * 3 + [True] * 9
    assert np.isnan(states[:3, 1]).all()
    for row in range(2):
        expected = STARTS[row] + TIMES[4:, None] * VELOCITIES[row]
        np.testing.assert_allclose(states[4:, row, :3], expected, atol=1e-4)
        np.testing.assert_allclose(states[4:, row, 3:], np.tile(VELOCITIES[row], (8, 1)), atol=1e-4)


def test_errors_agree_with_the_stated_covariance() -> None:
    prior = BirthPrior(disparity=DisparityPrior(mean_px=5.0, std_px=3.0), velocity_std=1.0)
    squares = []
    for seed in range(60):
        states, covariances, _ = estimate(prior, 1.0, seed, Lens())
        for row in range(2):
            truth = np.concatenate([STARTS[row] + TIMES[-1] * VELOCITIES[row], VELOCITIES[row]])
            error = states[-1, row] - truth
            squares.append(error @ np.linalg.solve(covariances[-1, row], error))
    # 120 values of mean 6 and standard deviation sqrt(12): a standard error of 0.32
    assert np.mean(squares) == pytest.approx(6.0, abs=1.0)
