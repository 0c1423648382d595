"""OpenPTV: targets and the orientation of the cameras, in one medium.

Sources: the parameter file ``ptv.par`` (number of cameras, names, image size, pixel size, refraction), in or below
the folder that its paths are relative to; the ``.ori`` and ``.addpar`` files and the ``..._targets`` that it names
are found from it. Cameras are named ``cam1``, ``cam2``, ... A frame is the number before ``_targets``.

Conventions: target pixels count from the corner of the top-left pixel (the image's middle is its width and height
halved); image coordinates are in millimetres, x right and y up; the cameras look along their -z. The world's axes stay;
the unit is the millimetre unless an option changes it. The distortion (Brown with scale and shear) is about the middle
of the sensor, not the principal point: the targets are undistorted, and the cameras have no lens. Refraction is not
supported: a file with refractive indices other than 1, or more than one layer of glass, is refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.cameras import Parts, put_together

# Newton's steps of the inverse distortion, the change at which it has converged, and where it has gone astray, mm.
STEPS, CONVERGED, FARTHEST = 50, 1e-14, 1e4


@dataclass(frozen=True)
class _Control:
    """Contents of ``ptv.par``."""

    images: list[str]
    calibrations: list[str]
    size: tuple[int, int]
    pixel: tuple[float, float]


@dataclass(frozen=True)
class _Orientation:
    """Contents of an ``.ori`` and its ``.addpar``; lengths of the sensor in mm."""

    center: Array
    rotation: Array
    principal: Array
    distance: float
    added: Array

    def flat(self, distorted: Array) -> Array:
        """Return undistorted sensor coordinates (n, 2) about the middle of the sensor; NaN where there are none."""
        flat = self._flat(distorted)
        return np.where(np.abs(flat).max(axis=1, initial=0.0, keepdims=True) < FARTHEST, flat, np.nan)

    def _flat(self, distorted: Array) -> Array:
        if not self.added[:5].any() and self.added[5] == 1.0 and self.added[6] == 0.0:
            return distorted
        result = distorted.copy()
        for _ in range(STEPS):
            error = self._distorted(result) - distorted
            step = 1e-6
            along_x = (self._distorted(result + [step, 0.0]) - self._distorted(result - [step, 0.0])) / (2 * step)
            along_y = (self._distorted(result + [0.0, step]) - self._distorted(result - [0.0, step])) / (2 * step)
            jacobian = np.stack([along_x, along_y], axis=2)
            change = np.linalg.solve(jacobian, error[:, :, None])[:, :, 0]
            result = result - change
            if not (np.abs(change) >= CONVERGED).any():
                return result
        return np.full_like(distorted, np.nan)

    def _distorted(self, flat: Array) -> Array:
        k1, k2, k3, p1, p2, scale, shear = self.added
        x, y = flat[:, 0], flat[:, 1]
        r = x * x + y * y
        radial = 1.0 + r * (k1 + r * (k2 + r * k3))
        xd = x * radial + p1 * (r + 2 * x * x) + 2 * p2 * x * y
        yd = y * radial + p2 * (r + 2 * y * y) + 2 * p1 * x * y
        return np.stack([scale * xd - np.sin(shear) * yd, np.cos(shear) * yd], axis=1)


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read what a ``ptv.par`` names."""
    if len(sources) != 1:
        raise InputError(f"expected one ptv.par, found {len(sources)} files")
    path = sources[0] / "parameters" / "ptv.par" if sources[0].is_dir() else sources[0]
    control = _read_control(path)
    folder = _folder(path, control)
    recording = ForeignRecording(files=[path], length_unit=options.length_unit or "mm")
    recording.assumed.append(f"lengths of the world are in {recording.length_unit}")
    orientations: dict[str, _Orientation] = {}
    for number, stem in enumerate(control.calibrations, start=1):
        name = options.name(f"cam{number}")
        orientations[name] = _read_orientation(folder / f"{stem}.ori", folder / f"{stem}.addpar", recording)
        parts = _parts(orientations[name], control)
        recording.cameras[name] = put_together(name, parts, options, str(path))
    targets = {name: _targets(folder, image) for name, image in zip(orientations, control.images, strict=True)}
    if any(targets.values()):
        recording.files += [file for found in targets.values() for _, file in found]
        recording.pieces = _pieces(targets, orientations, control)
        if any(orientation.added[:5].any() for orientation in orientations.values()):
            recording.assumed.append("the targets are undistorted, and the cameras have no lens")
    return recording


