"""Epipolar distances of pairs of one-camera tracks, and their derivatives by the values of the cameras.

The rays of one object before two cameras meet. With the essential matrix E of the pair and rays x_a, x_b at one time,

    r = x_b^T E x_a / |gradient of the numerator with respect to the four pixels|

is the distance from that in pixels to first order (P. D. Sampson, 1982; R. Hartley and A. Zisserman, "Multiple View
Geometry in Computer Vision", section 11.4.3), free of scale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.pairing.track_pairs import TrackPairs
from stereophd.core.calibration.pairing.track_rays import Rays, rays_of
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import MOVES
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.compilation.compiled import compiled

# Step of the numerical derivative, in prior standard deviations.
DERIVATIVE_STEP = 1e-4


def epipolar_distances(
    cameras: Sequence[Camera], pairs: TrackPairs, rows: Integers, known: Rays | None = None
) -> Array:
    """Signed epipolar distances (r,), in units of the noise, of rows of the pairs under cameras.

    NaN where the tracks were not seen at one time by the clocks of the cameras. `known` rays, if any, are those of
    the same rows, clocks and lenses.
    """
    if pairs.raw is not None:
        return _raw_distances(cameras, pairs, rows, known)
    focal = np.array([[c.fx, c.fy] for c in cameras])
    essential = np.zeros((len(cameras), len(cameras), 3, 3))
    for i, j in pairs.camera_pairs:
        turn = cameras[j].pose.rotation @ cameras[i].pose.rotation.T
        x, y, z = cameras[j].pose.rotation @ (cameras[i].pose.center - cameras[j].pose.center)
        essential[i, j] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ turn
    out = np.empty(len(rows))
    _fixed_distances(essential, focal, pairs.cameras, pairs.pair, pairs.rays, pairs.sigma, rows, out)
    return out


def _raw_distances(cameras: Sequence[Camera], pairs: TrackPairs, rows: Integers, known: Rays | None) -> Array:
    assert pairs.raw is not None
    found = rays_of(cameras, pairs.raw, pairs.entries[rows], pairs.others[rows], known)
    focal = np.array([[c.fx, c.fy] for c in cameras])
    out = np.empty(len(rows))
    _moving_distances(
        found.rotations, found.centers, found.rays, found.seen, focal, pairs.cameras, pairs.pair, pairs.sigma, rows, out
    )
    return out


@compiled
def _fixed_distances(
    essential: Array,
    focal: Array,
    cameras: Integers,
    pair: Integers,
    rays: Array,
    sigma: Array,
    rows: Integers,
    out: Array,
) -> None:
    """Distances (r,) of rows of pairs, from the essential matrices (c, c, 3, 3) and focal lengths (c, 2)."""
    line_a, line_b = np.empty(3), np.empty(3)
    for n in range(len(rows)):
        row = rows[n]
        i, j = cameras[pair[row], 0], cameras[pair[row], 1]
        matrix, a, b = essential[i, j], rays[row, 0], rays[row, 1]
        for k in range(3):
            line_b[k] = matrix[k, 0] * a[0] + matrix[k, 1] * a[1] + matrix[k, 2] * a[2]
            line_a[k] = matrix[0, k] * b[0] + matrix[1, k] * b[1] + matrix[2, k] * b[2]
        out[n] = _distance(line_a, line_b, b, focal[i], focal[j]) / sigma[row]


@compiled
def _moving_distances(
    rotations: Array,
    centers: Array,
    rays: Array,
    seen: NDArray[np.bool_],
    focal: Array,
    cameras: Integers,
    pair: Integers,
    sigma: Array,
    rows: Integers,
    out: Array,
) -> None:
    """Distances (r,) of rows of pairs, from the `Rays` of these rows; NaN where they were not seen."""
    apart, along, axis, normal = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    line_a, line_b = np.empty(3), np.empty(3)
    for n in range(len(rows)):
        if not seen[n]:
            out[n] = np.nan
            continue
        turn_a, turn_b, a, b = rotations[n, 0], rotations[n, 1], rays[n, 0], rays[n, 1]
        # x_b^T [t]_x R x_a with t = R_b (c_a - c_b) and R = R_b R_a^T, and its derivatives by x_a and x_b
        for k in range(3):
            apart[k] = centers[n, 0, k] - centers[n, 1, k]
            axis[k] = turn_a[0, k] * a[0] + turn_a[1, k] * a[1] + turn_a[2, k] * a[2]
        _turned(turn_b, apart, along)
        _turned(turn_b, axis, normal)
        _cross(along, normal, line_b)
        _cross(b, along, normal)
        for k in range(3):
            axis[k] = turn_b[0, k] * normal[0] + turn_b[1, k] * normal[1] + turn_b[2, k] * normal[2]
        _turned(turn_a, axis, line_a)
        i, j = cameras[pair[rows[n]], 0], cameras[pair[rows[n]], 1]
        out[n] = _distance(line_a, line_b, b, focal[i], focal[j]) / sigma[rows[n]]


@compiled
def _turned(rotation: Array, vector: Array, out: Array) -> None:
    for k in range(3):
        out[k] = rotation[k, 0] * vector[0] + rotation[k, 1] * vector[1] + rotation[k, 2] * vector[2]


@compiled
def _cross(one: Array, other: Array, out: Array) -> None:
    out[0] = one[1] * other[2] - one[2] * other[1]
    out[1] = one[2] * other[0] - one[0] * other[2]
    out[2] = one[0] * other[1] - one[1] * other[0]


@compiled
def _distance(line_a: Array, line_b: Array, ray_b: Array, focal_a: Array, focal_b: Array) -> float:
    """Signed distance, px, from the derivatives of the numerator by both rays (3,)."""
    slopes = (line_b[0] / focal_b[0]) ** 2 + (line_b[1] / focal_b[1]) ** 2
    slopes += (line_a[0] / focal_a[0]) ** 2 + (line_a[1] / focal_a[1]) ** 2
    numerator = ray_b[0] * line_b[0] + ray_b[1] * line_b[1] + ray_b[2] * line_b[2]
    return float(numerator / math.sqrt(max(slopes, 1e-300)))


def slopes_of(
    parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers, columns: Integers
) -> tuple[Array, Array]:
    """Distances (r,) of rows at values (m,), and their derivatives (r, c) in prior standard deviations of some values.

    Numerical derivatives; where a value only moves a camera, the rays in its axes are kept.
    """
    std, cameras = parameters.prior_std, parameters.build(values)
    known = None
    if pairs.raw is not None:
        known = rays_of(cameras, pairs.raw, pairs.entries[rows], pairs.others[rows])
    distances = epipolar_distances(cameras, pairs, rows, known)
    jacobian = np.zeros((len(rows), len(columns)))
    names = np.array([camera.name for camera in cameras])[pairs.cameras[pairs.pair[rows]]]
    for column, k in enumerate(columns.tolist()):
        moved, parameter = values.copy(), parameters.parameters[k]
        moved[k] += DERIVATIVE_STEP * std[k]
        here = np.flatnonzero(np.isin(names, parameter.cameras).any(axis=1))
        kept = known.take(here) if known is not None and parameter.quantity.affects == MOVES else None
        changed = epipolar_distances(parameters.rebuilt(cameras, moved, k), pairs, rows[here], kept)
        jacobian[here, column] = (changed - distances[here]) / DERIVATIVE_STEP
    return distances, jacobian
