"""The box around the image of an ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.bodies.outline import outline_boxes
from tests.core.bodies.cameras import camera_at, standing

CAMERA = camera_at([-1.0, -1.0, 2.8], [5.0, 4.0, 0.9])


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.48, -0.6, 0.64)])
def test_box_is_that_of_the_points_of_the_surface(up: tuple[float, float, float]) -> None:
    state = standing(2.0, 1.5)
    direction = np.array(up)
    generator = np.random.default_rng(1)
    sphere = generator.standard_normal((400_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    along = (sphere @ direction)[:, None] * direction
    half = np.exp(state[6:])
    pixels = CAMERA.project(state[:3] + half[0] * along + half[1] * (sphere - along))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    boxes, _ = outline_boxes(state[None], CAMERA, direction)
    assert boxes[0] == pytest.approx([(low[0] + high[0]) / 2, low[1], high[1], high[0] - low[0]], abs=0.05)


def test_derivative_is_that_of_finite_differences() -> None:
    state, up, step = standing(3.0, 2.0), np.array([0.0, 0.0, 1.0]), 1e-5
    _, jacobian = outline_boxes(state[None], CAMERA, up)
    moved = state + step * np.vstack([np.eye(8), -np.eye(8)])
    boxes, _ = outline_boxes(moved, CAMERA, up)
    assert jacobian[0] == pytest.approx(((boxes[:8] - boxes[8:]) / (2 * step)).T, rel=1e-6, abs=1e-4)


def test_bodies_that_reach_behind_the_camera_have_no_box() -> None:
    states = np.stack([standing(-3.0, -2.0), standing(-1.0, -1.0, height=6.0, width=3.0)])
    boxes, _ = outline_boxes(states, CAMERA, np.array([0.0, 0.0, 1.0]))
    assert np.isnan(boxes).all()
