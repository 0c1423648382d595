"""OpenPTV: targets and the orientation of the cameras, also through glass and water.

Sources: the parameter file ``ptv.par`` (number of cameras, names, image size, pixel size, refraction), or the folder of
the experiment; ``sequence.par`` and ``criteria.par`` beside it and the ``.ori``, ``.addpar`` and ``..._targets`` files
are found from it. Cameras are named ``cam1``, ``cam2``, ... A frame is the number before ``_targets``. Points in space
(the folder of ``ptv_is.NNN``) are the truth.

Conventions: target pixels count from the corner of the top-left pixel (the image's middle is its width and height
halved); image coordinates are in millimetres, x right and y up; the cameras look along their -z. The world's axes stay;
the unit is the millimetre unless an option changes it. The distortion (Brown with scale and shear) is about the middle
of the sensor, not the principal point, and rays may pass from air through a pane of glass into a liquid: the native
camera is the pinhole with a lens that sees the volume of ``criteria.par`` at the same pixels. Its residual is noted.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.geometry.rotations import nearest_rotation
from stereophd.errors import InputError
from stereophd.io.documents import expecting
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece, TruePoints
from stereophd.io.interchange.cameras import Parts, put_together
from stereophd.io.interchange.fitted import fitted_parts

# Pixels along each axis of the image, and heights of the volume, at which the camera's rays are compared.
SIGHT_GRID, SIGHT_DEPTHS = 17, 5
# Fewer places of the volume that a camera sees decide nothing.
LEAST_SIGHT = 40
# Newton's steps of the inverse distortion, the change at which it has converged, and where it has gone astray, mm.
STEPS, CONVERGED, FARTHEST = 50, 1e-14, 1e4


@dataclass(frozen=True)
class _Control:
    """Contents of ``ptv.par``, and of ``sequence.par`` and ``criteria.par``, which may be missing."""

    images: list[str]  # Names of the images before and after the number of the frame, separated by %d
    calibrations: list[str]
    size: tuple[int, int]
    pixel: tuple[float, float]
    indices: tuple[float, float, float]  # Refractive indices of air, glass and liquid
    thickness: float  # Of the glass, in the unit of the world
    frames: tuple[int, int] | None  # First and last frame of the sequence
    volume: Array | None  # x and the least and largest z there, at two places (2, 3)

    @property
    def is_refracted(self) -> bool:
        """Whether rays are bent on their way."""
        return len(set(self.indices)) > 1


@dataclass(frozen=True)
class _Orientation:
    """Contents of an ``.ori`` and its ``.addpar``; lengths of the sensor in mm."""

    center: Array
    rotation: Array
    principal: Array
    distance: float
    glass: Array  # From the origin to the nearest point of the glass, on its side of the liquid
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
    recording = ForeignRecording(files=[path], length_unit=options.length_unit or "mm")
    recording.assumed.append(f"lengths of the world are in {recording.length_unit}")
    control = _read_control(path, recording)
    folder = _folder(path, control)
    for number, stem in enumerate(control.calibrations, start=1):
        name = options.name(f"cam{number}")
        where = f"{path}: {name}"
        orientation = _read_orientation(folder / f"{stem}.ori", folder / f"{stem}.addpar", recording)
        seen, pixels = _sight(orientation, control, path)
        start = _parts(orientation, control)
        if control.is_refracted:
            start = _turned(start, orientation.glass)
        parts = fitted_parts(start, seen, pixels, recording, where, control.is_refracted)
        recording.cameras[name] = put_together(name, parts, options, str(path))
        if control.is_refracted:
            recording.models[name] = {
                "refractive_indices": list(control.indices),
                "glass_thickness": control.thickness,
                "glass": orientation.glass.tolist(),
                "center": orientation.center.tolist(),
            }
    targets = {
        name: _targets(folder, image, control.frames, recording)
        for name, image in zip(recording.cameras, control.images, strict=True)
    }
    if any(targets.values()):
        recording.files += [file for files in targets.values() for _, file in files]
        recording.pieces = _pieces(targets)
    else:
        recording.sought = f"targets ({folder / control.images[0].replace('%d', '*')}_targets)"
        recording.assumed.append(f"cameras alone, without {recording.sought}")
    if options.truth is not None:
        recording.truth = _read_links(options.truth)
    return recording


def _read_control(path: Path, recording: ForeignRecording) -> _Control:
    with expecting("the parameters of OpenPTV (ptv.par)", path):
        words = path.read_text(encoding="utf-8-sig").split()
        count = int(words[0])
        names = words[1 : 1 + 2 * count]
        rest = words[4 + 2 * count :]  # after the flags for the high pass, for bright targets, and for TIFF
        size = (int(rest[0]), int(rest[1]))
        pixel = (float(rest[2]), float(rest[3]))
        interlaced = int(rest[4])
        air, glass, liquid, thickness = (float(word) for word in rest[5:9])
    if interlaced:
        raise InputError(f"{path}: expected whole frames, found interlaced fields ({interlaced}): not supported")
    images, frames, volume = [re.sub(r"\d+$", "%d", name) for name in names[0::2]], None, None
    sequence, criteria = path.with_name("sequence.par"), path.with_name("criteria.par")
    if sequence.is_file():
        *bases, first, last = _words(sequence, count + 2)
        images = [base if "%d" in base else f"{base}%d" for base in bases]
        frames = (int(first), int(last))
        recording.files.append(sequence)
    if criteria.is_file():
        volume = np.array(_words(criteria, 6), dtype=np.float64).reshape(2, 3)
        recording.files.append(criteria)
    return _Control(images, names[1::2], size, pixel, (air, glass, liquid), thickness, frames, volume)


def _words(path: Path, count: int) -> list[str]:
    words = path.read_text(encoding="utf-8-sig").split()
    if len(words) < count:
        raise InputError(f"{path}: expected {count} values, found {len(words)}")
    return words[:count]


def _folder(path: Path, control: _Control) -> Path:
    """Return the folder that the paths of a ``ptv.par`` are relative to."""
    for folder in (path.resolve().parent, path.resolve().parent.parent):
        if (folder / f"{control.calibrations[0]}.ori").is_file():
            return folder
    raise InputError(f"{path}: expected {control.calibrations[0]}.ori in or above its folder, found none")


def _read_orientation(ori: Path, addpar: Path, recording: ForeignRecording) -> _Orientation:
    with expecting("an orientation of OpenPTV (.ori, .addpar)", ori):
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
    glass = values[18:21] if len(values) >= 21 else np.zeros(3)
    return _Orientation(values[:3], values[6:15].reshape(3, 3), values[15:17], float(values[17]), glass, added)


def _parts(orientation: _Orientation, control: _Control) -> Parts:
    """Return the camera: from x right, y up, looking along -z to x right, y down, z forward."""
    turn = np.diag([1.0, -1.0, -1.0])
    rotation = turn @ nearest_rotation(orientation.rotation).T
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


def _turned(parts: Parts, glass: Array) -> Parts:
    """Return the camera turned to the other side of the glass's normal, its principal point moved with it.

    From there the fit finds the camera that follows rays through a pane best, with a tenth of the residual of the fit
    from the camera itself: oblique rays through glass are astigmatic, as those of a tilted sensor are.
    """
    middle = parts.matrix[:2, 2]
    normal = parts.matrix @ parts.rotation @ -glass
    matrix = parts.matrix.copy()
    matrix[:2, 2] = 2 * middle - normal[:2] / normal[2]
    axis = np.linalg.solve(parts.matrix, [*matrix[:2, 2], 1.0])
    axis /= np.linalg.norm(axis)
    turn = np.cross(axis, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(turn))
    angle = turn * (np.arctan2(sine, axis[2]) / sine if sine > 0 else 1.0)
    return replace(parts, matrix=matrix, rotation=rotation_from_vector(angle) @ parts.rotation)


def _sight(orientation: _Orientation, control: _Control, path: Path) -> tuple[Array, Array]:
    """Return points (n, 3) of the volume, and the native pixels (n, 2) at which the camera sees them.

    Rays are followed from the pixels: out of the lens, through both sides of the glass by Snell's law, to heights of
    the volume. In one medium any points of a ray will do.
    """
    width, height = control.size
    px, py = control.pixel
    axes = (np.linspace(0.0, extent - 1.0, SIGHT_GRID) for extent in control.size)
    pixels = np.stack(np.meshgrid(*axes), axis=2).reshape(-1, 2)
    # half a pixel from the corner of the first pixel to its centre
    sensor = np.stack([(pixels[:, 0] + 0.5 - width / 2) * px, (height / 2 - 0.5 - pixels[:, 1]) * py], axis=1)
    flat = orientation.flat(sensor) - orientation.principal
    if (is_imaged := np.isfinite(flat).all(axis=1)).sum() < LEAST_SIGHT:
        raise InputError(f"{path}: expected lenses (.addpar) that image the sensor, found one that does not")
    flat, pixels = flat[is_imaged], pixels[is_imaged]
    inside = np.column_stack([flat, np.full(len(flat), -orientation.distance)])
    rays = inside @ nearest_rotation(orientation.rotation).T
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    if not control.is_refracted:
        return orientation.center + rays, pixels
    if control.volume is None:
        raise InputError(f"{path}: expected criteria.par beside it, for the volume behind the glass; found none")
    distance = float(np.linalg.norm(orientation.glass))
    if not distance > 0 or not orientation.center @ orientation.glass > distance * (distance + control.thickness):
        raise InputError(
            f"{path}: expected a camera on the far side of the glass, found the glass at "
            f"{orientation.glass.tolist()} and the camera at {orientation.center.tolist()}"
        )
    normal = orientation.glass / distance
    start = np.broadcast_to(orientation.center, rays.shape)
    surfaces = (distance + control.thickness, distance)
    for surface, before, after in zip(surfaces, control.indices, control.indices[1:], strict=False):
        start = start + rays * ((surface - start @ normal) / (rays @ normal))[:, None]
        ratio, cosine = before / after, -rays @ normal
        bent = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
        rays = ratio * rays + (ratio * cosine - bent)[:, None] * normal
    (x0, low0, high0), (x1, low1, high1) = control.volume
    points = []
    for part in np.linspace(0.0, 1.0, SIGHT_DEPTHS):
        ends = low0 + part * (high0 - low0), low1 + part * (high1 - low1)
        # the height depends on x: a line from one place to the other
        slope = (ends[1] - ends[0]) / (x1 - x0)
        along = (ends[0] + slope * (start[:, 0] - x0) - start[:, 2]) / (rays[:, 2] - slope * rays[:, 0])
        points.append(start + rays * along[:, None])
    seen, pixels = np.concatenate(points), np.tile(pixels, (SIGHT_DEPTHS, 1))
    is_inside = (seen[:, 0] >= min(x0, x1)) & (seen[:, 0] <= max(x0, x1)) & np.isfinite(seen).all(axis=1)
    if is_inside.sum() < LEAST_SIGHT:
        raise InputError(f"{path}: expected cameras that see the volume of criteria.par, found one that does not")
    return seen[is_inside], pixels[is_inside]


def _targets(
    folder: Path, image: str, frames: tuple[int, int] | None, recording: ForeignRecording
) -> list[tuple[int, Path]]:
    """Return the frames and files of the targets of a camera, in order; those outside the sequence are left over."""
    before, _, after = (folder / image).name.partition("%d")
    place = (folder / image).parent
    pattern = re.compile(rf"{re.escape(before)}(\d+)(?:{re.escape(after)})?_targets")
    files: list[tuple[int, Path]] = []
    left_over: list[tuple[int, Path]] = []
    for path in place.iterdir() if place.is_dir() else ():
        if match := pattern.fullmatch(path.name):
            is_of_sequence = frames is None or frames[0] <= int(match[1]) <= frames[1]
            (files if is_of_sequence else left_over).append((int(match[1]), path))
    note = f"{place}: files of targets outside the frames of sequence.par are skipped"
    if left_over and note not in recording.assumed:
        recording.assumed.append(note)
    return sorted(files)


def _pieces(targets: dict[str, list[tuple[int, Path]]]) -> Iterator[Piece]:
    for name, files in targets.items():
        for frame, path in files:
            # half a pixel from the corner of the first pixel to its centre
            pixels = _read_targets(path) - 0.5
            if not len(pixels):
                pixels = np.full((1, 2), np.nan)
            yield Piece(path, name, pixels, np.full(len(pixels), float(frame)))


def _read_targets(path: Path) -> Array:
    with expecting("a number and rows of targets", path):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        count = int(lines[0])
        rows = [line.split() for line in lines[1 : 1 + count]]
        pixels = np.array([[row[1], row[2]] for row in rows], dtype=np.float64).reshape(-1, 2)
        if len(pixels) != count:
            raise ValueError(f"{len(pixels)} rows of {count}")
    return pixels


def _read_links(folder: Path) -> TruePoints:
    """Return the points of ``ptv_is.NNN``: previous row, next row, x, y, z; a row goes on as the one before it."""
    labels: list[int] = []
    before, frames, positions, identities, count = -1, [], [], [], 0
    for frame, path in sorted(
        (int(path.suffix[1:]), path) for path in folder.glob("ptv_is.*") if path.suffix[1:].isdigit()
    ):
        rows = np.loadtxt(path, skiprows=1, ndmin=2).reshape(-1, 5)
        previous = labels if before == frame - 1 else []
        labels = []
        for link in rows[:, 0].astype(int):
            goes_on = 0 <= link < len(previous)
            labels.append(previous[link] if goes_on else count)
            count += not goes_on
        before = frame
        frames.append(np.full(len(rows), float(frame)))
        positions.append(rows[:, 2:5])
        identities += labels
    if not positions:
        raise InputError(f"{folder}: expected files ptv_is.NNN, found none")
    return TruePoints(np.array(identities, dtype=np.int64), np.concatenate(positions), frame=np.concatenate(frames))


FORMAT = Format("OpenPTV: targets and orientations, also through glass and water (ptv.par)", read=read)
