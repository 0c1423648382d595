"""Boxes, births, prediction, occlusion and exclusion of bodies."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.bodies.births import body_shares_left, newborn_bodies
from stereophd.core.bodies.boxes import Boxes, box_variances, boxes_of, share_in_image
from stereophd.core.bodies.occlusion import exclusive_existence, hidden_shares
from stereophd.core.bodies.outline import outline_boxes
from stereophd.core.bodies.prediction import GROUND_TIME_S, predict_bodies
from stereophd.core.bodies.shapes.ellipsoid import Extent
from stereophd.core.disparity.events import make_event
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.region import box_half_spaces, pack_region
from stereophd.core.motion.constant_velocity import ConstantVelocity
from tests.core.bodies.cameras import camera_at, people, standing

UP = np.array([0.0, 0.0, 1.0])
CAMERA = camera_at([-1.0, -1.0, 2.8], [5.0, 4.0, 0.9])


def seen(states: np.ndarray, camera: Camera = CAMERA) -> Boxes:
    """Return the boxes of bodies as an event of a camera without lens has them."""
    values, _ = outline_boxes(states, camera, UP)
    pixels = np.stack([values[:, 0], (values[:, 1] + values[:, 2]) / 2], axis=1)
    sizes = np.stack([values[:, 3], values[:, 2] - values[:, 1]], axis=1)
    return boxes_of(make_event(camera, 0, 0.0, pixels, sizes=sizes), camera)


def test_half_extents_are_log_normal() -> None:
    mean, std = Extent(mean=1.7, std=0.3).log_moments
    half = np.exp(mean + std * np.random.default_rng(1).standard_normal(400_000))
    assert 2 * half.mean() == pytest.approx(1.7, rel=1e-3)
    assert 2 * half.std() == pytest.approx(0.3, rel=5e-3)


def test_a_side_at_the_border_is_left_out() -> None:
    pixels, sizes = np.array([[49.5, 539.5], [959.5, 979.5]]), np.array([[100.0, 200.0], [100.0, 200.0]])
    boxes = boxes_of(make_event(CAMERA, 0, 0.0, pixels, sizes=sizes), CAMERA)
    assert boxes.hidden.tolist() == [[False, False, False, True], [False, False, True, False]]
    # of a box whose left side is hidden, the right one stays
    assert boxes.selections[0] @ boxes.values[0] == pytest.approx([99.5, 439.5, 639.5, 0.0])
    assert boxes.selections[1] @ boxes.values[1] == pytest.approx([959.5, 879.5, 0.0, 100.0])
    assert boxes.log_clutter[0] > boxes_of(make_event(CAMERA, 0, 0.0, pixels + 200, sizes=sizes), CAMERA).log_clutter[0]


def test_boxes_of_a_lens_are_those_of_the_pinhole() -> None:
    bent = replace(CAMERA, lens=Lens("brown_conrady", k1=-0.1, k2=0.02, p1=0.0, p2=0.0))
    values, _ = outline_boxes(standing(4.0, 3.0)[None], CAMERA, UP)
    u, top, bottom, width = values[0]
    middle = (top + bottom) / 2
    sides = np.array([[u - width / 2, middle], [u + width / 2, middle], [u, top], [u, bottom]])
    bent_sides, _ = bent.distort_pixels(sides)
    low, high = [bent_sides[0, 0], bent_sides[2, 1]], [bent_sides[1, 0], bent_sides[3, 1]]
    pixels, sizes = np.add(low, high)[None] / 2, np.subtract(high, low)[None]
    boxes = boxes_of(make_event(bent, 0, 0.0, pixels, sizes=sizes), bent)
    assert boxes.values == pytest.approx(values, abs=1.0)
    assert share_in_image(values, bent) == pytest.approx([1.0])


@pytest.mark.parametrize("ground", [True, False])
def test_a_newborn_explains_its_box(ground: bool) -> None:
    shape = people() if ground else people(ground=None)
    state = standing(4.0, 2.5)
    newborns = newborn_bodies(seen(state[None]), CAMERA, shape, 0.7, None)
    boxes, _ = outline_boxes(newborns.states, CAMERA, UP)
    truth, _ = outline_boxes(state[None], CAMERA, UP)
    assert boxes == pytest.approx(truth, abs=3.0)
    off = (newborns.states - state)[0, :3]
    std = np.sqrt(np.diag(newborns.covariances[0])[:3])
    assert (np.abs(off) < 1.5 * std).all()
    # one box leaves the distance along the ray open unless the body stands
    assert std.max() < 0.5 if ground else std.max() > 0.3


def test_density_of_a_newborn_is_the_integral_over_the_prior() -> None:
    """Importance sampling of the integral that the method of Laplace approximates."""
    shape, boxes = people(), seen(standing(4.0, 2.5, height=1.8)[None])
    assert shape.ground is not None
    newborns = newborn_bodies(boxes, CAMERA, shape, 0.7, None)
    kept = [0, 1, 2, 6, 7]
    mean, covariance = newborns.states[0, kept], newborns.covariances[0][np.ix_(kept, kept)]
    generator = np.random.default_rng(2)
    drawn = generator.multivariate_normal(mean, covariance, 40_000)
    off = drawn - mean
    proposal = -0.5 * (
        np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off) + np.linalg.slogdet(2 * np.pi * covariance)[1]
    )
    states = np.zeros((len(drawn), 8))
    states[:, kept] = drawn
    projected, _ = outline_boxes(states, CAMERA, UP)
    variances = box_variances(
        projected[:, 2] - projected[:, 1], np.ones((len(drawn), 4)), np.array((0.06, 0.045, 0.05, 0.09))
    )

    def log_normal(value: np.ndarray, variance: np.ndarray | float) -> np.ndarray:
        return np.asarray(-0.5 * (value**2 / variance + np.log(2 * np.pi * variance)))

    log_mean, log_covariance = shape.log_axes()
    depth = CAMERA.pose.to_camera(states[:, :3])[:, 2]
    density = CAMERA.fx * CAMERA.fy * (2.8 - states[:, 2]) / (depth**3 * CAMERA.width * CAMERA.height)
    integrand = (
        log_normal(boxes.values - projected, variances).sum(axis=1)
        + log_normal(states[:, 6:] - log_mean, np.diag(log_covariance)).sum(axis=1)
        + log_normal(states[:, 2] - np.exp(states[:, 6]), shape.ground.std**2)
        + np.log(density)
        - proposal
    )
    assert newborns.log_densities[0] == pytest.approx(math.log(np.mean(np.exp(integrand))), abs=0.15)


def test_a_region_decides_where_bodies_are_born() -> None:
    boxes = seen(np.stack([standing(2.0, 2.0), standing(8.0, 6.0)]))
    region = pack_region((0.0, np.inf), box_half_spaces({"x": (0.0, 4.0), "y": (0.0, 4.0), "z": (0.0, 0.1)}))
    inside = newborn_bodies(boxes, CAMERA, people(), 0.7, region).log_densities
    anywhere = newborn_bodies(boxes, CAMERA, people(), 0.7, None).log_densities
    gain = np.sort(inside - anywhere)
    # a thin region holds those whose feet it holds
    assert gain[1] == pytest.approx(0.0, abs=0.05)
    assert gain[0] < -20.0


def test_frames_leave_few_undetected_objects_where_views_overlap() -> None:
    cameras = [
        CAMERA,
        camera_at([11.0, 9.0, 2.8], [5.0, 4.0, 0.9], "b"),
        camera_at([-2.0, -2.0, 2.8], [-9.0, -9.0, 0.9], "c"),
    ]
    left = body_shares_left(cameras, people())
    assert np.diag(left) == pytest.approx([0.05] * 3)
    assert left[0, 1] < 0.7
    assert left[2, 0] > 0.9


def test_standing_bodies_stay_on_the_ground() -> None:
    shape, motion = people(), ConstantVelocity(0.8)
    state = standing(1.0, 2.0)
    state[3:6] = 1.0, -0.5, 0.3
    state[2] += 0.2
    covariance = np.diag([0.01, 0.01, 0.01, 0.1, 0.1, 0.1, 1e-3, 1e-3])
    means, covariances = predict_bodies(state[None], covariance[None], 0.5, motion, shape)
    assert means[0, :2] == pytest.approx([1.5, 1.75])
    assert means[0, 2] == pytest.approx(0.85 + 0.2 * math.exp(-0.5 / GROUND_TIME_S))
    assert means[0, 5] == 0.0
    means, covariances = predict_bodies(state[None], covariance[None], 60.0, motion, shape)
    height = covariances[0, 2, 2] + covariances[0, 6, 6] * 0.85**2 - 2 * covariances[0, 2, 6] * 0.85
    assert height == pytest.approx(0.05**2, rel=1e-6)
    free, _ = predict_bodies(state[None], covariance[None], 0.5, motion, people(ground=None))
    assert free[0, 2] == pytest.approx(state[2] + 0.15)


def test_nearer_bodies_hide_those_behind() -> None:
    far, near = standing(4.0, 3.0), standing(2.0, 1.5)
    states = np.stack([far, near])
    boxes, _ = outline_boxes(states, CAMERA, UP)
    covariances = np.tile(1e-4 * np.eye(8), (2, 1, 1))
    hidden = hidden_shares(boxes, states, covariances, np.ones(2), CAMERA)
    low, high = np.maximum(boxes[0, 1], boxes[1, 1]), np.minimum(boxes[0, 2], boxes[1, 2])
    left = max(boxes[0, 0] - boxes[0, 3] / 2, boxes[1, 0] - boxes[1, 3] / 2)
    right = min(boxes[0, 0] + boxes[0, 3] / 2, boxes[1, 0] + boxes[1, 3] / 2)
    expected = (right - left) * (high - low) / (boxes[0, 3] * (boxes[0, 2] - boxes[0, 1]))
    assert 0.3 < expected < 1.0
    assert hidden == pytest.approx([expected, 0.0], abs=1e-9)
    doubtful = hidden_shares(boxes, states, covariances, np.array([1.0, 0.25]), CAMERA)
    assert doubtful[0] == pytest.approx(0.25 * expected)


def test_two_bodies_in_one_place_cannot_both_exist() -> None:
    states = np.stack([standing(1.0, 1.0), standing(1.0, 1.0), standing(3.0, 1.0)])
    covariances = np.tile(1e-8 * np.eye(8), (3, 1, 1))
    shown = np.ones(3, dtype=bool)
    existence = exclusive_existence(np.array([0.9, 0.5, 0.7]), states, covariances, shown, UP)
    # of the joint probabilities .05, .45, .05 and .45 (both) the last one is impossible
    assert existence == pytest.approx([0.45 / 0.55, 0.05 / 0.55, 0.7], abs=1e-6)
    certain = exclusive_existence(np.ones(3), states, covariances, shown, UP)
    assert certain == pytest.approx([0.5, 0.5, 1.0], abs=1e-6)


def test_nobody_appears_in_touch_with_somebody() -> None:
    """0.4 apart, with half widths of 0.25: people who are known may stand so, but nobody is born there."""
    states = np.stack([standing(1.0, 1.0), standing(1.4, 1.0)])
    covariances = np.tile(1e-8 * np.eye(8), (2, 1, 1))
    existence = np.array([0.9, 0.5])
    known = exclusive_existence(existence, states, covariances, np.array([True, True]), UP)
    assert known == pytest.approx(existence)
    new = exclusive_existence(existence, states, covariances, np.array([True, False]), UP)
    assert new == pytest.approx([0.45 / 0.55, 0.05 / 0.55], abs=1e-6)