def _read_control(path: Path) -> _Control:
    try:
        words = path.read_text(encoding="utf-8-sig").split()
        count = int(words[0])
        names = words[1 : 1 + 2 * count]
        high_pass, only_bright, tiff, *rest = words[1 + 2 * count :]
        del high_pass, only_bright, tiff
        size = (int(rest[0]), int(rest[1]))
        pixel = (float(rest[2]), float(rest[3]))
        interlaced = int(rest[4])
        indices = [float(word) for word in rest[5:8]]
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path}: expected the parameters of OpenPTV (ptv.par), found: {error}") from error
    if any(index != 1.0 for index in indices):
        listed = ", ".join(f"{index:g}" for index in indices)
        raise InputError(
            f"{path}: expected one medium (refractive indices 1, 1, 1), found {listed}: rays through glass or water "
            "are not straight, which the camera model here does not describe"
        )
    if interlaced:
        raise InputError(f"{path}: expected whole frames, found interlaced fields ({interlaced}): not supported")
    return _Control(names[0::2], names[1::2], size, pixel)


def _folder(path: Path, control: _Control) -> Path:
    """Return the folder that the paths of a ``ptv.par`` are relative to."""
    for folder in (path.resolve().parent, path.resolve().parent.parent):
        if (folder / f"{control.calibrations[0]}.ori").is_file():
            return folder
    raise InputError(f"{path}: expected {control.calibrations[0]}.ori in or above its folder, found none")


def _read_orientation(ori: Path, addpar: Path, recording: ForeignRecording) -> _Orientation:
    try:
        values = np.array(ori.read_text(encoding="utf-8-sig").split(), dtype=np.float64)
        added = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
        recording.files.append(ori)
        if addpar.is_file():
            added = np.array(addpar.read_text(encoding="utf-8-sig").split(), dtype=np.float64)[:7]
            recording.files.append(addpar)
        if len(values) < 18 or len(added) < 7:
            raise ValueError(f"{len(values)} and {len(added)} numbers")
        if not (np.isfinite(values).all() and np.isfinite(added).all()):
            raise ValueError("numbers that are not finite")
    except (OSError, ValueError) as error:
        raise InputError(f"{ori}: expected an orientation of OpenPTV (.ori, .addpar), found: {error}") from error
    return _Orientation(values[:3], values[6:15].reshape(3, 3), values[15:17], float(values[17]), added)


def _parts(orientation: _Orientation, control: _Control) -> Parts:
    """Return the camera: from x right, y up, looking along -z to x right, y down, z forward."""
    turn = np.diag([1.0, -1.0, -1.0])
    rotation = turn @ _nearest(orientation.rotation).T
    width, height = control.size
    px, py = control.pixel
    xh, yh = orientation.principal
    # the middle of the sensor is between the pixels (width - 1) / 2 and ... of the native count
    matrix = np.array(
        [
            [orientation.distance / px, 0.0, (width - 1) / 2 + xh / px],
            [0.0, orientation.distance / py, (height - 1) / 2 - yh / py],
            [0.0, 0.0, 1.0],
        ]
    )
    return Parts(matrix, np.zeros(5), False, rotation, orientation.center, control.size)


def _nearest(rotation: Array) -> Array:
    """Return the rotation nearest to a matrix that is written with seven digits."""
    left, _, right = np.linalg.svd(rotation)
    return np.asarray(left @ right, dtype=np.float64)


def _targets(folder: Path, image: str) -> list[tuple[int, Path]]:
    """Return the frames and files of the targets of a camera, in order."""
    base = folder / image
    stem = re.sub(r"\d+$", "", base.name)
    found = []
    for path in base.parent.glob(f"{stem}*_targets") if base.parent.is_dir() else ():
        match = re.fullmatch(rf"{re.escape(stem)}(\d+)_targets", path.name)
        if match:
            found.append((int(match[1]), path))
    return sorted(found)


def _pieces(
    targets: dict[str, list[tuple[int, Path]]], orientations: dict[str, _Orientation], control: _Control
) -> Iterator[Piece]:
    width, height = control.size
    px, py = control.pixel
    for name, files in targets.items():
        for frame, path in files:
            pixels = _read_targets(path)
            sensor = np.stack([(pixels[:, 0] - width / 2) * px, (height / 2 - pixels[:, 1]) * py], axis=1)
            flat = orientations[name].flat(sensor)
            if not np.isfinite(flat).all():
                raise InputError(f"{path}: expected targets that the lens of {name} (.addpar) images, found others")
            # half a pixel from the corner of the first pixel to its centre
            native = np.stack([flat[:, 0] / px + (width - 1) / 2, (height - 1) / 2 - flat[:, 1] / py], axis=1)
            if not len(native):
                native = np.full((1, 2), np.nan)
            yield Piece(name, native, np.full(len(native), float(frame)))


def _read_targets(path: Path) -> Array:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        count = int(lines[0])
        rows = [line.split() for line in lines[1 : 1 + count]]
        pixels = np.array([[row[1], row[2]] for row in rows], dtype=np.float64).reshape(-1, 2)
        if len(pixels) != count:
            raise ValueError(f"{len(pixels)} rows of {count}")
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path}: expected a number and rows of targets, found: {error}") from error
    return pixels


FORMAT = Format("OpenPTV: targets and orientations in one medium (ptv.par)", read=read)
