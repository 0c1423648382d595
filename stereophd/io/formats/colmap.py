"""COLMAP: cameras and poses of a model folder, ``cameras.txt`` and ``images.txt`` (or ``.bin``).

Each registered image is a camera, named as its file without the ending; fixed cameras have one image each.

Conventions: the centre of the top-left pixel is (0.5, 0.5), so the principal point is shifted by half a pixel. Camera
axes are those of stereophd, and ``x_camera = R(q) x_world + t`` with q = (w, x, y, z). A reconstruction has no unit
of length; `length_unit` names one. Models: PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV,
OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.documents import expecting
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions
from stereophd.io.interchange.cameras import Parts, put_together, take_apart, unit

#: Number in binary files -> name, and the names of the parameters (f is both focal lengths).
MODELS: Mapping[int, tuple[str, str]] = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
}
PARAMETERS = dict(MODELS.values())
HALF_PIXEL = 0.5


@dataclass(frozen=True)
class _Intrinsics:
    model: str
    size: tuple[int, int]
    values: dict[str, float]


@dataclass(frozen=True)
class _Image:
    name: str
    camera: int
    quaternion: Array
    translation: Array


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read the cameras of a model folder."""
    if len(sources) != 1:
        raise InputError(f"expected one folder of a COLMAP model, found {len(sources)}")
    folder = sources[0] if sources[0].is_dir() else sources[0].parent
    is_binary = not (folder / "cameras.txt").is_file()
    ending = "bin" if is_binary else "txt"
    files = [folder / f"cameras.{ending}", folder / f"images.{ending}"]
    for path in files:
        if not path.is_file():
            raise InputError(f"{path}: expected cameras and images of a COLMAP model, found no such file")
    recording = ForeignRecording(files=files)
    with expecting("a COLMAP model", folder):
        intrinsics = dict(_binary_cameras(files[0]) if is_binary else _text_cameras(files[0]))
        images = list(_binary_images(files[1]) if is_binary else _text_images(files[1]))
    recording.length_unit = unit(options, recording)
    for image in sorted(images, key=lambda item: item.name):
        name = options.name(str(PurePosixPath(image.name).with_suffix("")))
        recording.cameras[name] = _camera(name, intrinsics[image.camera], image, options, str(folder))
    return recording


def _camera(name: str, intrinsics: _Intrinsics, image: _Image, options: ImportOptions, where: str) -> CameraConfig:
    from scipy.spatial.transform import Rotation  # only here: costly to import

    values = intrinsics.values
    fx, fy = values.get("f", values.get("fx", 0.0)), values.get("f", values.get("fy", 0.0))
    cx, cy = values["cx"] - HALF_PIXEL, values["cy"] - HALF_PIXEL
    fisheye = "FISHEYE" in intrinsics.model
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = np.array([values.get(key, 0.0) for key in order])
    with expecting("a quaternion", f"{where}: {name}"):
        rotation = Rotation.from_quat(image.quaternion, scalar_first=True).as_matrix()
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    parts = Parts(matrix, coefficients, fisheye, rotation, -rotation.T @ image.translation, intrinsics.size)
    return put_together(name, parts, options, where)


def _named(model: str, values: Sequence[float]) -> dict[str, float]:
    if model not in PARAMETERS:
        raise InputError(f"expected a camera model of {', '.join(PARAMETERS)}, found {model}")
    return dict(zip(PARAMETERS[model].split(), map(float, values), strict=True))


def _lines(path: Path) -> Iterator[str]:
    with open(path, encoding="utf-8") as stream:
        for line in stream:
            if not line.startswith("#"):
                yield line.rstrip("\n")


def _text_cameras(path: Path) -> Iterator[tuple[int, _Intrinsics]]:
    for line in _lines(path):
        if words := line.split():
            size = (int(words[2]), int(words[3]))
            yield int(words[0]), _Intrinsics(words[1], size, _named(words[1], [float(w) for w in words[4:]]))


def _text_images(path: Path) -> Iterator[_Image]:
    # every second line holds the image's points, and may be empty
    lines = list(_lines(path))
    for line in lines[::2]:
        if words := line.split():
            pose = np.array(words[1:8], dtype=np.float64)
            yield _Image(" ".join(words[9:]), int(words[8]), pose[:4], pose[4:])


def _binary_cameras(path: Path) -> Iterator[tuple[int, _Intrinsics]]:
    content = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", content, at)
        at += 24
        if model not in MODELS:
            raise InputError(f"{path}: expected a camera model of {', '.join(PARAMETERS)}, found number {model}")
        name, keys = MODELS[model]
        values = struct.unpack_from(f"<{len(keys.split())}d", content, at)
        at += 8 * len(values)
        yield number, _Intrinsics(name, (width, height), _named(name, values))


def _binary_images(path: Path) -> Iterator[_Image]:
    content = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        pose = np.array(struct.unpack_from("<7d", content, at + 4))
        (camera,) = struct.unpack_from("<i", content, at + 60)
        end = content.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", content, end + 1)
        yield _Image(content[at + 64 : end].decode(), camera, pose[:4], pose[4:])
        at = end + 9 + 24 * points


def recognises_cameras(path: Path) -> bool:
    """Whether a folder holds a model, or a file is one of a model's."""
    folder = path if path.is_dir() else path.parent
    if not path.is_dir() and path.name not in ("cameras.txt", "cameras.bin", "images.txt", "images.bin"):
        return False
    return any(
        all((folder / f"{name}.{ending}").is_file() for name in ("cameras", "images")) for ending in ("txt", "bin")
    )


def write_cameras(cameras: Mapping[str, CameraConfig], length_unit: str, target: Path) -> list[str]:
    """Write a model folder as text: one image a camera, no points."""
    from scipy.spatial.transform import Rotation  # only here: costly to import

    target.mkdir(exist_ok=True)
    lines, images = [], []
    for number, (name, config) in enumerate(cameras.items(), start=1):
        parts = take_apart(name, config)
        c = parts.coefficients
        model, lens = ("OPENCV_FISHEYE", c[:4]) if parts.fisheye else ("OPENCV", c[:4])
        if not c.any():
            model, lens = "PINHOLE", c[:0]
        elif not parts.fisheye and c[4:].any():
            model, lens = "FULL_OPENCV", c
        k = parts.matrix
        values = [k[0, 0], k[1, 1], k[0, 2] + HALF_PIXEL, k[1, 2] + HALF_PIXEL, *lens]
        lines.append(f"{number} {model} {parts.size[0]} {parts.size[1]} {' '.join(repr(float(v)) for v in values)}")
        turn = Rotation.from_matrix(parts.rotation).as_quat(canonical=True, scalar_first=True)
        pose = [*turn, *parts.translation]
        images += [f"{number} {' '.join(repr(float(v)) for v in pose)} {number} {name}.png", ""]
    (target / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (target / "images.txt").write_text("\n".join(images) + "\n", encoding="utf-8")
    (target / "points3D.txt").write_text("", encoding="utf-8")
    return [f"lengths are in {length_unit}: the format has no unit"]


FORMAT = Format(
    "COLMAP: cameras and poses of a model folder",
    read=read,
    recognises_cameras=recognises_cameras,
    write_cameras=write_cameras,
    folder_files=("cameras.txt", "images.txt", "points3D.txt"),
)
