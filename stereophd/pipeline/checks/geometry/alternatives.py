"""The usual mistakes in a description of cameras, and the corrected camera for each.

Every alternative turns the camera of the configuration into the one that explains the log if this mistake was made.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.pipeline.checks.geometry.rays import Reading

# From OpenGL camera axes (x right, y up, z back) to those of OpenCV.
OPENGL = np.diag([1.0, -1.0, -1.0])
UNIT_FACTORS = (0.001, 0.01, 0.0254, 0.1, 0.3048, 3.2808, 10.0, 39.37, 100.0, 1000.0)
RESOLUTION_FACTORS = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
# Focal lengths over the image width that lenses have, tried where the stated one is far smaller (millimetres).
USUAL_FOCAL = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.4, 1.6, 1.9, 2.3)
MILLIMETRES_BELOW = 0.2
RADIAL = (-0.4, -0.3, -0.2, -0.1, -0.05, 0.05, 0.1, 0.2, 0.3)


@dataclass(frozen=True)
class Alternative:
    """A mistake, and the correction of a camera."""

    cause: str  # Short name, for programs
    text: str  # The mistake in words, as in "cam1: the rotation is transposed"
    remedy: str
    apply: Callable[[Camera], Reading | None]  # Corrects the stated camera; None if it cannot be this mistake
    alone: bool = False  # Whether the mistake shows only if one camera is affected, not all of them


def _posed(camera: Camera, rotation: Array, center: Array) -> Reading:
    pose = camera.pose
    return Reading(replace(camera, pose=Pose(rotation, center, pose.velocity, pose.rotation_rate, pose.time_s)))


def _pose_alternatives() -> Iterator[Alternative]:
    def moved(
        rotation: Callable[[Array], Array], center: Callable[[Array, Array], Array]
    ) -> Callable[[Camera], Reading]:
        return lambda camera: _posed(
            camera, rotation(camera.pose.rotation), center(camera.pose.rotation, camera.pose.center)
        )

    def same(rotation: Array, center: Array) -> Array:
        return center

    def from_translation(rotation: Array, center: Array) -> Array:
        return np.asarray(-rotation.T @ center)

    def from_both(rotation: Array, center: Array) -> Array:
        return np.asarray(-rotation @ center)

    def beside_translation(rotation: Array, center: Array) -> Array:
        return np.asarray(rotation @ rotation @ center)

    to_world = "give the rotation from world to camera axes (transpose the matrix, negate the vector)"
    as_center = "give the optical centre -R^T t instead of the translation t of x_camera = R x + t"
    opengl = "turn the camera axes by 180 degrees about x (negate rows 2 and 3 of the rotation matrix)"
    yield Alternative(
        "rotation_transposed", "the rotation seems to be camera-to-world (transposed)", to_world,
        moved(np.transpose, same),
    )  # fmt: skip
    yield Alternative(
        "rotation_transposed", "the rotation R of x_camera = R x + t seems to be transposed, beside the right t",
        "transpose R (negate its vector) before the centre -R^T t follows from it",
        moved(np.transpose, beside_translation),
    )  # fmt: skip
    yield Alternative(
        "center_is_translation", "the centre seems to be the translation t of x_camera = R x + t", as_center,
        moved(np.asarray, from_translation),
    )  # fmt: skip
    yield Alternative(
        "camera_to_world", "the rotation seems to be transposed and the centre to be the translation t",
        f"{to_world}; {as_center}", moved(np.transpose, from_both),
    )  # fmt: skip
    yield Alternative(
        "opengl_axes", "the camera axes seem to be those of OpenGL (y up, z back)", opengl,
        moved(lambda rotation: OPENGL @ rotation, same),
    )  # fmt: skip
    yield Alternative(
        "opengl_axes", "the camera axes seem to be those of OpenGL, and the rotation camera-to-world",
        f"{to_world}; {opengl}", moved(lambda rotation: OPENGL @ rotation.T, same),
    )  # fmt: skip
    yield Alternative(
        "opengl_axes", "the camera axes seem to be those of OpenGL, and the centre the translation t",
        f"{as_center}; {opengl}", moved(lambda rotation: OPENGL @ rotation, from_translation),
    )  # fmt: skip


def _radians(camera: Camera) -> Reading | None:
    """Return the camera whose rotation vector, read as degrees, was in radians."""
    vector = rotation_to_vector(camera.pose.rotation)
    if not 0.0 < np.rad2deg(np.linalg.norm(vector)) <= 2.0 * np.pi:
        return None
    return _posed(camera, rotation_from_vector(np.rad2deg(vector)), camera.pose.center)


def _with_unit(factor: float, camera: Camera) -> Reading:
    return _posed(camera, camera.pose.rotation, factor * camera.pose.center)


def _scaled(camera: Camera, focal: float, point: float) -> Reading:
    return Reading(
        replace(camera, fx=camera.fx * focal, fy=camera.fy * focal, cx=camera.cx * point, cy=camera.cy * point)
    )


def _millimetres(over_width: float) -> Callable[[Camera], Reading | None]:
    def apply(camera: Camera) -> Reading | None:
        if camera.fx > MILLIMETRES_BELOW * camera.width:
            return None
        return _scaled(camera, over_width * camera.width / camera.fx, 1.0)

    return apply


def _with_lens(change: Callable[[Lens], Lens | None]) -> Callable[[Camera], Reading | None]:
    def apply(camera: Camera) -> Reading | None:
        lens = change(camera.lens)
        return None if lens is None else Reading(replace(camera, lens=lens))

    return apply


def _reversed(lens: Lens) -> Lens | None:
    if lens.model == "none":
        return None
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return Lens(lens.model, **{name: -getattr(lens, name) for name in names})


def _radial(k1: float) -> Callable[[Lens], Lens | None]:
    return lambda lens: Lens("radial", k1=k1) if lens.model == "none" else None


def _intrinsic_alternatives() -> Iterator[Alternative]:
    for factor in RESOLUTION_FACTORS:
        yield Alternative(
            "intrinsics_resolution", f"the intrinsics seem to belong to a resolution {1 / factor:.3g} times this one",
            f"multiply fx, fy, cx and cy by {factor:.4g}", partial(_scaled, focal=factor, point=factor),
        )  # fmt: skip
        yield Alternative(
            "principal_point_resolution",
            f"the principal point seems to belong to a resolution {1 / factor:.3g} times this one",
            f"multiply cx and cy by {factor:.4g}", partial(_scaled, focal=1.0, point=factor),
        )  # fmt: skip
        yield Alternative(
            "focal_length", f"the focal length seems to be {factor:.3g} times the stated one",
            "state the focal length in pixels of this image size", partial(_scaled, focal=factor, point=1.0),
        )  # fmt: skip
    for ratio in USUAL_FOCAL:
        yield Alternative(
            "focal_length_millimetres", "the focal length seems to be in millimetres",
            "divide it by the pixel pitch: focal length [px] = focal length [mm] * image width [px] / sensor width "
            "[mm]", _millimetres(ratio),
        )  # fmt: skip
    yield Alternative(
        "lens_sign", "the sign of the lens coefficients seems to be reversed", "negate the coefficients",
        _with_lens(_reversed),
    )  # fmt: skip
    for k1 in RADIAL:
        yield Alternative(
            "lens_missing", "the lens model seems to be missing", f"state the lens distortion (near k1 = {k1:g})",
            _with_lens(_radial(k1)),
        )  # fmt: skip


def _image_alternatives() -> Iterator[Alternative]:
    def from_below(camera: Camera, pixels: Array) -> Array:
        return np.asarray(pixels * [1.0, -1.0] + [0.0, camera.height - 1.0])

    def swapped(camera: Camera, pixels: Array) -> Array:
        return np.asarray(pixels[:, ::-1])

    yield Alternative(
        "v_from_below", "v seems to be counted from the bottom of the image", "write v_px = height - 1 - v",
        lambda camera: Reading(camera, from_below),
    )  # fmt: skip
    yield Alternative(
        "u_v_swapped", "u and v seem to be exchanged", "exchange the columns u_px and v_px",
        lambda camera: Reading(camera, swapped),
    )  # fmt: skip


def _unit_alternatives() -> Iterator[Alternative]:
    for factor in UNIT_FACTORS:
        yield Alternative(
            "center_unit", f"the centre seems to be in another unit (off by a factor of {1 / factor:.4g})",
            f"multiply the centre by {factor:.4g}",
            partial(_with_unit, factor), alone=True,
        )  # fmt: skip


def alternatives() -> tuple[Alternative, ...]:
    """Return all alternatives, the likely ones first."""
    radians = Alternative(
        "rotation_radians",
        "the rotation vector seems to be in radians",
        "give rotation_vector_deg in degrees",
        _radians,
    )
    return (
        *_pose_alternatives(), radians, *_image_alternatives(), *_intrinsic_alternatives(), *_unit_alternatives(),
    )  # fmt: skip
