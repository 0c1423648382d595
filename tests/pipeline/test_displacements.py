"""Noise and speeds from the displacements between the frames of one camera."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.io.logs.reading import Frame
from stereophd.pipeline.checks.log.sample import CameraSample, sample_log
from stereophd.pipeline.detectors.displacements import likelihoods_of_displacements, usual_motion
from stereophd.pipeline.detectors.mixture import NOISES
from tests.scenes import build_camera

RATE, DEPTH = 20.0, 10.0


def crowd(noise: float, objects: int, frames: int, speed: float, seed: int) -> CameraSample:
    """Objects in a box of 10 x 7 x 4 on straight lines, a fifth missed, a tenth of the detections false."""
    rng = np.random.default_rng(seed)
    camera = build_camera("cam", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], size=(1280, 960), focal=1000.0)
    start = rng.uniform([-5.0, -3.5, DEPTH - 2.0], [5.0, 3.5, DEPTH + 2.0], (objects, 3))
    velocity = rng.normal(0.0, speed, start.shape)
    found = []
    for k in range(frames):
        pixels = camera.project(start + velocity * (k / RATE))
        pixels = pixels[rng.random(objects) < 0.8] if objects > 1 else pixels
        pixels = pixels + rng.normal(0.0, noise, pixels.shape)
        false = rng.uniform(0.0, [1279.0, 959.0], (rng.poisson(0.1 * objects), 2))
        found.append(Frame(k / RATE, 0, k, np.concatenate([pixels[camera.contains(pixels)], false])))
    return sample_log(found, (camera,))[0]


@pytest.mark.parametrize(("noise", "speed"), [(1.0, 1.0), (20.0, 0.05), (60.0, 0.5)])
def test_displacements_of_a_crowd_tell_its_noise_where_it_moves_by_less(noise: float, speed: float) -> None:
    """Two hundred objects in eight frames: within a factor of 1.5 of what is not hidden by the motion."""
    told = likelihoods_of_displacements(crowd(noise, 200, 8, speed, 3)).max(axis=1)
    moved = speed / DEPTH / RATE * 1000.0
    if moved < noise:
        assert abs(np.log(NOISES[told.argmax()] / noise)) < np.log(1.5)
    # and there is no noise beyond that
    assert told[2.0 * np.hypot(noise, moved) < NOISES].max() < -3.0


@pytest.mark.parametrize("speed", [0.3, 1.0, 4.0])
def test_displacements_of_a_crowd_tell_its_speed(speed: float) -> None:
    """Also where objects move farther than their neighbours are, so that nearest neighbours are others."""
    sample = crowd(1.0, 300, 7, speed, 4)
    turn, _ = usual_motion([sample.with_camera(sample.camera.with_noise(1.0))], {})
    assert abs(np.log(turn * DEPTH / speed)) < np.log(1.4)


@pytest.mark.parametrize(("noise", "acceleration"), [(0.3, 0.3), (1.0, 1.0), (1.0, 10.0)])
def test_third_differences_tell_the_acceleration(noise: float, acceleration: float) -> None:
    """Of three objects for eight seconds, whatever their speed is."""
    rng = np.random.default_rng(6)
    camera, step = build_camera("cam"), 1.0 / RATE
    frames, places = [], np.array([[-3.0, -2.0], [0.0, 2.0], [3.0, 0.0]])
    velocity = rng.normal(0.0, 0.2, places.shape)
    for k in range(200):
        pixels = camera.project(np.column_stack([places, np.full(3, DEPTH)]))
        frames.append(Frame(k * step, 0, k, pixels + rng.normal(0.0, noise, pixels.shape)))
        swerve = rng.normal(0.0, acceleration * step**0.5, places.shape)
        places = places + step * velocity + swerve * step * (0.5 + 12.0**-0.5 * rng.normal(size=places.shape))
        velocity = 0.98 * (velocity + swerve)
    sample = sample_log(frames, (camera,))[0]
    _, found = usual_motion([sample.with_camera(sample.camera.with_noise(noise))], {})
    assert abs(np.log(found * DEPTH / acceleration)) < np.log(1.5)


def test_one_object_tells_little() -> None:
    """Nothing shows how far apart different objects are: the true noise is not excluded."""
    told = likelihoods_of_displacements(crowd(1.0, 1, 200, 1.0, 5)).max(axis=1)
    assert np.interp(0.0, np.log(NOISES), told) > -2.0
