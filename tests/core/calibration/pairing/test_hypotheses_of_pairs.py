"""Corners of a board are paired from cameras that are off by more than the distance of two corners."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.pairing.hypotheses import crowded, hypotheses
from stereophd.core.calibration.pairing.refinement import TOLERANCES, judged
from stereophd.core.calibration.pairing.search import distinct_pairings
from stereophd.core.calibration.pairing.track_pairs import TrackPairs, make_pairs
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import rotation_from_vector
from tests.scenes import build_camera

CORNERS, FRAMES, SPACING, NOISE = 8, 24, 0.054, 0.5
PRIORS = {"center": 0.07, "rotation": 0.052, "focal": 0.1}
LENSES = {**PRIORS, "focal": 0.03, "k1": 0.1}


def board(times: np.ndarray) -> np.ndarray:
    """Corners (f, k, 3) of a board that is carried and turned by hand about a metre away."""
    flat = SPACING * np.array([[x - 1.5, y - 0.5, 0.0] for y in range(2) for x in range(4)])
    turns = [rotation_from_vector([0.5 * np.sin(t), 0.6 * np.cos(0.8 * t), 0.4 * np.sin(1.3 * t)]) for t in times]
    way = np.column_stack([0.15 * np.sin(0.9 * times), 0.1 * np.cos(1.1 * times), 1.0 + 0.15 * np.sin(0.7 * times)])
    return np.stack([flat @ turn.T + step for turn, step in zip(turns, way, strict=True)])


def swarm(times: np.ndarray) -> np.ndarray:
    """Positions (f, k, 3) of objects that fly on their own ways through all of the view."""
    rng = np.random.default_rng(3)
    middle, reach = rng.uniform(-0.4, 0.4, (CORNERS, 3)), rng.uniform(0.1, 0.4, (CORNERS, 3))
    turns = times[:, None, None] * rng.uniform(0.5, 1.5, (CORNERS, 3)) + rng.uniform(0.0, 6.0, (CORNERS, 3))
    return np.array([0.0, 0.0, 1.5]) + middle + reach * np.sin(turns)


def cameras_around() -> tuple[Camera, ...]:
    places = (([0.0] * 3, [0.0] * 3), ([0.7, 0.0, 0.2], [0.0, 0.7, 0.0]), ([0.0, 0.6, 0.2], [-0.6, 0.0, 0.0]))
    same = {"size": (1280, 720), "focal": 800.0, "noise": NOISE, "p_detect": 1.0, "clutter": 0.0}
    return tuple(build_camera(f"cam{k}", *place, **same) for k, place in enumerate(places))


def unknowns(cameras: tuple[Camera, ...], priors: Mapping[str, float] = PRIORS) -> ParameterSet:
    names = {"center": ("center_x", "center_y", "center_z"), "rotation": ("rotation_x", "rotation_y", "rotation_z")}
    return ParameterSet(
        cameras,
        tuple(
            Parameter(component, camera.name, 0.0, std)
            for k, camera in enumerate(cameras)
            for quantity, std in priors.items()
            for component in names.get(quantity, (quantity,))
            if k or quantity in ("focal", "k1")
        ),
    )


def pairs_about(
    guess: ParameterSet,
    true: tuple[Camera, ...],
    seed: int,
    positions: Callable[[np.ndarray], np.ndarray] = board,
) -> TrackPairs:
    """Pairs of the true one-camera tracks: track number is camera times corners plus corner."""
    rng = np.random.default_rng(seed)
    frames = []
    for k, camera in enumerate(true):
        times = (np.arange(FRAMES) + 0.3 * k) / 6.0
        for time_s, points in zip(times.tolist(), positions(times), strict=True):
            pixels = camera.project(points)
            frames.append((k, time_s, pixels + rng.normal(scale=NOISE, size=pixels.shape), None))
    frames.sort(key=lambda frame: frame[1])
    recording = Recording.of(guess.cameras, frames)
    of_camera = recording.cameras[recording.frame_of]
    tracks = [
        (k, np.flatnonzero(of_camera == k)[corner::CORNERS]) for k in range(len(true)) for corner in range(CORNERS)
    ]
    return make_pairs(guess, Scans.of(recording, guess.cameras), tracks)


def test_corners_are_paired_from_a_guess_that_is_off_by_more_than_their_distance() -> None:
    rng = np.random.default_rng(1)
    true = unknowns(cameras_around())
    moved = true.prior_std * rng.standard_normal(true.size)
    guess = true.about(true.guess(moved))
    pairs = pairs_about(guess, true.cameras, 1)
    assert crowded(pairs)
    best = hypotheses(guess, pairs, guess.prior_mean)[0]
    tracks = pairs.tracks[best.chosen]
    assert (tracks[:, 0] % CORNERS == tracks[:, 1] % CORNERS).all()
    assert len(tracks) == 3 * CORNERS


def test_lenses_and_focal_lengths_are_fitted_while_tracks_are_paired() -> None:
    true = unknowns(tuple(replace(camera, lens=Lens("radial", k1=-0.05)) for camera in cameras_around()), LENSES)
    moved = np.where([name.endswith(("focal", "k1")) for name in true.names], 1.5, 0.5) * true.prior_std
    guess = true.about(true.guess(moved))
    right = guess.difference(true.cameras)
    pairs = pairs_about(guess, true.cameras, 1, swarm)
    best = distinct_pairings(guess, pairs, guess.prior_mean[None])[0]
    assert best.gain > 0.99 * judged(guess, pairs, right, TOLERANCES[-1]).gain
    assert np.sqrt((((best.values - right) / guess.prior_std) ** 2).mean()) < 0.5


def test_tracks_with_few_partners_are_not_crowded() -> None:
    true = unknowns(cameras_around())
    pairs = pairs_about(true, true.cameras, 0)
    corner = pairs.tracks % CORNERS
    few = pairs.take(np.flatnonzero((corner < 3).all(axis=1)))
    assert not crowded(few)
    none = np.empty(0, dtype=np.int64)
    assert not crowded(replace(pairs, cameras=none.reshape(0, 2), tracks=none.reshape(0, 2), pair=none))


def test_hypotheses_without_pairs_are_none() -> None:
    true = unknowns(cameras_around())
    pairs = pairs_about(true, true.cameras, 0)
    empty = pairs.take(np.empty(0, dtype=np.int64))
    assert hypotheses(true, empty, true.prior_mean) == []
