"""Errors of calibrated cameras: rotation, direction of translation, scale and centre, apart and together.

Poses are compared relative to a reference camera, so that a common motion of all cameras does not count:
with R_k, c_k of camera k and r the reference, the relative pose is (R_k R_r^T, R_r (c_k - c_r)).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array
from stereophd.core.geometry.pose import Pose, rotation_to_vector

# Eigenvalues of correlations below this are rounding.
LEAST_EIGENVALUE = 1e-12


@dataclass(frozen=True)
class PoseErrors:
    """Errors of k cameras, all but the reference."""

    rotation: Array  # (k,): Angle between estimated and true rotation, rad
    # (k,): Angle between estimated and true direction from the reference, rad; NaN of a camera at the reference.
    direction: Array
    scale_ratio: Array  # (k,): Estimated over true distance from the reference
    center: Array  # (k,): Distance of estimated and true centre, length
    # (k,): The same after all centres were scaled about the reference by the common factor that fits best.
    center_after_scale: Array
    common_scale: float  # Estimated scale of the whole scene over the true one: the inverse of that factor


def pose_errors(estimated: Sequence[Pose], true: Sequence[Pose], reference: int) -> PoseErrors:
    """Compare the poses of cameras, pair by pair, relative to the camera of index `reference`.

    Raises ValueError when the numbers of poses differ, or there are fewer than two.
    """
    if len(estimated) != len(true) or len(true) < 2:
        raise ValueError(f"expected two or more poses and as many true ones, found {len(estimated)} and {len(true)}")
    others = [k for k in range(len(true)) if k != reference]
    rotation_e, offset_e = _relative(estimated, reference, others)
    rotation_t, offset_t = _relative(true, reference, others)
    angles = [np.linalg.norm(rotation_to_vector(a @ b.T)) for a, b in zip(rotation_e, rotation_t, strict=True)]
    length_e, length_t = np.linalg.norm(offset_e, axis=1), np.linalg.norm(offset_t, axis=1)
    cross = np.linalg.norm(np.cross(offset_e, offset_t), axis=1)
    inner = (offset_e * offset_t).sum(axis=1)
    apart = (length_e > 0.0) & (length_t > 0.0)
    square = float((offset_e**2).sum())
    factor = float(inner.sum()) / square if square > 0.0 else np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = length_e / length_t
    return PoseErrors(
        np.array(angles),
        np.where(apart, np.arctan2(cross, inner), np.nan),
        ratio,
        np.linalg.norm(offset_e - offset_t, axis=1),
        np.linalg.norm(factor * offset_e - offset_t, axis=1),
        1.0 / factor if factor else np.nan,
    )


def normalised_error_squared(error: ArrayLike, covariance: ArrayLike) -> float:
    """NEES: error^T covariance^-1 error; its expectation is the number of errors if the covariance is right.

    NaN if the covariance is singular or nearly so (`LEAST_EIGENVALUE` of the correlations), because there are fewer
    particles than parameters, or they are all in one place.
    """
    e, matrix = np.asarray(error, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    std = np.sqrt(np.diag(matrix))
    if not (np.isfinite(matrix).all() and (std > 0.0).all()):
        return float("nan")
    correlation = matrix / np.outer(std, std)
    if np.linalg.eigvalsh(correlation)[0] < LEAST_EIGENVALUE:
        return float("nan")
    return float((e / std) @ np.linalg.solve(correlation, e / std))


def _relative(poses: Sequence[Pose], reference: int, others: Sequence[int]) -> tuple[Array, Array]:
    origin = poses[reference]
    rotations = np.stack([poses[k].rotation @ origin.rotation.T for k in others])
    offsets = np.stack([origin.rotation @ (poses[k].center - origin.center) for k in others])
    return rotations, offsets
