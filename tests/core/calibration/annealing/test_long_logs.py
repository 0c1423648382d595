"""Which part of a log that is too long cameras are fitted to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.arrays import Array, Booleans
from stereophd.core.calibration.adjustment.recording import Recording
from stereophd.core.calibration.annealing.task import Task, parts_of
from stereophd.core.calibration.settings import AnnealedSettings
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.pmb.filter import PmbFilter
from tests.core.calibration.pairing.test_search import recording_of
from tests.core.calibration.problems import make_template
from tests.core.calibration.scenes import MadeUp, make_problem

FRAMES, OBJECTS, LIFE = 240, 8, 30


def frames_at(*times: Array) -> Recording:
    """A recording of cameras with frames at these times, a detection in each."""
    camera = np.repeat(np.arange(len(times)), [len(one) for one in times])
    order = np.lexsort((camera, np.concatenate(times)))
    made = recording_of(make_problem(5, 1, 2))
    pixels = np.zeros((len(order), 2))
    return replace(
        made, cameras=camera[order], times=np.concatenate(times)[order], clocks=made.clocks[:1] * len(times),
        first=np.arange(len(order) + 1), pixels=pixels, sigma=pixels + 1.0, heights=np.full(len(times), 600.0),
    )  # fmt: skip


def test_a_dropped_frame_does_not_part_two_cameras() -> None:
    """Every third frame of each camera left 4 of 100 at a time that both had."""
    times = np.arange(300) / 20.0
    log = frames_at(times, np.delete(times, 10))
    kept = log.part(log.spread(1.0 / 3.0))
    left, right = (kept.times[kept.cameras == camera] for camera in range(2))
    assert len(left) == 100
    assert len(np.intersect1d(left, right)) >= 99


def test_cameras_of_unequal_rates_stay_together() -> None:
    rates = (20.0, 15.0, 25.0)
    log = frames_at(*(0.013 * k + np.arange(60.0 * rate) / rate for k, rate in enumerate(rates)))
    kept = log.part(log.spread(0.11))
    slowest = kept.times[kept.cameras == 1]
    for camera, rate in enumerate(rates):
        times = kept.times[kept.cameras == camera]
        assert len(times) == pytest.approx(0.11 * 60.0 * rate, rel=0.1)
        nearest = np.abs(slowest[:, None] - times).min(axis=1)
        assert (nearest < 1.0 / rates[1]).mean() > 0.99


def test_one_frame_too_many_does_not_halve_the_log() -> None:
    log = frames_at(np.arange(400.0), np.arange(400.0) + 0.3)
    assert len(log.spread(1.0)) == 800
    assert 780 <= len(log.spread(799.0 / 800.0)) <= 799
    assert log.part(log.spread(1.0)) is log


def made_up(seen: Booleans) -> tuple[MadeUp, Recording]:
    """A problem and its log, in which frame i has object j where seen[i, j]."""
    made = make_problem(5, OBJECTS, FRAMES)
    whole = recording_of(made)
    rows = np.repeat(seen, 2, axis=0)  # of both cameras
    first = np.concatenate([[0], np.cumsum(rows.sum(axis=1))])
    return made, replace(whole, first=first, pixels=whole.pixels[rows.ravel()], sigma=whole.sigma[rows.ravel()])


def task_of(made: MadeUp, recording: Recording, share: float) -> Task:
    template = make_template(made.parameters.cameras, "pmb", ConstantVelocity([0.001] * 3, 12.0))
    assert isinstance(template, PmbFilter)
    most = int(share * len(recording.pixels))
    settings = AnnealedSettings(min_detections=4, max_detections=most, one_camera_tracks="image")
    return Task.of(made.parameters, 0, template, recording, None, settings)


@pytest.mark.parametrize("is_brief", [True, False])
def test_stretches_keep_objects_that_are_seen_briefly(is_brief: bool) -> None:
    """Of objects that live for 30 frames, every eighth frame left fewer detections than a track needs."""
    lives = np.arange(FRAMES)[:, None] // LIFE == np.arange(OBJECTS) if is_brief else np.ones((FRAMES, OBJECTS), bool)
    made, recording = made_up(lives)
    task = task_of(made, recording, 1.0 / 8.0)
    steps = np.diff(np.unique(task.recording.times)) / np.diff(np.unique(recording.times)).min()
    assert len(task.recording.pixels) < len(recording.pixels) / 6
    assert (np.median(steps) < 1.5) == is_brief
    assert {camera for camera, _ in task.tracks} == {0, 1}


def test_a_log_that_is_short_is_worked_on_whole() -> None:
    made, recording = made_up(np.ones((FRAMES, OBJECTS), bool))
    ((part, frames),) = parts_of(recording, AnnealedSettings(), made.parameters)
    assert part is recording
    assert len(frames) == len(recording.cameras)


def test_stretches_are_longer_than_clocks_are_apart() -> None:
    """Where clocks may be further apart than a stretch is long, cameras would share nothing of it."""
    made, recording = made_up(np.ones((FRAMES, OBJECTS), bool))
    settings = AnnealedSettings(min_detections=4, max_detections=len(recording.pixels) // 8)
    for apart, parts in ((1.0, 2), (40.0, 1)):
        unknown = ParameterSet(made.parameters.cameras, (Parameter("clock_offset", "right", 0.0, apart),))
        assert len(parts_of(recording, settings, unknown)) == parts


@pytest.mark.parametrize("rare_s", [[1200.0, 2400.0], np.arange(100.0, 3600.0, 600.0)])
def test_a_camera_with_hardly_any_frames_does_not_decide_the_part(rare_s: list[float]) -> None:
    """It keeps them, and the others their share of the whole log."""
    times = np.arange(0.0, 3600.0, 0.5)
    recording = frames_at(times, times, np.asarray(rare_s))
    for share in (0.1, 0.37):
        chosen = recording.spread(share)
        of_rare = recording.cameras[chosen] == 2
        assert of_rare.sum() == len(rare_s)
        assert (~of_rare).sum() / (2 * len(times)) == pytest.approx(share, rel=0.1)
        assert np.ptp(recording.times[chosen]) > 3000.0
