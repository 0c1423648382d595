"""The native camera that is nearest to another model of it: least squares over pixels and what they see."""

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording
from stereophd.io.interchange.cameras import Parts
from stereophd.io.interchange.projection import Decomposed

# Points along each axis of the image at which a lens is taken over.
LENS_GRID = 25
# A skew or a difference that moves pixels by less than this is rounding of a file of few digits, px.
NEGLIGIBLE_PX = 1e-3
# A model that the native cameras cannot follow better than this, in 99 % of the pixels, is refused.
LARGEST_PX = 0.5
LENS = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class StatedLens:
    """A lens that a source states about a camera matrix (3, 3) of its own: k1, k2, p1, p2, k3."""

    matrix: Array
    coefficients: Array

    def undistort(self, pixels: Array) -> Array:
        """Return where pixels (n, 2) would be without the lens; NaN beyond it."""
        focal, center = np.diag(self.matrix)[:2], self.matrix[:2, 2]
        result, seen = np.full_like(pixels, np.nan), np.isfinite(pixels).all(axis=1)
        result[seen] = _lens(self.coefficients).undistort((pixels[seen] - center) / focal)[0] * focal + center
        return result


def parts_of_projection(
    camera: Decomposed,
    lens: StatedLens | None,
    size: tuple[int, int],
    has_points: bool,
    recording: ForeignRecording,
    where: str,
) -> tuple[Parts, Decomposed | None]:
    """Return the native camera of a projection of undistorted pixels, whose lens may be stated about another matrix.

    A skew is moved into the points, if there are any: the second value is the camera then, whose `upright` does it.
    """
    matrix = camera.matrix.copy()
    matrix[0, 1] = 0.0
    parts = Parts(matrix, np.zeros(len(LENS)), False, camera.rotation, camera.center, size)
    skew = abs(camera.skew_slope) * size[1] / 2
    skewed = camera if skew > NEGLIGIBLE_PX else None
    if skewed is not None:
        way = "moved into the points" if has_points else "left out"
        recording.assumed.append(f"{where}: its skew of up to {skew:.2g} px is {way}: native cameras have none")
    if lens is not None and lens.coefficients.any():
        axes = (np.linspace(0.0, extent - 1.0, LENS_GRID) for extent in size)
        pixels = np.stack(np.meshgrid(*axes), axis=2).reshape(-1, 2)
        flat = lens.undistort(pixels)
        seen = np.isfinite(flat).all(axis=1)
        rays = np.column_stack([flat, np.ones(len(flat))])[seen] @ np.linalg.inv(camera.matrix).T @ camera.rotation
        start = replace(parts, coefficients=lens.coefficients)
        pixels = pixels[seen] if skewed is None else skewed.upright(pixels[seen])
        parts = fitted_parts(start, camera.center + rays, pixels, recording, where)
    return parts, skewed if has_points else None


def fitted_parts(
    start: Parts, points: Array, pixels: Array, recording: ForeignRecording, where: str, has_free_pose: bool = False
) -> Parts:
    """Return the pinhole camera with a Brown-Conrady lens that sees points (n, 3) at pixels (n, 2).

    Focal lengths, principal point and lens are found by least squares from those of `start`, the pose too where it is
    free. The residual is noted in the recording. Raises InputError, naming the camera `where`, if it is larger than
    `LARGEST_PX` in more than 1 % of the points.
    """
    parts, errors = start, _errors(start, points, pixels)
    if errors.max() > NEGLIGIBLE_PX:
        from scipy.optimize import least_squares

        # the scale of an unknown is the change of it that moves a pixel of the border by about one
        focal, radius = float(start.matrix[0, 0]), float(np.hypot(*start.size)) / 2
        tangent = radius / focal
        scales = [1, 1, 1, 1, *(1 / (focal * tangent**power) for power in (3, 5, 2, 2, 7))]
        if has_free_pose:
            distance = float(np.median(np.linalg.norm(points - start.center, axis=1)))
            scales += [1 / focal] * 3 + [distance / focal] * 3
        unit = np.array(scales)

        def residuals(x: Array) -> Array:
            return (_project(_moved(start, x * unit), points) - pixels).ravel()

        solution = least_squares(residuals, np.zeros(len(unit)), method="lm", x_scale="jac")
        parts = _moved(start, solution.x * unit)
        errors = _errors(parts, points, pixels)
        middle, most = np.percentile(errors, [50, 99])
        if not most <= LARGEST_PX:
            ways = "; a less deep volume, or glass that the camera looks through less obliquely, bends them less"
            raise InputError(
                f"{where}: expected a camera that a pinhole with a lens follows to {LARGEST_PX:g} px, found "
                f"{most:.3g} px (99 % of its pixels): rays that are bent so much have no single centre"
                f"{ways if has_free_pose else ''}"
            )
        recording.assumed.append(
            f"{where}: the pinhole with a lens that fits its model best; median residual {middle:.2g} px, 99 % below "
            f"{most:.2g} px"
        )
    return parts


def _moved(parts: Parts, change: Array) -> Parts:
    """Return a camera after a change of focal lengths, principal point, lens and, if there are 15 numbers, pose."""
    matrix = parts.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += change[:4]
    moved = replace(parts, matrix=matrix, coefficients=parts.coefficients + change[4:9])
    if len(change) > 9:
        turned = rotation_from_vector(change[9:12]) @ parts.rotation
        moved = replace(moved, rotation=turned, center=parts.center + change[12:15])
    return moved


def _project(parts: Parts, points: Array) -> Array:
    seen = (points - parts.center) @ parts.rotation.T
    lens = _lens(parts.coefficients)
    return lens.distort(seen[:, :2] / seen[:, 2:])[0] @ parts.matrix[:2, :2].T + parts.matrix[:2, 2]


def _errors(parts: Parts, points: Array, pixels: Array) -> Array:
    return np.asarray(np.linalg.norm(_project(parts, points) - pixels, axis=1))


def _lens(coefficients: Array) -> Lens:
    return Lens("brown_conrady", **dict(zip(LENS, coefficients.tolist(), strict=True)))
