"""The single-cluster PHD filter: against a textbook version, resumed, and what it estimates."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.sampling import sequential
from stereophd.core.calibration.sampling.runs import run
from stereophd.core.calibration.sampling.sequential import (
    SequentialInfo,
    SequentialSampler,
    SequentialSettings,
    SequentialState,
)
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.disparity.events import Event, make_rig
from stereophd.core.multi.camera_hypotheses.batch import FilterBatch
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.numerics.resampling import systematic
from stereophd.core.numerics.weights import step_generator
from tests.core.calibration.problems import make_events, make_parameters, make_template, to_bytes
from tests.core.multi.scenes import BIRTHS, with_births

SEED = np.random.SeedSequence(11)


@pytest.fixture(scope="module")
def parameters() -> ParameterSet:
    return make_parameters()


def narrowed(parameters: ParameterSet, factor: float) -> ParameterSet:
    """The same unknowns, better known."""
    return replace(parameters, parameters=tuple(replace(p, std=factor * p.std) for p in parameters.parameters))


def textbook(
    parameters: ParameterSet, template: PhdFilter, events: Sequence[Event], settings: SequentialSettings
) -> tuple[np.ndarray, np.ndarray, float]:
    """Section VII-B in a few lines: one PHD filter a particle, weights from the likelihood."""
    count, size = settings.particles, parameters.size
    values = parameters.sample(step_generator(SEED, 0), count)
    weights, states, evidence = np.full(count, 1.0 / count), [template.init()] * count, 0.0
    for number, event in enumerate(events):
        rng = step_generator(SEED, number + 1)
        likelihoods = np.empty(count)
        for k in range(count):
            rig = make_rig(parameters.build(values[k]), 1.0, "horizontal")
            one = with_births(PhdFilter(rig, template.motion, template.sets, template.settings), BIRTHS)
            states[k], info = one.update(states[k], one.predict(states[k], event), event)
            likelihoods[k] = np.exp(info.log_likelihood)
        evidence += np.log(weights @ likelihoods)
        weights = weights * likelihoods / (weights @ likelihoods)
        if 1.0 / (weights**2).sum() < settings.resample_below * count:
            chosen = systematic(weights, rng.random(1))
            values, states = values[chosen], [states[k] for k in chosen]
            jitter = settings.roughening * np.ptp(values, axis=0) * count ** (-1.0 / size)
            values, weights = values + jitter * rng.standard_normal(values.shape), np.full(count, 1.0 / count)
    return values, weights, evidence


def test_it_is_the_textbooks_filter(parameters: ParameterSet) -> None:
    template = make_template(parameters.cameras)
    assert isinstance(template, PhdFilter)
    events = make_events(parameters.cameras, 8)
    known_well = narrowed(parameters, 0.05)
    settings = SequentialSettings(moves="none", resample_below=0.75, particles=12)
    state, history = run(SequentialSampler(known_well, events, FilterBatch(template), settings, SEED))
    values, weights, evidence = textbook(known_well, template, events, settings)
    assert 0 < sum(info.resampled for info in history) < len(events)
    np.testing.assert_allclose(state.values, values, rtol=1e-9)
    np.testing.assert_allclose(np.exp(state.log_weights), weights, rtol=1e-6)
    np.testing.assert_allclose(state.log_evidence, evidence, rtol=1e-9)
    np.testing.assert_allclose(sum(info.log_likelihood for info in history), evidence, rtol=1e-9)


def test_resumed_or_on_more_threads_it_is_the_same_to_the_bit(parameters: ParameterSet) -> None:
    events = make_events(parameters.cameras, 10)
    batch = FilterBatch(make_template(parameters.cameras))
    settings = SequentialSettings(moves="none", resample_below=0.75, particles=20)
    saved: list[bytes] = []

    def save(state: SequentialState, history: Sequence[SequentialInfo]) -> None:
        if sampler.progress(state) == (6, 10):
            saved.append(pickle.dumps((state, list(history))))

    sampler = SequentialSampler(parameters, events, batch, settings, SEED)
    whole, resumed = run(sampler, after_step=save), run(sampler, pickle.loads(saved[0]))
    assert to_bytes(whole) == to_bytes(resumed)
    threaded = run(replace(sampler, batch=replace(batch, threads=2)))
    assert to_bytes(whole) == to_bytes(threaded)
    assert len(whole[1]) == 10


def test_roughening_has_the_spread_of_gordon_salmond_and_smith() -> None:
    rng = np.random.default_rng(1)
    values = np.zeros((20_000, 2))
    values[0] = [4.0, 0.0]
    moved = sequential.roughened(values, 0.2, rng)[1:]
    # K E N^(-1/m); the standard error of a standard deviation is 0.5 % here
    np.testing.assert_allclose(moved[:, 0].std(), 0.2 * 4.0 * 20_000**-0.5, rtol=0.025)
    np.testing.assert_array_equal(moved[:, 1], 0.0)
    assert sequential.roughened(values, 0.0, rng) is values


def test_a_pose_known_roughly_becomes_better_known(parameters: ParameterSet) -> None:
    # of the prior only the yaw is uncertain: one dimension, which 200 particles fill
    yaw = ParameterSet(parameters.cameras, (replace(parameters.parameters[4], std=0.05),))
    events = make_events(parameters.cameras, 30, clutter=2.0)
    settings = SequentialSettings(moves="none", resample_below=0.75, particles=200, roughening=0.1)
    batch = FilterBatch(make_template(parameters.cameras), 2)
    _, history = run(SequentialSampler(yaw, events, batch, settings, SEED))
    last = history[-1]
    spread = float(np.sqrt(last.covariance[0, 0]))
    assert spread < 0.025
    assert abs(last.mean[0]) < 3.0 * spread
