"""Tempered sampling: known posteriors, several modes, the prior as a start, resumed runs."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from stereophd.core.calibration.sampling.bridging import (
    BridgeInfo,
    BridgeSampler,
    BridgeState,
    acceptance_of,
    least_effective,
    temperature_rise,
)
from stereophd.core.calibration.sampling.likelihood import Evidence
from stereophd.core.calibration.sampling.paths import tempered_path
from stereophd.core.calibration.sampling.runs import run
from stereophd.core.calibration.settings import TemperedSettings
from stereophd.core.calibration.unknowns.modes import Modes
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.multi.camera_hypotheses.batch import FilterBatch
from tests.core.calibration.problems import make_events, make_parameters, make_template, to_bytes

SEED = np.random.SeedSequence(21)
# y = x0 + 2 x1 + noise and y' = x1 + noise', of standard deviations 0.5 and 0.2
DESIGN, DATA, NOISE = np.array([[1.0, 2.0], [0.0, 1.0]]), np.array([3.0, 0.4]), np.array([0.5, 0.2])


@pytest.fixture(scope="module")
def plane() -> ParameterSet:
    """Two unknowns of prior standard deviations 2 and 1."""
    cameras = make_parameters().cameras
    stds = (2.0, 1.0)
    return ParameterSet(
        cameras,
        tuple(Parameter(n, "right", 0.0, s) for n, s in zip(("center_x", "center_y"), stds, strict=True)),
    )


@dataclass(frozen=True)
class Known:
    """An evidence that is a function of the values."""

    parameters: ParameterSet
    log_likelihood: Callable[[np.ndarray], np.ndarray]
    n_events: int = 1

    def after(self, values: np.ndarray, counts: Sequence[int], inflation: float = 1.0) -> np.ndarray:
        assert (*counts, inflation) == (1, 1.0)
        return self.log_likelihood(values)[None]


def sampler_of(evidence: Any, modes: Modes | None, settings: TemperedSettings) -> BridgeSampler:
    path = tempered_path(evidence, modes, settings)
    return BridgeSampler(path, settings.resample_below, settings.moves, SEED)


def linear(values: np.ndarray) -> np.ndarray:
    residuals = (DATA - values @ DESIGN.T) / NOISE
    return -0.5 * (residuals**2).sum(axis=1) - np.log(2.0 * np.pi * NOISE.prod())


def linear_posterior(plane: ParameterSet) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean, covariance and log-evidence of the linear-Gaussian problem."""
    prior = np.diag(plane.prior_std**2)
    innovation = DESIGN @ prior @ DESIGN.T + np.diag(NOISE**2)
    gain = prior @ DESIGN.T @ np.linalg.inv(innovation)
    evidence = -0.5 * DATA @ np.linalg.solve(innovation, DATA) - 0.5 * np.log(np.linalg.det(2.0 * np.pi * innovation))
    return gain @ DATA, prior - gain @ DESIGN @ prior, float(evidence)


@pytest.mark.parametrize("start", ["prior", "mode", "shifted mode"])
def test_a_linear_problem_has_its_posterior_and_evidence(plane: ParameterSet, start: str) -> None:
    mean, covariance, evidence = linear_posterior(plane)
    std = np.sqrt(np.diag(covariance))
    modes = None if start == "prior" else Modes(
        (mean + (3.0 * std if start == "shifted mode" else 0.0))[None], covariance[None], np.ones(1)
    )  # fmt: skip
    sampler = sampler_of(Known(plane, linear), modes, TemperedSettings(particles=2000, moves=6))
    result, history = run(sampler)
    # resampling and moves leave at least a fifth of the particles independent: 5 standard errors of 400
    np.testing.assert_allclose((result.values.mean(axis=0) - mean) / std, 0.0, atol=0.25)
    np.testing.assert_allclose(result.values.std(axis=0) / std, 1.0, atol=0.18)
    assert abs(np.corrcoef(result.values.T)[0, 1] - covariance[0, 1] / std.prod()) < 0.15
    assert abs(result.log_evidence - evidence) < 0.25
    assert 0.15 < acceptance_of(history) < 0.7
    assert least_effective(history) + 1e-9 >= 0.5
    steps = sum(info.kind == "temper" for info in history)
    assert steps == 1 if start == "mode" else steps > 1
    np.testing.assert_allclose(result.log_end, plane.log_prior(result.values) + linear(result.values))


