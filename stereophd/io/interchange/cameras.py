"""Cameras of other programs and native ones: matrices, lens coefficients and poses, taken together and apart."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array
from stereophd.core.geometry.rotations import checked_rotation
from stereophd.errors import InputError
from stereophd.io.cameras.models import UNKNOWN_DETECTOR, CameraConfig
from stereophd.io.interchange.base import ForeignRecording, ImportOptions

#: Coefficients in OpenCV's order; a shorter list has zeros at its end.
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE_ORDER = ("k1", "k2", "k3", "k4")
# A rotation further than this from orthonormal is another convention or a typing error, not rounding.
LARGEST_DEFECT = 1e-3


@dataclass(frozen=True)
class Parts:
    """A camera as most programs describe it."""

    matrix: Array  # Camera matrix (3, 3) without skew; pixel (0, 0) is the centre of the top-left pixel
    coefficients: Array  # Lens coefficients in OpenCV's order: 8 of the rational model, or 4 of a fisheye
    fisheye: bool  # Which of the two models they belong to
    # `rotation`, `center`: ``x_camera = rotation @ (x_world - center)``, camera axes x right, y down, z forward.
    rotation: Array
    center: Array
    size: tuple[int, int]  # Width and height, px

    @property
    def translation(self) -> Array:
        """The t of ``x_camera = rotation @ x_world + t``."""
        return np.asarray(-self.rotation @ self.center, dtype=np.float64)


def take_apart(name: str, config: CameraConfig) -> Parts:
    """Return the parts of a native camera.

    Raises InputError when it moves or has a rolling shutter: no foreign format holds that.
    """
    camera = config.build(name)
    if not camera.pose.is_static:
        raise InputError(f"cameras.{name}.pose: expected a camera at rest for an export, found one that moves")
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    fisheye = camera.lens.model == "fisheye"
    coefficients = camera.lens.coefficients[:4] if fisheye else camera.lens.coefficients
    # the parsed matrix itself: what was read exactly is written exactly
    given = config.pose.rotation_matrix
    rotation = camera.pose.rotation if given is None else np.asarray(given, dtype=np.float64)
    return Parts(matrix, coefficients, fisheye, rotation, camera.pose.center, (camera.width, camera.height))


def put_together(name: str, parts: Parts, options: ImportOptions, where: str, **more: Any) -> CameraConfig:
    """Return a native camera of its parts; missing coefficients count as zero.

    The options state the detector, and whether the pixels are undistorted already; `more` has other keys of the camera,
    such as ``clock`` and ``frame_rate_hz``. Raises InputError, naming the camera and the file `where`, for a value that
    is not possible, or a lens model that the native cameras do not have.
    """
    rotation = np.asarray(parts.rotation, dtype=np.float64)
    if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
        raise InputError(f"{where}: {name}: rotation: expected 3 x 3 finite numbers, found shape {rotation.shape}")
    try:
        rotation = checked_rotation(rotation, LARGEST_DEFECT)
    except ValueError as error:
        raise InputError(f"{where}: {name}: {error}") from error
    numbers = (*parts.matrix[:2].ravel(), *parts.coefficients, *parts.center)
    if not np.isfinite(numbers).all():
        raise InputError(f"{where}: {name}: expected finite numbers, found NaN or infinity")
    fx, fy = float(parts.matrix[0, 0]), float(parts.matrix[1, 1])
    if fx <= 0 or fy <= 0:
        raise InputError(f"{where}: {name}: expected focal lengths > 0, found {fx:g}, {fy:g}")
    values: dict[str, Any] = {
        "image_size_px": [int(parts.size[0]), int(parts.size[1])],
        "intrinsics": {"fx": fx, "fy": fy, "cx": float(parts.matrix[0, 2]), "cy": float(parts.matrix[1, 2])},
        "pose": {"center": list(map(float, parts.center)), "rotation_matrix": rotation.tolist()},
        "detector": dict(options.detector or UNKNOWN_DETECTOR),
        **more,
    }
    if not options.undistorted:
        values["distortion"] = distortion(parts.coefficients, parts.fisheye, f"{where}: {name}")
    return CameraConfig.model_validate(values)


def distortion(coefficients: ArrayLike, fisheye: bool, where: str) -> dict[str, Any]:
    """Return the native lens of OpenCV's coefficients.

    Raises InputError when there are more coefficients than the native models have, and they are not zero.
    """
    values = np.asarray(coefficients, dtype=np.float64).ravel()
    order: Sequence[str] = FISHEYE_ORDER if fisheye else OPENCV_ORDER
    if values[len(order) :].any():
        kind = "a fisheye lens with 4" if fisheye else "a lens with up to 8"
        raise InputError(
            f"{where}: expected {kind} coefficients, found {len(values)}: thin prisms and tilted "
            "sensors are not supported"
        )
    if not values.any():
        return {"model": "none"}
    stated = {key: float(value) for key, value in zip(order, values, strict=False)}
    return {"model": "fisheye" if fisheye else "brown_conrady", **stated}


def image_size(name: str, stated: ArrayLike | None, options: ImportOptions, where: str) -> tuple[int, int]:
    """Return the image size of a camera: the user's, else the source's; InputError if neither states it."""
    given = [np.ravel(size)[:2] for size in (options.image_sizes.get(name), stated) if size is not None]
    sizes = [(int(width), int(height)) for width, height in given]
    if not sizes:
        raise InputError(
            f"{where}: {name}: expected the size of the images, found none in the file; state it by `image_sizes`"
        )
    return sizes[0]


def unit(options: ImportOptions, recording: ForeignRecording) -> str:
    """Return the unit of length of a source that names none: the user's, else metres, which are then assumed."""
    recording.unit_is_assumed = options.length_unit is None
    return options.length_unit or "m"
