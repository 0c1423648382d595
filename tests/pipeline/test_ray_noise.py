"""Noise of detectors from the rays alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.checks.log.sample import CameraSample, sample_log
from stereophd.pipeline.detectors.displacements import PRIOR
from stereophd.pipeline.detectors.mixture import BORDERS, NOISES, Mixture, unmix
from stereophd.pipeline.detectors.ray_noise import (
    BETWEEN_CAMERAS,
    NOISE_SPREAD,
    RAYS,
    SHARES,
    USUAL_NOISE_PX,
    _draws,
    noise_from_rays,
    starting_detectors,
)
from tests.scenes import build_camera

RATE = 20.0


def cameras_at(*places: tuple[float, float]) -> list[Camera]:
    """Cameras at these x and heights, 10 from the scene, that look at its middle."""
    out = []
    for k, (x, y) in enumerate(places):
        turn = [0.0, np.arctan2(x, 10.0), 0.0]
        out.append(build_camera(f"cam{k}", [x, y, 0.0], turn, size=(1280, 960), focal=1000.0))
    return out


def samples_of(
    cameras: list[Camera], noise: list[float], objects: int, frames: int, speed: float, seed: int = 0
) -> list[CameraSample]:
    """Objects in a box of 6 x 4 x 4 on straight lines, a tenth missed, one false detection in two frames."""
    rng = np.random.default_rng(seed)
    start = rng.uniform([-3.0, -2.0, 8.0], [3.0, 2.0, 12.0], (objects, 3))
    velocity = rng.normal(0.0, speed, (objects, 3))
    out = []
    for k in range(frames):
        position: Array = start + velocity * (k / RATE)
        for c, camera in enumerate(cameras):
            pixels = camera.project(position)
            pixels = pixels + rng.normal(0.0, noise[c], pixels.shape)
            pixels = pixels[camera.contains(pixels) & (rng.random(objects) < 0.9)]
            false = rng.uniform(0.0, [1279.0, 959.0], (rng.poisson(0.5), 2))
            out.append(Frame(k / RATE, c, k, np.concatenate([pixels, false])))
    return sample_log(out, tuple(cameras))


def factors(noise: float, objects: int, speed: float) -> tuple[float, float]:
    """By which factor the noise is wrong, of a camera at most and on average; the third has 1.7 times as much."""
    true = [noise, noise, 1.7 * noise]
    samples = samples_of(cameras_at((-3.0, 0.0), (3.0, 0.5), (0.0, -3.0)), true, objects, 150, speed)
    logs = np.log(noise_from_rays(samples)[0] / true)
    return float(np.exp(np.abs(logs).max())), float(np.exp(np.abs(logs.mean())))


@pytest.mark.parametrize("noise", [0.1, 1.0, 8.0, 60.0])
@pytest.mark.parametrize("objects", [2, 12])
def test_noise_of_any_size_is_found(noise: float, objects: int) -> None:
    """Within 1.5 on average, and of single cameras within 2, which tracks then tell apart.

    A log of 150 frames has at least 200 partners of each pair. They are not independent: objects that pass near an
    epipolar line stay there for a while.
    """
    worst, mean = factors(noise, objects, 1.0)
    assert worst < 2.0
    assert mean < 1.5


def test_rays_that_pass_on_either_side_count() -> None:
    """Of rays that miss each other on one side, by a wrong principal point, only the other side's were counted."""
    cameras = cameras_at((-3.0, 0.0), (3.0, 0.5))
    samples = samples_of(cameras, [0.5, 0.5], 4, 100, 1.0)
    found = [
        noise_from_rays([samples[0], samples[1].with_camera(replace(cameras[1], cy=cameras[1].cy + side))])[0]
        for side in (-4.0, 4.0)
    ]
    np.testing.assert_allclose(found[0], found[1], rtol=0.15)
    assert np.hypot(*found[0]) > 2.0


@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_noise_of_objects_at_rest(noise: float) -> None:
    """They meet those of other cameras by chance all the time: fewer independent distances."""
    assert factors(noise, 60, 0.0)[0] < 2.0


