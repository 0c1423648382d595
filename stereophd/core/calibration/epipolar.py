"""Epipolar distances of pairs of one-camera tracks, and their derivatives by the values of the cameras.

The rays of one object before two cameras meet. With the essential matrix E of the pair and rays x_a, x_b at one time,

    r = x_b^T E x_a / |gradient of the numerator with respect to the four pixels|

is the distance from that in pixels to first order (P. D. Sampson, 1982; R. Hartley and A. Zisserman, "Multiple View
Geometry in Computer Vision", section 11.4.3), free of scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.parameters import ParameterSet
from stereophd.core.calibration.quantities.base import MOVES
from stereophd.core.calibration.track_pairs import TrackPairs
from stereophd.core.calibration.track_rays import Rays, rays_of
from stereophd.core.geometry.camera import Camera

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

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
    index = pairs.cameras[pairs.pair[rows]]
    essential = np.zeros((len(cameras), len(cameras), 3, 3))
    for i, j in set(map(tuple, pairs.cameras.tolist())):
        turn = cameras[j].pose.rotation @ cameras[i].pose.rotation.T
        x, y, z = cameras[j].pose.rotation @ (cameras[i].pose.center - cameras[j].pose.center)
        essential[i, j] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ turn
    matrix = essential[index[:, 0], index[:, 1]]
    a, b = pairs.rays[rows, 0], pairs.rays[rows, 1]
    line_b = np.einsum("nij,nj->ni", matrix, a)
    line_a = np.einsum("nij,ni->nj", matrix, b)
    slopes = ((line_b[:, :2] / focal[index[:, 1]]) ** 2 + (line_a[:, :2] / focal[index[:, 0]]) ** 2).sum(axis=1)
    distance = (b * line_b).sum(axis=1) / np.sqrt(np.maximum(slopes, 1e-300))
    return np.asarray(distance / pairs.sigma[rows])


def _raw_distances(cameras: Sequence[Camera], pairs: TrackPairs, rows: Integers, known: Rays | None) -> Array:
    assert pairs.raw is not None
    found = rays_of(cameras, pairs.raw, pairs.entries[rows], pairs.others[rows], known)
    focal = np.array([[c.fx, c.fy] for c in cameras])[pairs.cameras[pairs.pair[rows]]]
    turn_a, turn_b = found.rotations[:, 0], found.rotations[:, 1]
    # x_b^T [t]_x R x_a with t = R_b (c_a - c_b) and R = R_b R_a^T, and its derivatives by x_a and x_b
    along = np.einsum("nij,nj->ni", turn_b, found.centers[:, 0] - found.centers[:, 1])
    a_in_b = np.einsum("nij,nkj,nk->ni", turn_b, turn_a, found.rays[:, 0])
    line_b = np.cross(along, a_in_b)
    line_a = np.einsum("nij,nkj,nk->ni", turn_a, turn_b, np.cross(found.rays[:, 1], along))
    slopes = ((line_b[:, :2] / focal[:, 1]) ** 2 + (line_a[:, :2] / focal[:, 0]) ** 2).sum(axis=1)
    distance = (found.rays[:, 1] * line_b).sum(axis=1) / np.sqrt(np.maximum(slopes, 1e-300))
    return np.asarray(np.where(found.seen, distance / pairs.sigma[rows], np.nan))


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