def test_overlapping_modes_of_different_width_keep_their_shares(plane: ParameterSet) -> None:
    # moves between the modes are proposed with different covariances: without their densities in the acceptance
    # the narrow mode would gain
    centers, stds, shares = np.array([[-0.8, 0.0], [0.8, 0.0]]), np.array([0.25, 0.8]), np.array([0.4, 0.6])

    def two(values: np.ndarray) -> np.ndarray:
        squared = ((values[:, None] - centers) ** 2).sum(axis=2) / stds**2
        parts = np.log(shares) - 0.5 * squared - np.log(2.0 * np.pi * stds**2)
        return np.asarray(np.logaddexp.reduce(parts, axis=1) - plane.log_prior(values))

    modes = Modes(centers, stds[:, None, None] ** 2 * np.eye(2), np.array([0.5, 0.5]))
    sampler = sampler_of(Known(plane, two), modes, TemperedSettings(particles=4000, moves=20))
    result, _ = run(sampler)
    expected = np.mean([
        shares[0] * (np.linalg.norm(centers[0] + stds[0] * draw - centers[0]) < 0.5)
        + shares[1] * (np.linalg.norm(centers[1] + stds[1] * draw - centers[0]) < 0.5)
        for draw in np.random.default_rng(3).standard_normal((40_000, 2))
    ])  # fmt: skip
    found = (np.linalg.norm(result.values - centers[0], axis=1) < 0.5).mean()
    # 5 standard errors of 1000 independent particles
    assert abs(found - expected) < 0.08
    # the target is normalised
    assert abs(result.log_evidence) < 0.1


def test_a_mode_that_the_data_refute_dies_out(plane: ParameterSet) -> None:
    mean, covariance, evidence = linear_posterior(plane)
    modes = Modes(np.stack([mean, mean + 30.0]), np.stack([covariance] * 2), np.array([0.5, 0.5]))
    result, _ = run(sampler_of(Known(plane, linear), modes, TemperedSettings(particles=500)))
    assert (np.abs(result.values - mean) < 10.0).all()
    assert abs(result.log_evidence - evidence) < 0.5
    assert len(np.unique(result.ancestors)) <= 250


def test_rises_of_temperature_leave_the_wanted_particles_effective() -> None:
    gain = 50.0 * np.random.default_rng(1).standard_normal(300)
    rise = temperature_rise(gain, 1.0, 0.5)
    weights = np.exp(rise * (gain - gain.max()))
    np.testing.assert_allclose(weights.sum() ** 2 / (weights**2).sum(), 150.0, rtol=1e-6)
    assert temperature_rise(np.zeros(300), 0.3, 0.5) == 0.3
    # one particle of infinite weight: the temperature still rises
    assert temperature_rise(np.array([0.0] + [-np.inf] * 9), 1.0, 0.5) > 0.0


@pytest.mark.parametrize("kind", ["pmb", "phd"])
def test_a_camera_is_found_and_a_resumed_run_ends_the_same(kind: str) -> None:
    parameters = make_parameters()
    events = make_events(parameters.cameras, 24, clutter=2.0)
    evidence = Evidence(parameters, events, FilterBatch(make_template(parameters.cameras, kind), 2), 0)
    std = np.array([5.0, 1.0, 3.0, 0.004, 0.02, 0.006])
    truth = np.zeros(6)
    modes = Modes((truth + 0.5 * std)[None], np.diag(std**2)[None], np.ones(1))
    sampler = sampler_of(evidence, modes, TemperedSettings(particles=16, moves=2))
    saved: list[bytes] = []

    def save(state: BridgeState, history: Sequence[BridgeInfo]) -> None:
        if len(history) == 3:
            saved.append(pickle.dumps((state, list(history))))

    result, history = run(sampler, after_step=save)
    assert to_bytes(run(sampler, pickle.loads(saved[0]))) == to_bytes((result, history))
    # the pitch is seen best: narrower than the prior, and the truth within it
    pitch = result.values[:, 3]
    assert pitch.std() < 0.3 * parameters.prior_std[3]
    assert abs(pitch.mean()) < 5.0 * pitch.std()
    np.testing.assert_allclose(np.exp(result.log_weights).sum(), 1.0)