@pytest.mark.parametrize("spacing", [0.25, 0.4])
def test_noise_of_a_rigid_board(spacing: float) -> None:
    """Its corners keep their neighbours all the time, and these are no partners of large noise.

    The board moves by up to half the distance of its corners between the frames of cameras that are not synchronised.
    """
    rng = np.random.default_rng(0)
    cameras = cameras_at((-3.0, 0.0), (3.0, 0.5), (0.0, -3.0), (1.0, 2.0))
    grid = np.stack([*np.meshgrid(np.arange(4.0), np.arange(3.0)), np.zeros((3, 4))], axis=-1).reshape(-1, 3)
    frames = []
    for k in range(60):
        for c, camera in enumerate(cameras):
            time = (k + 0.25 * c) / 6.0
            turn = rotation_from_vector(np.array([0.3 * np.sin(0.65 * time), 0.4 * np.sin(0.5 * time), 0.1 * time]))
            board = spacing * grid @ turn.T + [2.0 * np.sin(0.5 * time), np.cos(0.5 * time), 10.0]
            pixels = camera.project(board)[rng.random(len(board)) < 0.9]
            frames.append(Frame(time, c, k, pixels + rng.normal(0.0, 0.5, pixels.shape)))
    sigma = noise_from_rays(sample_log(frames, tuple(cameras)))[0]
    np.testing.assert_array_less(np.abs(np.log(sigma / 0.5)), np.log(2.0))


def test_a_camera_without_data_takes_its_noise_from_the_others() -> None:
    samples = samples_of(cameras_at((-3.0, 0.0), (3.0, 0.5), (0.0, -3.0)), [6.0, 6.0, 6.0], 5, 100, 1.0)
    empty = replace(samples[2], pixels=np.empty((0, 2)), first=np.zeros(len(samples[2].times) + 1, dtype=np.int64))
    found = noise_from_rays([*samples[:2], empty])
    assert 4.0 < found[0][2] < 7.0
    assert found[1][2] > BETWEEN_CAMERAS > found[1][0]


def test_nothing_to_compare_gives_the_prior() -> None:
    cameras = cameras_at((-3.0, 0.0), (3.0, 0.5))
    empty = sample_log([Frame(0.0, c, 0, np.empty((0, 2))) for c in range(2)], tuple(cameras))
    found = noise_from_rays(empty)
    np.testing.assert_allclose(found[0], USUAL_NOISE_PX, rtol=0.05)
    assert found[1] == pytest.approx(NOISE_SPREAD, rel=0.1)
    # and the detectors stay as they are given
    used, priors = starting_detectors(cameras, ["cam1"], empty)
    assert used[0] is cameras[0]
    assert used[1].detector.sigma.tolist() == [1.0, 1.0]
    assert priors["cam1"].spread == NOISE_SPREAD


def test_each_camera_shows_its_noise_beside_one_that_moves() -> None:
    """`init` took the 3 px that are usual for 0.6 px, as no ray was compared, and called that the noise of the rays."""
    cameras = cameras_at((-3.0, 0.0), (3.0, 0.5))
    pose = cameras[1].pose
    cameras[1] = replace(cameras[1], pose=Pose(pose.rotation, pose.center, rotation_rate=[0.0, 1e-9, 0.0]))
    samples = samples_of(cameras, [0.6, 0.6], 5, 150, 0.3)
    names = [camera.name for camera in cameras]
    for camera in starting_detectors(cameras, names, samples)[0]:
        assert 0.4 < camera.detector.sigma.mean() < 0.9


def test_one_camera_that_alone_has_detections_shows_its_noise() -> None:
    cameras = cameras_at((-3.0, 0.0), (3.0, 0.5))
    first, second = samples_of(cameras, [0.6, 0.6], 5, 100, 0.5)
    empty = replace(second, pixels=np.empty((0, 2)), first=np.zeros(len(second.times) + 1, dtype=np.int64))
    used, priors = starting_detectors(cameras, [camera.name for camera in cameras], [first, empty])
    assert 0.45 < used[0].detector.sigma[0] < 0.8
    assert used[0].detector.clutter_per_frame == pytest.approx(0.5, rel=0.4)
    assert priors[cameras[1].name].spread > priors[cameras[0].name].spread


