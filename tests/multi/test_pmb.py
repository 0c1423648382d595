"""The Poisson multi-Bernoulli filter: by hand, against plain NumPy, tracks through misses, evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from stereophd.disparity.samples import draw_sample_sets
from stereophd.disparity.space import DisparitySpace
from stereophd.geometry.camera import Camera
from stereophd.motion import ConstantVelocity, Motion, Static
from stereophd.multi.base import FilterState
from stereophd.multi.birth import BirthPrior
from stereophd.multi.events import Event, make_event, make_rig
from stereophd.multi.extract import Hysteresis
from stereophd.multi.intensity import UNLABELLED, Estimates, GaussianMixture, Info
from stereophd.multi.pmb import PmbFilter, PmbSettings, mix_gaussians
from tests.disparity.cases import make_camera, random_covariance, state_in, weighted
from tests.multi.scenes import PRIOR, make_mixture
from tests.multi.test_phd_textbook import (
    BIRTHS, CLUTTER, HEIGHT, P_DETECT, SIGMA, STEP, SURVIVAL, WIDTH, LinearCase, detections, moving_case, static_case,
)  # fmt: skip
from tests.multi.textbook import Component
from tests.multi.textbook_pmb import TextbookPmb

AREA = 800.0 * 600.0
TRUTH = np.array([[5.0, 3.0, 100.0], [-10.0, -8.0, 140.0], [12.0, 6.0, 180.0]])
NO_DETECTIONS = np.empty((0, 2))
Step = tuple[FilterState, Info, Estimates]
Frames = list[tuple[float, int, np.ndarray]]


def make_pmb(
    cameras: list[Camera] | None = None,
    motion: Motion | None = None,
    method: str = "qmc",
    samples: int = 64,
    birth: BirthPrior = PRIOR,
    threads: int = 1,
    **options: object,
) -> PmbFilter:
    """A filter; by default of two cameras at -20 and 20, turned inward by 15 degrees."""
    if cameras is None:
        cameras = [make_camera((0.0, -0.26, 0.0), (-20.0, 0.0, 0.0)), make_camera((0.0, 0.26, 0.0), (20.0, 0.0, 0.0))]
    motion = ConstantVelocity([0.01] * 3, 6.0) if motion is None else motion
    rows = 3 if isinstance(motion, Static) else 12
    sets = draw_sample_sets(method, samples, rows, np.random.SeedSequence(7))  # type: ignore[arg-type]
    values = {"survival_per_s": 0.99, "birth": birth, "hysteresis": Hysteresis(0.9, 0.02), **options}
    return PmbFilter(make_rig(cameras, 1.0, "horizontal"), motion, sets, PmbSettings(**values), threads)  # type: ignore[arg-type]


def state_of(mixture: GaussianMixture, time_s: float = 0.0) -> FilterState:
    return FilterState(mixture, time_s, 1, 100, 50)


def one_track(multi_filter: PmbFilter, existence: float, world: ArrayLike, camera: int = 0, **named: object) -> FilterState:
    """A state with one track at a place, known to 3 px and 0.5 px of disparity."""
    rig = multi_filter.rig
    space = DisparitySpace(rig.cameras[camera], rig.baseline, rig.rectification)
    covariance = np.diag([3.0, 3.0, 0.5]) ** 2
    mixture = make_mixture(
        [existence], state_in(space, world)[None], covariance[None], [camera], [0.0], size=3, **named  # type: ignore[arg-type]
    )
    return state_of(mixture)


def update(multi_filter: PmbFilter, state: FilterState, event: Event) -> tuple[FilterState, Info]:
    return multi_filter.update(state, multi_filter.predict(state, event), event)


def run(multi_filter: PmbFilter, frames: Frames) -> list[Step]:
    state, out = multi_filter.init(), []
    for time_s, camera, pixels in frames:
        event = make_event(multi_filter.rig.cameras[camera], camera, time_s, pixels)
        state, info, estimates = multi_filter.step(state, event)
        out.append((state, info, estimates))
    return out


def made_up_frames(
    multi_filter: PmbFilter, count: int = 24, seed: int = 3, missed: tuple[int, ...] = (), p_detect: float = 0.95
) -> Frames:
    """Three moving objects, misses and clutter, cameras in turn; in the frames `missed` clutter only."""
    rng = np.random.default_rng(seed)
    velocity = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -0.5], [-1.0, 0.5, 0.0]])
    frames = []
    for k in range(count):
        camera, time_s = k % len(multi_filter.rig.cameras), 0.5 * k
        pixels = multi_filter.rig.cameras[camera].project(TRUTH + velocity * time_s)
        pixels = pixels + rng.standard_normal(pixels.shape)
        seen = (rng.random(3) < p_detect) & (k not in missed)
        clutter = rng.uniform([0.0, 0.0], [799.0, 599.0], (rng.poisson(4.0), 2))
        frames.append((time_s, camera, np.concatenate([pixels[seen], clutter])))
    return frames


def gaussian(residual: np.ndarray, covariance: np.ndarray) -> float:
    exponent = -0.5 * residual @ np.linalg.solve(covariance, residual)
    return float(np.exp(exponent) / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance))))


# One camera, static objects: prediction is the identity, and all can be written down.

W, PD, LAMBDA, B = 0.8, 0.9, 3.0, PRIOR.per_frame


def by_hand() -> tuple[PmbFilter, FilterState]:
    multi_filter = make_pmb([make_camera(p_detect=PD, clutter=LAMBDA)], Static(), survival_per_s=1.0)
    return multi_filter, one_track(multi_filter, W, [2.0, -3.0, 100.0])


def test_one_track_and_two_detections_by_hand() -> None:
    """Existence, state, births and log-likelihood of a track, its detection and one far from it."""
    multi_filter, state = by_hand()
    mean, covariance = state.mixture.means[0], state.mixture.covariances[0]
    noise = np.diag(np.square(multi_filter.rig.cameras[0].detector.sigma))
    z, far = mean[:2] + [4.0, -2.0], np.array([100.0, 500.0])
    new, info = update(multi_filter, state, make_event(multi_filter.rig.cameras[0], 0, 1.0, np.array([z, far])))

    innovation = covariance[:2, :2] + noise
    density = gaussian(z - mean[:2], innovation)
    born, other = PD * B / AREA, (LAMBDA + PD * B) / AREA
    # three ways: the track made z; it was missed (or is not) and z is clutter or new
    detected, not_detected = PD * W * density, (1.0 - PD * W) * other
    total = detected + not_detected
    assert info.log_likelihood == pytest.approx(np.log(total) + np.log(other) - LAMBDA - PD * B, rel=1e-12)

    old = int(np.flatnonzero(new.mixture.labels == 0)[0])
    still = (1.0 - PD) * W * other / total
    assert new.mixture.weights[old] == pytest.approx(detected / total + still, rel=1e-12)
    gain = covariance[:, :2] @ np.linalg.inv(innovation)
    updated = mean + gain @ (z - mean[:2])
    share = detected / total
    both, spread = weighted(np.array([updated, mean]), np.array([share, still]))
    spread = spread + (share * (covariance - gain @ covariance[:2]) + still * covariance) / (share + still)
    np.testing.assert_allclose(new.mixture.means[old], both, rtol=1e-10)
    np.testing.assert_allclose(new.mixture.covariances[old], spread, rtol=1e-9, atol=1e-12)
    assert (new.mixture.cameras[old], new.mixture.times[old]) == (0, 1.0)

    newborn = int(np.flatnonzero(new.mixture.labels >= 100)[0])
    assert new.mixture.weights[newborn] == pytest.approx(born / other, rel=1e-12)
    np.testing.assert_allclose(new.mixture.means[newborn], [*far, 7.0])
    np.testing.assert_allclose(new.mixture.covariances[newborn], np.diag([*np.diag(noise), 9.0]))
    # the other newborn would be z unclaimed: improbable, so it joins the undetected or is dropped
    left = not_detected / total * born / other
    assert left < 1e-3
    rest = np.setdiff1d(np.arange(len(new.mixture)), [old, newborn])
    assert (new.mixture.labels[rest] == UNLABELLED).all()
    np.testing.assert_allclose(new.mixture.weights[rest], [left] if left >= 1e-4 else [], rtol=1e-9)
    assert info.cardinality_mean == pytest.approx(new.mixture.weights[[old, newborn]].sum(), rel=1e-12)
    assert info.n_components == len(new.mixture)
    assert new.next_label == 102


def test_a_missed_track_by_hand() -> None:
    multi_filter, state = by_hand()
    new, info = update(multi_filter, state, make_event(multi_filter.rig.cameras[0], 0, 1.0, NO_DETECTIONS))
    assert info.log_likelihood == pytest.approx(np.log(1.0 - PD * W) - LAMBDA - PD * B, rel=1e-12)
    assert new.mixture.weights[0] == pytest.approx((1.0 - PD) * W / (1.0 - PD * W), rel=1e-12)
    np.testing.assert_allclose(new.mixture.means[0], state.mixture.means[0], rtol=1e-12)


@pytest.mark.parametrize("place", [0.0, 200.0], ids=["detected", "not detected"])
def test_an_undetected_object_by_hand(place: float) -> None:
    """The Poisson intensity: its detection starts a track that knows what the intensity knew."""
    multi_filter, state = by_hand()
    weight = 5e-3
    state = replace(state, mixture=replace(state.mixture, weights=np.array([weight]), labels=np.array([UNLABELLED])))
    mean, covariance = state.mixture.means[0], state.mixture.covariances[0]
    noise = np.diag(np.square(multi_filter.rig.cameras[0].detector.sigma))
    z = mean[:2] + [1.0 + place, 1.0]
    new, info = update(multi_filter, state, make_event(multi_filter.rig.cameras[0], 0, 0.0, z[None]))
    innovation = covariance[:2, :2] + noise
    density = gaussian(z - mean[:2], innovation)
    born, recycled = PD * B / AREA, PD * weight * density
    total = LAMBDA / AREA + born + recycled
    assert info.log_likelihood == pytest.approx(np.log(total) - LAMBDA - PD * B - PD * weight, rel=1e-12)
    track = int(np.flatnonzero(new.mixture.labels == 100)[0])
    assert new.mixture.weights[track] == pytest.approx((born + recycled) / total, rel=1e-12)
    gain = covariance[:, :2] @ np.linalg.inv(innovation)
    updated = mean + gain @ (z - mean[:2])
    weights = np.array([born, recycled]) / (born + recycled)
    center, spread = weighted(np.array([[*z, 7.0], updated]), weights)
    spread = spread + weights[0] * np.diag([*np.diag(noise), 9.0]) + weights[1] * (covariance - gain @ covariance[:2])
    np.testing.assert_allclose(new.mixture.means[track], center, rtol=1e-9)
    np.testing.assert_allclose(new.mixture.covariances[track], spread, rtol=1e-9, atol=1e-9)
    rest = int(np.flatnonzero(new.mixture.labels == UNLABELLED)[0])
    assert new.mixture.weights[rest] == pytest.approx((1.0 - PD) * weight, rel=1e-12)


@pytest.mark.parametrize("clutter", [0.0, 1e-6])
def test_certain_detection_and_no_clutter_stay_finite(clutter: float) -> None:
    """p_detect 1, existence 1, no clutter: the odds are as high as they get."""
    multi_filter = make_pmb([make_camera(p_detect=1.0, clutter=clutter)], Static(), survival_per_s=1.0)
    state = one_track(multi_filter, 1.0, [2.0, -3.0, 100.0])
    for pixels in (NO_DETECTIONS, state.mixture.means[:, :2], state.mixture.means[:, :2] + 40.0):
        new, info = update(multi_filter, state, make_event(multi_filter.rig.cameras[0], 0, 1.0, pixels))
        assert np.isfinite(info.log_likelihood)
        assert np.isfinite(new.mixture.means).all()
        assert ((new.mixture.weights >= 0.0) & (new.mixture.weights <= 1.0)).all()
        np.linalg.cholesky(new.mixture.covariances)


# Against the naive filter.


def assert_same(found: GaussianMixture, expected: list[Component], margin: float) -> None:
    """Every component agrees: weight relatively, mean and covariance in standard deviations."""
    assert len(found) == len(expected)
    if not expected:
        return
    weights = np.array([w for w, _, _ in expected])
    means, covariances = np.array([m for _, m, _ in expected]), np.array([p for _, _, p in expected])
    std = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    cost = (np.abs(found.means[:, None] - means) / std).max(axis=2) + np.abs(found.weights[:, None] / weights - 1.0)
    rows, columns = linear_sum_assignment(np.minimum(cost, 1.0))
    assert cost[rows, columns].max() < margin
    scale = std[columns][:, :, None] * std[columns][:, None, :]
    assert (np.abs(found.covariances[rows] - covariances[columns]) / scale).max() < margin


def naive(case: LinearCase) -> tuple[PmbFilter, TextbookPmb]:
    phd, textbook = case.filter("qmc"), case.textbook()
    birth = BirthPrior(BIRTHS, case.disparity, None, case.velocity_std)
    settings = PmbSettings(SURVIVAL, birth, recycle_below=1e-3, prune_weight=1e-5, merge_distance=4.0)
    return PmbFilter(phd.rig, phd.motion, phd.sets, settings), TextbookPmb(
        textbook.transition, textbook.process, np.diag(SIGMA**2), SURVIVAL**STEP, P_DETECT, CLUTTER, BIRTHS,
        WIDTH * HEIGHT, textbook.birth_mean, textbook.birth_covariance, 1e-3, 1e-5, 4.0,
    )  # fmt: skip


@pytest.mark.parametrize("case", [static_case(), moving_case(0.0)], ids=["static", "constant velocity"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_agrees_with_the_naive_filter(case: LinearCase, seed: int) -> None:
    """Twenty frames of four objects that appear one after the other, two of them close, misses and clutter."""
    multi_filter, textbook = naive(case)
    state = multi_filter.init()
    frames = detections(np.random.default_rng(seed), 0.0 if isinstance(case.motion, Static) else 2.0)[:20]
    recycled = 0
    for k, pixels in enumerate(frames):
        expected = textbook.step(pixels[np.argsort(pixels[:, 0])])
        state, info = update(multi_filter, state, make_event(case.camera, 0, STEP * k, pixels))
        tracked = np.flatnonzero(state.mixture.labels != UNLABELLED)
        rest = np.flatnonzero(state.mixture.labels == UNLABELLED)
        print(k, info.log_likelihood - expected, len(tracked), len(rest))
        assert info.log_likelihood == pytest.approx(expected, abs=1e-5)
        assert_same(state.mixture.take(tracked), textbook.tracks, 1e-5)
        assert_same(state.mixture.take(rest), textbook.unseen, 1e-5)
        recycled += len(rest)
    assert info.cardinality_mean == pytest.approx(4.0, abs=1.0)
    assert recycled > 20
