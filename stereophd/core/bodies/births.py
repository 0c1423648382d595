"""New bodies, each from one box, with the height of objects and the ground for what a box does not measure.

Objects that no camera has detected yet are uniform over the image: at depths whose logarithm is uniform, or on the
ground. The state that explains a box best under that prior is found by Gauss-Newton steps, and its evidence by the
method of Laplace (C. M. Bishop, "Pattern Recognition and Machine Learning", 2006, section 4.4).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from stereophd.core.arrays import Array
from stereophd.core.bodies.boxes import EXTENT_RANGE, Boxes, box_middles, box_variances
from stereophd.core.bodies.outline import BOTTOM, LOG_AXES, POSITION, STATE_SIZE, TOP, VELOCITY, WIDTH, outline_boxes
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.region import half_spaces
from stereophd.core.multi.births.undetected import pixel_grid, shares_left

STEPS = 3
# Columns of a state that a box tells of.
MEASURED = [0, 1, 2, 6, 7]
# Depths, in heights of an object, at which it is measured how far views overlap.
OVERLAP_DEPTHS = (2.0, 5.0, 10.0, 20.0)


@dataclass(frozen=True)
class Newborns:
    """The bodies that the boxes (m,) of an event may have given birth to."""

    states: Array  # (m, 8)
    covariances: Array  # (m, 8, 8)
    log_densities: Array  # (m,): Logarithm of the density of each box, given a new object; -inf where none fits


def newborn_bodies(
    boxes: Boxes, camera: Camera, shape: EllipsoidSettings, velocity_std: float, region: Array | None
) -> Newborns:
    """Return the new bodies that explain boxes.

    The camera is that at the time of the event. `velocity_std` is the standard deviation of each component of the
    velocity of new objects, length/s; objects can be in the `region` (r,) only
    (`stereophd.core.disparity.events.Rig.region`).
    """
    up = shape.direction
    log_mean, log_covariance = shape.log_axes()
    log_precision = np.linalg.inv(log_covariance)
    states = _first_guess(boxes, camera, log_mean)
    cost, curvature = np.full(len(boxes), np.inf), np.broadcast_to(np.eye(5), (len(boxes), 5, 5))
    for step in range(STEPS + 1):
        projected, slopes = outline_boxes(states, camera, up)
        heights = projected[:, BOTTOM] - projected[:, TOP]
        variances = box_variances(heights, boxes.scales, np.asarray(camera.detector.box_noise))
        noises = boxes.selections @ (variances[:, :, None] * boxes.selections.swapaxes(1, 2))
        noises[:, range(4), range(4)] += boxes.hidden
        noises = np.where(np.isfinite(noises), noises, np.eye(4))
        weights = np.linalg.inv(noises)
        rows = boxes.selections @ slopes[:, :, MEASURED]
        residuals = np.einsum("mij,mj->mi", boxes.selections, boxes.values - projected)
        off = states[:, LOG_AXES] - log_mean
        curvature = rows.swapaxes(1, 2) @ weights @ rows
        gradient = np.einsum("mri,mrs,ms->mi", rows, weights, residuals)
        curvature[:, 3:, 3:] += log_precision
        gradient[:, 3:] -= off @ log_precision
        cost = np.einsum("mi,mij,mj->m", residuals, weights, residuals) + np.einsum(
            "mi,ij,mj->m", off, log_precision, off
        )
        cost += np.linalg.slogdet(noises)[1] + (4 - boxes.hidden.sum(axis=1)) * math.log(2.0 * math.pi)
        if shape.ground is not None:
            half = np.exp(states[:, LOG_AXES.start])
            height = (states[:, POSITION] - shape.ground.point) @ up - half
            row = np.column_stack([np.broadcast_to(up, (len(boxes), 3)), -half, np.zeros(len(boxes))])
            precision = shape.ground.std**-2
            curvature += precision * row[:, :, None] * row[:, None, :]
            gradient -= precision * height[:, None] * row
            cost += precision * height**2 + math.log(2.0 * math.pi / precision)
        good = np.isfinite(curvature).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1)
        curvature = np.where(good[:, None, None], curvature, np.eye(5))
        curvature[:, range(5), range(5)] *= 1.0 + 1e-9
        if step < STEPS:
            change = np.linalg.solve(curvature, gradient[:, :, None])[:, :, 0]
            change[:, 3:] = np.clip(change[:, 3:], -0.5, 0.5)
            states = states.copy()
            states[:, MEASURED] += np.where(good[:, None], change, np.nan)
    covariances = np.zeros((len(boxes), STATE_SIZE, STATE_SIZE))
    covariances[np.ix_(range(len(boxes)), MEASURED, MEASURED)] = np.linalg.inv(curvature)
    covariances[:, VELOCITY, VELOCITY] = velocity_std**2 * np.eye(3)
    log_densities = (
        -0.5 * (cost + np.linalg.slogdet(2.0 * math.pi * log_covariance)[1])
        + 2.5 * math.log(2.0 * math.pi)
        - 0.5 * np.linalg.slogdet(curvature)[1]
        + _log_prior(states[:, POSITION], camera, shape)
        + _log_inside(states, covariances, region, up)
    )
    good = np.isfinite(log_densities) & np.isfinite(states).all(axis=1)
    return Newborns(np.where(good[:, None], states, 0.0), covariances, np.where(good, log_densities, -np.inf))


def _first_guess(boxes: Boxes, camera: Camera, log_mean: Array) -> Array:
    """States (m, 8) of bodies of mean size whose box is as high, or where the border hides that, as wide."""
    values = boxes.values
    height, width = np.maximum(values[:, BOTTOM] - values[:, TOP], 1.0), np.maximum(values[:, WIDTH], 1.0)
    depths = camera.fy * 2.0 * math.exp(log_mean[0]) / height
    no_height = boxes.hidden[:, TOP] | boxes.hidden[:, BOTTOM]
    depths = np.where(no_height, camera.fx * 2.0 * math.exp(log_mean[1]) / width, depths)
    states = np.zeros((len(values), STATE_SIZE))
    states[:, POSITION] = camera.pose.to_world(camera.pinhole_rays(box_middles(values)) * depths[:, None])
    states[:, LOG_AXES] = log_mean
    return states


def _log_prior(positions: Array, camera: Camera, shape: EllipsoidSettings) -> Array:
    """Logarithm of the density (n,) of new objects, uniform over the image, per volume, or per area of the ground."""
    depths = camera.pose.to_camera(positions)[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        density = np.log(camera.fx * camera.fy / (camera.width * camera.height)) - 3.0 * np.log(depths)
        if shape.ground is None:
            return np.asarray(density - math.log(math.log(EXTENT_RANGE)))
        return np.asarray(density + np.log(np.abs((positions - camera.pose.center) @ shape.direction)))


def _log_inside(states: Array, covariances: Array, region: Array | None, up: Array) -> Array | float:
    """Logarithm of the probability (n,) that some part of each body is in the half-spaces of the region."""
    if region is None:
        return 0.0
    normals = half_spaces(region)[:, :3]
    variances = np.einsum("hi,nij,hj->nh", normals, covariances[:, POSITION, POSITION], normals)
    inside = ndtr(depths_inside(states, region, up) / np.sqrt(np.maximum(variances, 1e-30)))
    return np.asarray(np.log(np.maximum(inside, 1e-300)).sum(axis=1))


def depths_inside(states: Array, region: Array, up: Array) -> Array:
    """How far (n, h) some part of each body reaches into each half-space of the region, length."""
    spaces, squares = half_spaces(region), np.exp(2.0 * states[:, LOG_AXES])
    reach = np.sqrt(squares[:, 1:] + (squares[:, :1] - squares[:, 1:]) * (spaces[:, :3] @ up) ** 2)
    return np.asarray(spaces[:, 3] + reach - states[:, POSITION] @ spaces[:, :3].T)


def body_shares_left(cameras: Sequence[Camera], shape: EllipsoidSettings) -> Array:
    """Return `shares_left` of bodies that are uniform over the image, on the ground or at some depths."""

    def places(camera: Camera) -> Array:
        rays = camera.pose.to_world(camera.rays(pixel_grid(camera))) - camera.pose.center
        if shape.ground is None:
            depths = np.repeat(np.array(OVERLAP_DEPTHS) * shape.height.mean, len(rays))
            return np.asarray(camera.pose.center + np.tile(rays, (len(OVERLAP_DEPTHS), 1)) * depths[:, None])
        middle = np.array(shape.ground.point) + shape.direction * shape.height.mean / 2.0
        with np.errstate(divide="ignore", invalid="ignore"):
            depths = (middle - camera.pose.center) @ shape.direction / (rays @ shape.direction)
        return np.asarray(camera.pose.center + rays * np.where(depths > 0.0, depths, np.nan)[:, None])

    return shares_left(cameras, places)