def test_detections_that_no_track_links_are_not_all_false() -> None:
    """One-camera tracks link hardly any detection of this noise; of about eleven in a frame half a one is false."""
    cameras = cameras_at((-3.0, 0.0), (3.0, 0.5), (0.0, -3.0))
    samples = samples_of(cameras, [60.0, 60.0, 60.0], 12, 60, 1.0)
    assert min(sample.isolated_per_frame for sample in samples) > 4.0
    for camera in starting_detectors(cameras, [camera.name for camera in cameras], samples)[0]:
        assert 0.25 < camera.detector.clutter_per_frame < 1.5


@pytest.mark.parametrize(
    ("noise", "are_placed", "low", "high"), [(1.0, False, 0.0, 1.0), (1.0, True, 2.0, 4.0), (60.0, False, 2.0, 4.0)]
)
def test_one_camera_tracks_tell_what_is_false_where_no_others_come(
    noise: float, are_placed: bool, low: float, high: float
) -> None:
    """Of 28 to 36 detections half a one is false; a tenth is only usual."""
    cameras = cameras_at((-3.0, 0.0), (3.0, 0.5), (0.0, -3.0))
    samples = samples_of(cameras, [noise] * 3, 38, 60, 0.3)
    for camera in starting_detectors(cameras, [camera.name for camera in cameras], samples, are_placed)[0]:
        assert low < camera.detector.clutter_per_frame <= high


def test_noise_of_a_crowd_between_frames_that_no_track_links() -> None:
    """Five frames of 80 objects, whose cameras are not synchronised: one-camera tracks are mostly wrong."""
    rng = np.random.default_rng(2)
    cameras = cameras_at((-3.0, 0.0), (3.0, 0.5), (0.0, -3.0))
    start = rng.uniform([-3.0, -2.0, 8.0], [3.0, 2.0, 12.0], (80, 3))
    velocity = rng.normal(0.0, 0.02, start.shape)
    frames = []
    for k in range(5):
        for c, camera in enumerate(cameras):
            time = k / 5.0 + 0.07 * c
            pixels = camera.project(start + velocity * time)
            pixels = pixels[camera.contains(pixels) & (rng.random(len(pixels)) < 0.9)]
            frames.append(Frame(time, c, k, pixels + rng.normal(0.0, 1.0, pixels.shape)))
    found = noise_from_rays(sample_log(frames, tuple(cameras)))
    np.testing.assert_array_less(np.abs(np.log(found[0])), np.log(2.0))


def test_turns_between_the_frames_of_cameras_are_no_noise() -> None:
    """Objects turn by more than their noise, or as much, between the frames of the third camera and the others.

    The squared error over the stated variance has a mean of 1 where the posterior is right; five standard errors of
    four such squares of normal errors are 3.5. Turns taken for noise give more than a hundred.
    """
    cameras, noise, parts = cameras_at((-3.0, 0.0), (3.0, 0.5), (0.0, -3.0)), 0.3, 10
    squares = []
    for seed, turn in product((3, 4), (0.03, 0.01)):
        rng = np.random.default_rng(seed)
        steps = np.cumsum(rng.normal(0.0, turn, (60 * parts, 20, 3)), axis=0) / parts
        paths = rng.uniform([-3.0, -2.0, 8.0], [3.0, 2.0, 12.0], (20, 3)) + np.cumsum(steps, axis=0)
        frames = []
        for k in range(60):
            for c, camera in enumerate(cameras):
                late = 4 * (c == 2)
                pixels = camera.project(paths[k * parts + late])
                pixels = pixels[camera.contains(pixels) & (rng.random(len(pixels)) < 0.9)]
                pixels = pixels + rng.normal(0.0, noise, pixels.shape)
                frames.append(Frame((k + late / parts) / 5.0, c, k, pixels))
        found = noise_from_rays(sample_log(frames, tuple(cameras)))
        squares.append(np.log(found[0][2] / noise) ** 2 / found[1][2] ** 2)
    assert np.mean(squares) < 4.5


