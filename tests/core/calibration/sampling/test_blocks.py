"""The single-cluster filter with moves: its path of densities, resumed runs, and what it finds."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.pairing.association import inflated
from stereophd.core.calibration.sampling.bridging import BridgeInfo, BridgeSampler, BridgeState
from stereophd.core.calibration.sampling.likelihood import Evidence
from stereophd.core.calibration.sampling.paths import DensityPath, Stage, growing_path
from stereophd.core.calibration.sampling.runs import run
from stereophd.core.calibration.settings import SequentialSettings
from stereophd.core.multi.camera_hypotheses.batch import FilterBatch
from tests.core.calibration.problems import make_events, make_parameters, make_template, of_log, to_bytes

SEED = np.random.SeedSequence(5)
SMALL = SequentialSettings(
    particles=24, first_particles=48, block_events=12, inflation=(4.0, 2.0, 1.0), moves_per_step=1
)


def make_path(events: int, settings: SequentialSettings) -> DensityPath:
    parameters = make_parameters()
    batch = FilterBatch(make_template(parameters.cameras, "pmb"), 2)
    return growing_path(Evidence(parameters, make_events(parameters.cameras, events, clutter=2.0), batch, 0), settings)


@pytest.mark.parametrize(
    ("events", "ends"),
    [(8, [8, 8, 8]), (12, [12, 12, 12]), (20, [12, 12, 12, 20]), (100, [12, 12, 12, 24, 48, 100])],
)
def test_stages_anneal_the_first_block_and_then_double_the_events(events: int, ends: list[int]) -> None:
    path = make_path(events, SMALL)
    assert [stage.n_events for stage in path.stages] == ends
    assert [stage.inflation for stage in path.stages] == [4.0, 2.0] + [1.0] * (len(ends) - 2)
    assert [stage.particles for stage in path.stages] == [48, 48] + [24] * (len(ends) - 2)
    assert make_path(8, replace(SMALL, inflation=(3.0,))).stages == (Stage(8, 3.0, 48), Stage(8, 1.0, 24))


def test_densities_are_prior_times_evidence_of_the_first_events_at_the_stage_s_noise() -> None:
    path = make_path(24, SMALL)
    values = 0.2 * path.draw(np.random.default_rng(1))[:3]
    prior = path.parameters.log_prior(values)

    def density(stage: Stage) -> np.ndarray:
        events = [inflated(event, stage.inflation) for event in path.evidence.events[: stage.n_events]]
        return prior + of_log(replace(path.evidence, events=events), values)

    begin, end = path.log_densities(values, 0, True)
    np.testing.assert_array_equal(begin, prior)
    np.testing.assert_allclose(end, density(path.stages[0]), rtol=1e-12)
    for number in (1, 2, 3):
        begin, end = path.log_densities(values, number, True)
        np.testing.assert_allclose(begin, density(path.stages[number - 1]), rtol=1e-12)
        np.testing.assert_allclose(end, density(path.stages[number]), rtol=1e-12)
        np.testing.assert_array_equal(path.log_densities(values, number, False)[1], end)


def test_the_camera_is_found_and_a_resumed_run_ends_the_same() -> None:
    path = make_path(24, SMALL)
    sampler = BridgeSampler(path, SMALL.resample_below, SMALL.moves_per_step, SEED)
    saved: list[bytes] = []

    def save(state: BridgeState, history: Sequence[BridgeInfo]) -> None:
        if len(history) == 5:
            saved.append(pickle.dumps((state, list(history))))

    result, history = run(sampler, after_step=save)
    assert to_bytes(run(sampler, pickle.loads(saved[0]))) == to_bytes((result, history))
    assert {info.stage for info in history} == set(range(len(path.stages)))
    pitch = result.values[:, 3]
    assert pitch.std() < 0.5 * path.parameters.prior_std[3]
    assert abs(pitch.mean()) < 5.0 * pitch.std()
