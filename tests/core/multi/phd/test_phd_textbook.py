"""In a linear one-camera case the filter is the textbook's, component by component and to rounding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from stereophd.core.disparity.events import make_event
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.multi.state.mixture import GaussianMixture
from tests.core.multi.phd.textbook import TextbookPhd
from tests.core.multi.scenes import make_filter

WIDTH, HEIGHT = 1000, 800
SIGMA = np.array([1.4, 1.1])
P_DETECT, CLUTTER, BIRTHS, SURVIVAL = 0.9, 4.0, 0.2, 0.97
STEP = 0.5
FRAMES = 25
CAP = 25
TOLERANCE = 1e-10
# Differences over parts of standard deviations of 3e-6 of the disparity leave rounding.
LINEAR_TOLERANCE = 1e-6


@dataclass(frozen=True)
class LinearCase:
    """A camera and motion whose map from frame to frame is linear in disparity space, and its matrices."""

    camera: Camera
    motion: Motion
    baseline: float
    disparity: tuple[float, float]
    velocity_std: float
    transition: np.ndarray
    process: np.ndarray
    velocity_covariance: np.ndarray

    def filter(self, method: str) -> PhdFilter:
        prior = BirthPrior(
            disparity=DisparityPrior(mean_px=self.disparity[0], std_px=self.disparity[1]),
            velocity_std=self.velocity_std,
        )
        return make_filter(
            [self.camera], self.motion, method, 128, prior, BIRTHS, self.baseline, survival_per_s=SURVIVAL,
            prune_weight=1e-6, merge_distance=7.0, max_components=CAP, merge_moments="intensity",
        )  # fmt: skip

    def textbook(self) -> TextbookPhd:
        mean, std = self.disparity
        size = len(self.transition)
        covariance = np.zeros((size, size))
        covariance[:3, :3] = np.diag([*SIGMA**2, std**2])
        covariance[3:, 3:] = self.velocity_covariance
        return TextbookPhd(
            self.transition, self.process, np.diag(SIGMA**2), SURVIVAL**STEP, P_DETECT, CLUTTER, BIRTHS,
            WIDTH * HEIGHT, np.array([mean, 0.0, 0.0, 0.0])[: size - 2], covariance, 1e-6, 7.0, CAP,
        )  # fmt: skip


def linear_camera(focal: tuple[float, float]) -> Camera:
    detector = Detector(SIGMA, P_DETECT, CLUTTER)
    pose = Pose(np.eye(3), np.zeros(3))
    return Camera("only", WIDTH, HEIGHT, *focal, 500.0, 400.0, pose, Lens(), detector)


def static_case() -> LinearCase:
    """Static objects: nothing moves in a camera that stands still, however uncertain the depth."""
    camera = linear_camera((900.0, 880.0))
    return LinearCase(camera, Static(), 1.0, (7.0, 3.0), 1.5, np.eye(3), np.zeros((3, 3)), np.empty((0, 0)))


def moving_case(acceleration: float) -> LinearCase:
    """Objects so far before so long a lens that the change of depth has no effect on (u, v).

    At a distance of fx lengths a velocity of 1 is 1 px/s, and 1e-18 of the distance. With process noise, which
    is multiplied by the disparity, the disparity must be certain for the map to be linear (to 3e-6, of which
    the square counts); without, it may be anything.
    """
    focal = (2.0**60, 0.75 * 2.0**60)
    camera = linear_camera(focal)
    mean, distance = 8.0, 2.0**60
    baseline = mean * distance / focal[0]
    std = 3e-6 * mean if acceleration else 0.1 * mean
    # from the world's axes to px and px/s, at the mean disparity
    scale = np.array([focal[0], focal[1], mean]) / distance
    powers = np.array([1.0, 1.0, -1.0])
    velocity_std = 1.5
    # births: E d^2, E d^3 and E d^4 of the prior, as the velocities in px/s go with d, d and d^2
    cv = std / mean
    second, fourth = 1.0 + cv**2, 1.0 + 6.0 * cv**2 + 3.0 * cv**4
    velocity = np.diag(scale**2 * [second, second, fourth]) * velocity_std**2
    step = np.array([[STEP**3 / 3.0, STEP**2 / 2.0], [STEP**2 / 2.0, STEP]])
    process = np.kron(step, np.diag((scale * powers) ** 2)) * acceleration**2
    transition = np.kron([[1.0, STEP], [0.0, 1.0]], np.eye(3))
    motion = ConstantVelocity([acceleration] * 3)
    return LinearCase(camera, motion, baseline, (mean, std), velocity_std, transition, process, velocity)


def detections(rng: np.random.Generator, speed: float) -> list[np.ndarray]:
    """Frames of four objects that start at different times, with misses and clutter, well inside the image."""
    start = rng.uniform([250.0, 200.0], [750.0, 600.0], (4, 2))
    start[1] = start[0] + [9.0, 4.0]  # two that compete for detections
    velocity = rng.uniform(-speed, speed, (4, 2))
    frames = []
    for k in range(FRAMES):
        alive = np.arange(4)[k >= np.array([0, 0, 5, 9])]
        objects = start[alive] + velocity[alive] * STEP * k
        seen = objects[rng.random(len(objects)) < P_DETECT]
        false = rng.uniform([150.0, 150.0], [850.0, 650.0], (rng.poisson(CLUTTER), 2))
        # now and then a frame without any detection
        frame = np.concatenate([seen + rng.standard_normal(seen.shape) * SIGMA, false])
        frames.append(frame[:0] if k == 13 else frame)
    return frames


def assert_same(
    found: GaussianMixture, expected: list[tuple[float, np.ndarray, np.ndarray]], tolerance: float = TOLERANCE
) -> None:
    """Every component agrees: its weight relatively, its mean and covariance in its standard deviations."""
    assert found.size == len(expected)
    weights = np.array([w for w, _, _ in expected])
    means = np.array([m for _, m, _ in expected])
    covariances = np.array([p for _, _, p in expected])
    std = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    mean_error = np.abs(found.means[:, None] - means) / np.maximum(std, np.abs(means))
    cost = mean_error.max(axis=2) + np.abs(found.weights[:, None] / weights - 1.0)
    rows, columns = linear_sum_assignment(np.minimum(cost, 1.0))
    assert cost[rows, columns].max() <= tolerance
    scale = std[columns][:, :, None] * std[columns][:, None, :]
    error = np.abs(found.covariances[rows] - covariances[columns]) / scale
    assert error.max() <= tolerance


@pytest.mark.parametrize("method", ["qmc", "linear"])
@pytest.mark.parametrize(
    "case",
    [static_case(), moving_case(0.0), moving_case(0.6)],
    ids=["static", "constant velocity", "white acceleration"],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_agrees_with_the_textbook(case: LinearCase, method: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    multi_filter, textbook = case.filter(method), case.textbook()
    state = multi_filter.init()
    components, tolerance = 0, LINEAR_TOLERANCE if method == "linear" else TOLERANCE
    for k, pixels in enumerate(detections(rng, 0.0 if isinstance(case.motion, Static) else 2.0)):
        expected = textbook.step(pixels[np.argsort(pixels[:, 0])])
        event = make_event(case.camera, 0, STEP * k, pixels)
        state, info = multi_filter.update(state, multi_filter.predict(state, event), event)
        assert info.log_likelihood == pytest.approx(expected, rel=tolerance)
        assert info.n_components == len(textbook.mixture)
        assert info.cardinality_mean == pytest.approx(sum(w for w, _, _ in textbook.mixture), rel=tolerance)
        assert_same(state.mixture, textbook.mixture, tolerance)
        components = max(components, info.n_components)
    assert components == CAP  # also the cap is reached
    assert info.cardinality_mean == pytest.approx(4.0, abs=1.5)