def test_rows_that_are_read_later_are_no_noise() -> None:
    """The third camera reads its rows one after the other while objects move by ten times their noise."""
    rng, cameras = np.random.default_rng(4), cameras_at((-3.0, 0.0), (3.0, 0.5), (0.0, -3.0))
    cameras[2] = replace(cameras[2], readout_s=0.03)
    start = rng.uniform([-3.0, -2.0, 8.0], [3.0, 2.0, 12.0], (12, 3))
    velocity = rng.normal(0.0, 1.5, start.shape)
    frames = []
    for k in range(40):
        for c, camera in enumerate(cameras):
            at = np.full((12, 1), k / RATE)
            for _ in range(3):
                pixels = camera.project(start + velocity * (at - 1.0))
                at = k / RATE + camera.readout_s * pixels[:, 1:] / camera.height
            pixels = pixels[camera.contains(pixels)]
            frames.append(Frame(k / RATE, c, k, pixels + rng.normal(0.0, 0.5, pixels.shape)))
    found = noise_from_rays(sample_log(frames, tuple(cameras)))
    np.testing.assert_array_less(np.abs(np.log(found[0] / 0.5)), np.log(1.4))


def of_rays(together: Array, neighbours: Array, apart: Array, count: int) -> Mixture:
    """What distances from epipolar lines tell."""
    chance, near = RAYS.background(apart), RAYS.background(neighbours)
    foreign = [share * near + (1.0 - share) * chance for share in SHARES]
    return unmix(RAYS, together, foreign, float(apart.sum()), count)


def test_a_background_that_is_slightly_wrong_is_no_noise() -> None:
    """A hundred thousand distances with a density that bends by a hundredth leave the noise to the prior."""
    chance = np.diff(BORDERS) * (BORDERS[1:] < 1000.0)
    bent = chance * (1.0 + 0.01 * np.cos(np.clip(BORDERS[1:], 0.0, 1000.0) / 300.0))
    likelihoods = of_rays(1e5 * bent / bent.sum(), np.zeros(len(chance)), 1e5 * chance / chance.sum(), 300).likelihoods
    large = NOISES > 30.0
    assert np.ptp(likelihoods[large]) < 2.0


def test_the_stated_error_of_a_noise_among_strangers_covers_it() -> None:
    """Noise drawn from the prior, any share of partners, twenty to a hundred strangers for each detection.

    The density of strangers is up to a third off at the reach of chance, and a part of that as the square of the
    distance nearer to it. Where the posterior is right, the squared error over the stated variance has a mean of 1; its
    standard deviation is 1.4 of a normal posterior and at most 2 here, so that five standard errors of 60 are 1.3.
    """
    rng, logs = np.random.default_rng(5), np.log(NOISES)
    middles, squares = 0.5 * (BORDERS[1:] + BORDERS[:-1]), []
    for _ in range(60):
        noise = np.exp(np.clip(rng.normal(np.log(USUAL_NOISE_PX), NOISE_SPREAD), logs[0], logs[-1]))
        detections, strangers, reach = 500, rng.uniform(20.0, 100.0), rng.uniform(100.0, 400.0)
        chance = np.diff(BORDERS) * np.exp(-0.5 * (middles / reach) ** 2)
        off = chance * np.exp(rng.uniform(-0.3, 0.3) * np.minimum(middles / reach, 1.0) ** 2)
        partners = rng.poisson(0.95 * rng.random() * detections)
        own = np.histogram(np.abs(rng.normal(0.0, noise, partners)), BORDERS)[0]
        together = own + rng.poisson(detections * strangers * off / off.sum())
        apart, neighbours = (rng.poisson(k * detections * strangers * chance / chance.sum()) for k in (2, 4))
        likelihoods = of_rays(together, neighbours, apart, detections).likelihoods
        posterior = np.exp(likelihoods - 0.5 * ((logs - np.log(USUAL_NOISE_PX)) / NOISE_SPREAD) ** 2)
        posterior /= posterior.sum()
        mean = posterior @ logs
        squares.append((np.log(noise) - mean) ** 2 / (posterior @ (logs - mean) ** 2))
    assert np.mean(squares) < 1.0 + 1.3


def test_the_noise_is_that_at_the_turn_that_links_show() -> None:
    """2 px at the turn that both cameras show, 20 px at every other one."""
    there, elsewhere = (-2.0 * np.log(NOISES / noise) ** 2 for noise in (2.0, 20.0))
    link = np.where(np.arange(len(PRIOR)) == 40, there[:, None], elsewhere[:, None] - 50.0)
    np.testing.assert_allclose(np.exp(_draws({}, [link, link]).mean(axis=0)), 2.0, rtol=0.15)
