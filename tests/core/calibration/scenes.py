"""Small calibration problems for the tests: straight objects before two or three cameras, association known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.problem import Observations
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.pose import CENTER, ROTATION
from stereophd.core.geometry.camera import Camera
from tests import scenes

STDS = (5.0, 5.0, 5.0, np.pi / 180, np.pi / 24, np.pi / 180)
SIGMA = 1.4


@dataclass(frozen=True)
class MadeUp:
    """Truth and detections: the values that lead from the guess to the truth, and what was seen."""

    parameters: ParameterSet
    truth: Array
    observations: Observations
    positions: Array


def camera(name: str, center: tuple[float, float, float], vector: tuple[float, float, float]) -> Camera:
    """A camera of the paper's experiments."""
    detector = {"noise": SIGMA, "p_detect": 0.95, "clutter": 10.0}
    return scenes.build_camera(name, center, vector, focal=(899.0, 889.0), middle=(400.0, 300.0), **detector)


def make_problem(seed: int, objects: int = 6, frames: int = 60, three: bool = False, still: bool = False) -> MadeUp:
    """Draw objects, detections and a guess of the cameras."""
    rng = np.random.default_rng(seed)
    cameras = [camera("left", (-20, 0, 0), (0, -0.26, 0)), camera("right", (20, 0, 0), (0, 0.26, 0))]
    if three:
        cameras.append(camera("above", (0, -25, 0), (0.166, 0, 0)))
    unknown = [c.name for c in cameras[1:]]
    parameters = tuple(
        Parameter(name, c, 0.0, std) for c in unknown for name, std in zip(CENTER + ROTATION, STDS, strict=True)
    )
    true = ParameterSet(tuple(cameras), parameters)
    truth = true.sample(rng, 1)[0]
    guess = ParameterSet(true.guess(truth), parameters)
    start = rng.uniform([-25, -20, 100], [25, 20, 220], (objects, 3))
    velocity = np.zeros((objects, 3)) if still else rng.normal(0.0, 0.4, (objects, 3))
    rows = [
        (j, k, float(t), *(start[j] + t * velocity[j]))
        for j in range(objects)
        for t in range(frames)
        for k in range(len(cameras))
    ]
    table = np.array(rows)
    indices, numbers, times, points = table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2], table[:, 3:]
    pixels = np.empty((len(table), 2))
    for k, c in enumerate(cameras):
        pixels[numbers == k] = c.project(points[numbers == k])
    pixels += SIGMA * rng.standard_normal(pixels.shape)
    precisions = np.tile(np.eye(2) / SIGMA**2, (len(table), 1, 1))
    observations = Observations(indices, numbers, times, pixels, precisions, times, pixels[:, 1] / 600.0)
    return MadeUp(guess, truth, observations, points)
