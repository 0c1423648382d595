"""Essential matrices from rays of two cameras, many sets of rays at once: eight-point and five-point methods.

A constraint x_b^T E x_a = 0 is linear in the nine entries of E. The eight-point method takes the least eigenvector
of the normal matrix of many constraints; here it is weighted anew from step to step (Cauchy weights of Sampson's
distance).
The five-point method (D. Nister, 2004; H. Stewenius, C. Engels and D. Nister, "Recent developments on direct relative
orientation", 2006) also uses that E has two equal singular values and one of zero, and so needs five constraints: a
four-dimensional null space, and the eigenvectors of a matrix of ten rows. What it gets here is the four least
eigenvectors of a normal matrix, so that all samples of two straight tracks count, not five of them.
"""

from itertools import combinations_with_replacement

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.rotations import cross_matrices
from stereophd.core.two_views.epipolar import sampson_distances

# Weighted steps of the eight-point method, and the tolerances that they fall between, in units of the slopes' noise.
STEPS = 8
# Eigenvalues with an imaginary part below this share of their size are real.
REAL = 1e-6


def constraint_rows(rays_a: Array, rays_b: Array) -> Array:
    """Rows (..., 9) of the constraints x_b^T E x_a = 0 on the entries of E, row by row, of slopes (..., 2)."""
    a = np.concatenate([rays_a, np.ones((*rays_a.shape[:-1], 1))], axis=-1)
    b = np.concatenate([rays_b, np.ones((*rays_b.shape[:-1], 1))], axis=-1)
    return np.asarray((b[..., :, None] * a[..., None, :]).reshape(*a.shape[:-1], 9))


def nearest_essential(matrices: Array) -> Array:
    """Essential matrices (..., 3, 3) nearest to matrices: singular values 1, 1 and 0."""
    left, _, right = np.linalg.svd(matrices)
    return np.asarray(left[..., :, :2] @ right[..., :2, :])


def eight_point(rows: Array, valid: Array, tolerances: tuple[float, float]) -> Array:
    """Essential matrices (h, 3, 3) of sets of constraint rows (h, n, 9); a few wrong rows are borne.

    `valid` (h, n) is the weight of each row, 0 where there is none; the tolerances are the first and the last of the
    Cauchy weights, in slopes.
    """
    weights = np.broadcast_to(valid, rows.shape[:2])
    essential = np.empty((len(rows), 3, 3))
    for tolerance in np.geomspace(*tolerances, STEPS).tolist():
        _, vectors = np.linalg.eigh(np.swapaxes(rows, -1, -2) @ (weights[..., None] * rows))
        essential = nearest_essential(vectors[..., 0].reshape(-1, 3, 3))
        a, b = rows[..., 6:9], rows[..., 2::3]
        distances = sampson_distances(essential, a, b)
        gradient = np.maximum(distances.factors**-2.0, 1e-12)
        weights = valid / (gradient * (1.0 + (distances.signed / tolerance) ** 2))
    return essential


def _monomials() -> Array:
    """Sums (64, 20) of products of three of the unknowns x, y, z, 1 by monomial, cubic ones first."""
    cubic = ["000", "001", "011", "111", "002", "012", "112", "022", "122", "222"]
    lower = ["003", "013", "113", "023", "123", "223", "033", "133", "233", "333"]
    order = [tuple(int(digit) for digit in name) for name in cubic + lower]
    assert sorted(order) == sorted(combinations_with_replacement(range(4), 3))
    sums = np.zeros((4, 4, 4, 20))
    for index in np.ndindex(4, 4, 4):
        sums[(*index, order.index(tuple(sorted(index))))] = 1.0
    return sums.reshape(64, 20)


MONOMIALS = _monomials()
# Row of the reduced equations that x times each of x2, xy, y2, xz, yz, z2 is, and place of x times x, y, z and 1.
TIMES_X, KEPT = (0, 1, 2, 4, 5, 7), (0, 1, 3, 6)


def five_point(spaces: Array) -> tuple[Array, Integers]:
    """Essential matrices (s, 3, 3) in null spaces (h, 4, 9), at most ten each, and the space (s,) of each."""
    e = spaces.reshape(-1, 4, 3, 3)
    products = np.einsum("bpij,bqkj->bikpq", e, e)
    cubic = 2.0 * np.einsum("bikpq,brkl->bilpqr", products, e)
    cubic -= np.einsum("bkkpq,bril->bilpqr", products, e)
    determinant = np.einsum("bpi,bqri->bpqr", e[:, :, 0], np.cross(e[:, :, None, 1], e[:, None, :, 2]))
    equations = np.concatenate([cubic.reshape(-1, 9, 64), determinant.reshape(-1, 1, 64)], axis=1) @ MONOMIALS
    usable = np.linalg.det(equations[:, :, :10]) != 0.0
    e, equations, of_space = e[usable], equations[usable], np.flatnonzero(usable)
    if not len(e):
        return np.empty((0, 3, 3)), of_space
    reduced = np.linalg.solve(equations[:, :, :10], equations[:, :, 10:])
    action = np.zeros((len(e), 10, 10))
    action[:, :6] = -reduced[:, TIMES_X]
    action[:, (6, 7, 8, 9), KEPT] = 1.0
    values, vectors = np.linalg.eig(action)
    space, column = np.nonzero(np.abs(values.imag) < REAL * (1.0 + np.abs(values)))
    vector = vectors[space, :, column].real
    unknowns = np.concatenate([vector[:, 6:9] / vector[:, 9:], np.ones((len(vector), 1))], axis=1)
    finite = np.isfinite(unknowns).all(axis=1)
    space, unknowns = space[finite], unknowns[finite]
    essential = np.einsum("sp,spij->sij", unknowns, e[space])
    return essential / np.linalg.norm(essential, axis=(1, 2))[:, None, None], of_space[space]


def poses_of(essential: Array) -> list[tuple[Array, Array]]:
    """The four rotations (3, 3) and unit translations (3,) of one essential matrix: x_b = R x_a + t."""
    left, _, right = np.linalg.svd(essential)
    left, right = left * np.sign(np.linalg.det(left)), right * np.sign(np.linalg.det(right))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [(left @ w @ right, sign * left[:, 2]) for w in (turn, turn.T) for sign in (1.0, -1.0)]


def essential_of(rotation: Array, translation: Array) -> Array:
    """Essential matrix [t]_x R (3, 3)."""
    return np.asarray(cross_matrices(translation) @ rotation)
