"""The usual mistakes in a description of cameras, and the corrected camera for each.

Every alternative turns the camera of the configuration into the one that explains the log if this mistake was made.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.pipeline.checks.geometry.rays import Reading, unchanged

# From OpenGL camera axes (x right, y up, z back) to those of OpenCV.
OPENGL = np.diag([1.0, -1.0, -1.0])
UNIT_FACTORS = (0.001, 0.01, 0.0254, 0.1, 0.3048, 3.2808, 10.0, 39.37, 100.0, 1000.0)
RESOLUTION_FACTORS = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True)
class Alternative:
    """A mistake, and the correction of a camera."""

    cause: str  # Short name, for programs
    text: str  # The mistake in words, as in "cam1: the rotation is transposed"
    remedy: str
    correct: Callable[[Camera], Camera | None]  # None if it cannot be this mistake
    read: Callable[[Camera, Array], Array] = unchanged  # As that of a `Reading`
    alone: bool = False  # Whether the mistake shows only if one camera is affected, not all of them

    def apply(self, camera: Camera) -> Reading | None:
        """Return the stated camera without the mistake; None if it cannot be this one."""
        corrected = self.correct(camera)
        return None if corrected is None else Reading(corrected, self.read)


TO_WORLD = "give the rotation from world to camera axes (transpose the matrix, negate the vector)"
AS_CENTER = "give the optical centre -R^T t instead of the translation t of x_camera = R x + t"
TURNED_AXES = "turn the camera axes by 180 degrees about x (negate rows 2 and 3 of the rotation matrix)"
# The true rotation and centre of those that are stated.
TruePose = Callable[[Array, Array], tuple[Array, Array]]
# Cause, text and remedy of mistakes in poses, and what undoes them.
POSES: tuple[tuple[str, str, str, TruePose], ...] = (
    (
        "rotation_transposed", "the rotation seems to be camera-to-world (transposed)", TO_WORLD,
        lambda r, c: (r.T, c),
    ),
    (
        "rotation_transposed", "the rotation R of x_camera = R x + t seems to be transposed, beside the right t",
        "transpose R (negate its vector) before the centre -R^T t follows from it", lambda r, c: (r.T, r @ r @ c),
    ),
    (
        "center_is_translation", "the centre seems to be the translation t of x_camera = R x + t", AS_CENTER,
        lambda r, c: (r, -r.T @ c),
    ),
    (
        "camera_to_world", "the rotation seems to be transposed and the centre to be the translation t",
        f"{TO_WORLD}; {AS_CENTER}", lambda r, c: (r.T, -r @ c),
    ),
    (
        "opengl_axes", "the camera axes seem to be those of OpenGL (y up, z back)", TURNED_AXES,
        lambda r, c: (OPENGL @ r, c),
    ),
    (
        "opengl_axes", "the camera axes seem to be those of OpenGL, and the rotation camera-to-world",
        f"{TO_WORLD}; {TURNED_AXES}", lambda r, c: (OPENGL @ r.T, c),
    ),
    (
        "opengl_axes", "the camera axes seem to be those of OpenGL, and the centre the translation t",
        f"{AS_CENTER}; {TURNED_AXES}", lambda r, c: (OPENGL @ r, -r.T @ c),
    ),
)  # fmt: skip


def posed(camera: Camera, rotation: Array, center: Array) -> Camera:
    """Return a camera with another rotation and centre."""
    pose = camera.pose
    return replace(camera, pose=Pose(rotation, center, pose.velocity, pose.rotation_rate, pose.time_s))


def _turned(camera: Camera, true_pose: TruePose) -> Camera:
    return posed(camera, *true_pose(camera.pose.rotation, camera.pose.center))


def _with_unit(camera: Camera, factor: float) -> Camera:
    return posed(camera, camera.pose.rotation, factor * camera.pose.center)


def _radians(camera: Camera) -> Camera | None:
    """Return the camera whose rotation vector, read as degrees, was in radians."""
    vector = rotation_to_vector(camera.pose.rotation)
    if not 0.0 < np.rad2deg(np.linalg.norm(vector)) <= 2.0 * np.pi:
        return None
    return posed(camera, rotation_from_vector(np.rad2deg(vector)), camera.pose.center)


def _scaled(camera: Camera, focal: float, point: float) -> Camera:
    return replace(camera, fx=camera.fx * focal, fy=camera.fy * focal, cx=camera.cx * point, cy=camera.cy * point)


def alternatives() -> Iterator[Alternative]:
    """Yield all alternatives, the likely ones first."""
    for cause, text, remedy, true_pose in POSES:
        yield Alternative(cause, text, remedy, partial(_turned, true_pose=true_pose))
    yield Alternative(
        "rotation_radians", "the rotation vector seems to be in radians", "give rotation_vector_deg in degrees",
        _radians,
    )  # fmt: skip
    yield Alternative(
        "v_from_below", "v seems to be counted from the other side of the image",
        "import again (with the other `rows_from`, top or bottom), or write v_px = height - 1 - v",
        lambda camera: camera, lambda camera, pixels: pixels * [1.0, -1.0] + [0.0, camera.height - 1.0],
    )  # fmt: skip
    yield Alternative(
        "u_v_swapped", "u and v seem to be exchanged", "exchange the columns u_px and v_px",
        lambda camera: camera, lambda camera, pixels: pixels[:, ::-1],
    )  # fmt: skip
    for factor in RESOLUTION_FACTORS:
        for cause, what, keys, focal in (
            ("intrinsics_resolution", "intrinsics seem", "fx, fy, cx and cy", factor),
            ("principal_point_resolution", "principal point seems", "cx and cy", 1.0),
        ):
            text = f"the {what} to belong to a resolution {1 / factor:.3g} times this one"
            remedy = f"multiply {keys} by {factor:.4g}"
            yield Alternative(cause, text, remedy, partial(_scaled, focal=focal, point=factor))
        yield Alternative(
            "focal_length", f"the focal length seems to be {factor:.3g} times the stated one",
            "state the focal length in pixels of this image size", partial(_scaled, focal=factor, point=1.0),
        )  # fmt: skip
    for factor in UNIT_FACTORS:
        yield Alternative(
            "center_unit", f"the centre seems to be in another unit (off by a factor of {1 / factor:.4g})",
            f"multiply the centre by {factor:.4g}", partial(_with_unit, factor=factor), alone=True,
        )  # fmt: skip
