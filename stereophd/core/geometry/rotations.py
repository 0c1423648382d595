"""Rotation matrices: which are ones, and those of many rotation vectors at once, in arrays with a leading axis."""

import numpy as np

from stereophd.core.arrays import Array

# Rounding of a matrix product; a larger defect (digits typed by hand) is repaired.
ROUNDING = 1e-12


def checked_rotation(matrix: Array, largest_defect: float) -> Array:
    """Return a matrix (3, 3) itself if it is a rotation to rounding, else the rotation nearest to it.

    Raises ValueError where R R^T differs by more than the largest defect from the identity, or the matrix reflects.
    """
    defect, determinant = float(np.abs(matrix @ matrix.T - np.eye(3)).max()), float(np.linalg.det(matrix))
    if defect > largest_defect or determinant < 0.0:
        raise ValueError(
            "expected a rotation matrix (orthonormal rows, determinant +1), found "
            f"|R R^T - I| up to {defect:.3g} and determinant {determinant:.6g}"
        )
    return matrix if defect <= ROUNDING else nearest_rotation(matrix)


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotation that is nearest to a matrix, such as one that was written with few digits."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right, dtype=np.float64)


def cross_matrices(vectors: Array) -> Array:
    """Matrices (..., 3, 3) whose product with a vector is its cross product with vectors (..., 3)."""
    half = np.zeros((*vectors.shape, 3))
    half[..., 2, 1], half[..., 0, 2], half[..., 1, 0] = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.asarray(half - np.swapaxes(half, -1, -2))


def rotations(vectors: Array) -> Array:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3), rad (`stereophd.core.geometry.pose`)."""
    cross = cross_matrices(vectors)
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    # sin(a) / a and (1 - cos a) / a^2, to full precision at a = 0
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * cross @ cross
    )


def left_jacobians(vectors: Array) -> Array:
    """Left Jacobians (n, 3, 3) of rotation vectors (n, 3): exp(v + dv) = exp(J dv) exp(v) to first order.

    Of a vector that changes with time, J dv / dt is the angular velocity (J. Sola et al., "A micro Lie theory", 2018,
    eq. 145).
    """
    cross = cross_matrices(vectors)
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    safe = np.where(angle < 1e-4, 1.0, angle)
    second = np.where(angle < 1e-4, 0.5, (1.0 - np.cos(safe)) / safe**2)
    third = np.where(angle < 1e-4, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + second * cross + third * cross @ cross)
