"""Filters and mixtures that the tests of many objects share."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.disparity.events import Event, Rig, make_rig
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.base import DisparityFilter, FilterState, Prediction
from stereophd.core.multi.births.undetected import Undetected, all_undetected
from stereophd.core.multi.filter_settings.common import BirthPrior, Hysteresis
from stereophd.core.multi.filter_settings.phd import PhdSettings
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.multi.state.mixture import GaussianMixture
from tests.core.disparity.cases import make_camera, random_covariance
from tests.core.disparity.moves import sample_sets

# Births of the filters below, in every frame.
BIRTHS = 0.1
PRIOR = BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=3.0), velocity_std=1.5)


Filter = TypeVar("Filter", bound=DisparityFilter)


def with_births(multi_filter: Filter, count: float) -> Filter:
    """The filter, which expects as many new objects in every frame, whatever the frames before have shown."""

    def expected(undetected: Undetected | None, elapsed: float, event: Event) -> tuple[float, Undetected, int]:
        return count, undetected or all_undetected(len(multi_filter.rig.cameras)), 0

    def predicted(state: FilterState, event: Event, births: Any = None) -> Prediction:
        return DisparityFilter.predict(multi_filter, state, event, births or expected(state.undetected, 0.0, event))

    def stepped(state: FilterState, event: Event) -> tuple[FilterState, Info, Estimates]:
        return DisparityFilter.step(multi_filter, state, event)

    object.__setattr__(multi_filter, "expected_births", expected)
    object.__setattr__(multi_filter, "predict", predicted)
    object.__setattr__(multi_filter, "step", stepped)
    return multi_filter


def make_filter(
    cameras: list[Camera] | None = None,
    motion: Motion | None = None,
    method: str = "qmc",
    samples: int = 64,
    birth: BirthPrior = PRIOR,
    births: float = BIRTHS,
    baseline: float = 1.0,
    hysteresis: Hysteresis | None = None,
    threads: int = 1,
    **settings: object,
) -> PhdFilter:
    """A filter; by default of two cameras at -20 and 20, turned inward by 15 degrees."""
    if cameras is None:
        cameras = [make_camera((0.0, -0.26, 0.0), (-20.0, 0.0, 0.0)), make_camera((0.0, 0.26, 0.0), (20.0, 0.0, 0.0))]
    motion = ConstantVelocity([0.01] * 3, 6.0) if motion is None else motion
    rig: Rig = make_rig(cameras, baseline, "horizontal")
    sets = sample_sets(method, samples, motion, seed=7)
    values = {
        "survival_per_s": 0.99,
        "birth": birth,
        "extraction": hysteresis or Hysteresis(confirm=0.5, release=0.5),
        **settings,
    }
    return with_births(PhdFilter(rig, motion, sets, PhdSettings(**values), threads), births)  # type: ignore[arg-type]


def make_mixture(
    weights: ArrayLike,
    means: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    cameras: ArrayLike | None = None,
    times: ArrayLike | None = None,
    labels: ArrayLike | None = None,
    tracks: ArrayLike | None = None,
    reported: ArrayLike | None = None,
    size: int = 6,
) -> GaussianMixture:
    """A mixture; what is not given is camera 0, time 0, labels 0, 1, 2..., never reported."""
    weights = np.asarray(weights, dtype=float)
    count = len(weights)

    def integers(values: ArrayLike | None, default: np.ndarray) -> np.ndarray:
        return default if values is None else np.asarray(values, dtype=np.int64)

    return GaussianMixture(
        weights,
        np.zeros((count, size)) if means is None else np.asarray(means, dtype=float),
        np.stack([np.eye(size)] * count) if covariances is None else np.asarray(covariances, dtype=float),
        integers(cameras, np.zeros(count, dtype=np.int64)),
        np.zeros(count) if times is None else np.asarray(times, dtype=float),
        integers(labels, np.arange(count)),
        integers(tracks, np.full(count, -1)),
        np.zeros(count, dtype=bool) if reported is None else np.asarray(reported, dtype=bool),
    )


def random_mixture(
    rng: np.random.Generator, count: int, size: int = 6, charts: int = 3, spread: float = 3.0
) -> GaussianMixture:
    """Overlapping components, at home in some cameras at some times."""
    return make_mixture(
        rng.gamma(0.5, 0.4, count),
        rng.standard_normal((count, size)) * spread,
        [random_covariance(rng, rng.uniform(0.3, 2.0, size)) for _ in range(count)],
        rng.integers(0, charts, count),
        rng.integers(0, 2, count).astype(float),
        rng.integers(0, count, count),
        rng.integers(-1, count, count),
        rng.random(count) < 0.5,
    )
