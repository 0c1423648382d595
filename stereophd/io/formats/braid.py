"""Braid and flydra: a recording (``.braidz``), and the calibration (XML of ``multi_camera_reconstructor``).

A ``.braidz`` is a zip with ``data2d_distorted.csv.gz`` (detections, lens distortion included), ``cam_info.csv.gz``
(number and name of each camera) and usually ``calibration.xml``. A frame without detections is a row of NaN. Frames
are synchronous over the cameras; the time is the trigger's where it is there, else the one at which the image
arrived.

Conventions: pixels and camera axes are the native ones. The calibration is a projection matrix of undistorted pixels,
with a lens as OpenCV's (k1, k2, p1, p2) about its own principal point and focal lengths (``non_linear_parameters``):
where they differ from those of the projection, the detections are undistorted and the camera has no lens. Lengths are
in metres.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.lens import Lens
from stereophd.errors import InputError
from stereophd.io.documents import open_packed_table, read_bytes, read_member
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.cameras import Parts, put_together
from stereophd.io.interchange.documents.text_tables import numbers, read_batches
from stereophd.io.interchange.projection import Decomposed, decompose, is_left_handed

DETECTIONS, CAMERAS, CALIBRATION = "data2d_distorted.csv", "cam_info.csv", "calibration.xml"
# Skew, and difference of intrinsics, that move pixels by less than this are rounding of a file of few digits.
NEGLIGIBLE_PX = 1e-3


@dataclass(frozen=True)
class _Correction:
    """How detections of a camera are corrected: a lens of its own, or a skew."""

    lens: Lens | None
    matrix: Array
    skew_slope: float
    skew_row: float

    def apply(self, pixels: Array) -> Array:
        result = pixels.copy()
        if self.lens is not None:
            focal, center = np.diag(self.matrix)[:2], self.matrix[:2, 2]
            seen = np.isfinite(result).all(axis=1)
            result[seen] = self.lens.undistort((result[seen] - center) / focal)[0] * focal + center
        result[:, 0] -= self.skew_slope * (result[:, 1] - self.skew_row)
        return result


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read recordings and calibrations."""
    recording = ForeignRecording(files=list(sources))
    archives = [path for path in sources if zipfile.is_zipfile(path)]
    corrections: dict[str, _Correction] = {}
    for path in sources:
        if path not in archives:
            _read_calibration(read_bytes(path), str(path), bool(archives), options, recording, corrections)
    for path in archives:
        content = None if recording.cameras else read_member(path, CALIBRATION)
        if content is not None:
            _read_calibration(content, f"{path}: {CALIBRATION}", True, options, recording, corrections)
    if archives:
        recording.pieces = _pieces(archives, options, corrections, recording)
    return recording


def _read_calibration(
    content: bytes,
    where: str,
    has_points: bool,
    options: ImportOptions,
    recording: ForeignRecording,
    corrections: dict[str, _Correction],
) -> None:
    import xml.etree.ElementTree as ElementTree

    try:
        root = ElementTree.fromstring(content)
        elements = list(root.iter("single_camera_calibration"))
        entries = [_entry(element) for element in elements]
    except (ElementTree.ParseError, ValueError, AttributeError) as error:
        raise InputError(f"{where}: expected a calibration of flydra or Braid (XML), found: {error}") from error
    if not entries:
        raise InputError(f"{where}: expected single_camera_calibration, found none")
    if root.find("water") is not None:
        raise InputError(f"{where}: expected cameras and objects in one medium, found a water surface: not supported")
    cameras = [decompose(projection, f"{where}: {name}") for name, projection, _, _ in entries]
    if is_left_handed(cameras, None):
        raise InputError(f"{where}: expected a right-handed world with the scene before the cameras, found it behind")
    recording.length_unit = options.length_unit or "m"
    for (source, _, size, lens), camera in zip(entries, cameras, strict=True):
        name = options.name(source)
        parts, correction = _with_lens(name, camera, size, lens, has_points, where, recording)
        recording.cameras[name] = put_together(name, parts, options, where)
        if correction is not None and has_points:
            corrections[name] = correction


def _entry(element: Any) -> tuple[str, Array, tuple[int, int], dict[str, float]]:
    """Return name, projection, image size and lens of a camera."""

    def text(key: str) -> str:
        return str(element.find(key).text).strip()

    projection = np.array([row.split() for row in text("calibration_matrix").split(";")], dtype=np.float64)
    scale = element.find("scale_factor")
    if scale is not None:
        # old files: the world is scaled by this factor
        projection[:, 3] *= float(scale.text)
    width, height = map(int, map(float, text("resolution").split()))
    found = element.find("non_linear_parameters")
    lens = {} if found is None else {child.tag: float(child.text) for child in found if child.text}
    return text("cam_id"), projection.reshape(3, 4), (width, height), lens


def _with_lens(
    name: str,
    camera: Decomposed,
    size: tuple[int, int],
    lens: dict[str, float],
    has_points: bool,
    where: str,
    recording: ForeignRecording,
) -> tuple[Parts, _Correction | None]:
    """Return a camera whose lens is about the projection's own principal point, or what corrects its detections."""
    matrix = camera.matrix.copy()
    matrix[0, 1] = 0.0
    coefficients = np.array([lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
    own = matrix
    if coefficients.any():
        own = np.array([[lens["fc1"], 0.0, lens["cc1"]], [0.0, lens["fc2"], lens["cc2"]], [0.0, 0.0, 1.0]])
    slope = camera.skew_slope if abs(camera.skew_slope) * size[1] > NEGLIGIBLE_PX else 0.0
    if not slope and np.abs(own - matrix).max() < NEGLIGIBLE_PX:
        return Parts(matrix, coefficients, False, camera.rotation, camera.center, size), None
    if not has_points:
        reason = "its lens has a principal point of its own" if coefficients.any() else "its projection has a skew"
        recording.warnings.append(f"{where}: {name}: {reason}; import the calibration with the recording to correct it")
        return Parts(matrix, coefficients, False, camera.rotation, camera.center, size), None
    recording.assumed.append(f"{name}: the detections are undistorted, and the camera has no lens")
    model = Lens("brown_conrady", **dict(zip(("k1", "k2", "p1", "p2", "k3"), map(float, coefficients), strict=True)))
    correction = _Correction(model if coefficients.any() else None, own, slope, float(matrix[1, 2]))
    return Parts(matrix, np.zeros(5), False, camera.rotation, camera.center, size), correction


def _pieces(
    archives: Sequence[Path], options: ImportOptions, corrections: dict[str, _Correction], recording: ForeignRecording
) -> Iterator[Piece]:
    import io

    import pyarrow as pa

    for path in archives:
        info = read_member(path, CAMERAS)
        if info is None:
            raise InputError(f"{path}: expected {CAMERAS}.gz in the archive, found none")
        kinds = {"camn": pa.float64(), "cam_id": pa.string()}
        rows = [
            row for b in read_batches(io.BytesIO(_uncommented(info)), ",", kinds, str(path)) for row in b.to_pylist()
        ]
        names = {int(row["camn"]): options.name(row["cam_id"]) for row in rows}
        yield from _detections(path, names, corrections, recording)


def _uncommented(content: bytes) -> bytes:
    """Return a small table without the lines that begin with ``#``."""
    return b"\n".join(line for line in content.splitlines() if not line.startswith(b"#"))


def _detections(
    path: Path, names: dict[int, str], corrections: dict[str, _Correction], recording: ForeignRecording
) -> Iterator[Piece]:
    import pyarrow as pa

    kinds = dict.fromkeys(("camn", "frame", "timestamp", "cam_received_timestamp", "x", "y"), pa.float64())
    with open_packed_table(path, f"{DETECTIONS}.gz") as table:
        is_triggered: dict[int, bool] = {}
        for batch in read_batches(table, ",", kinds, f"{path}: {DETECTIONS}"):
            row = {name: numbers(batch, name) for name in kinds}
            for camn in np.unique(row["camn"]).astype(int).tolist():
                mine = {name: values[row["camn"] == camn] for name, values in row.items()}
                trigger = is_triggered.setdefault(camn, bool(np.isfinite(mine["timestamp"]).all()))
                time = mine["timestamp" if trigger else "cam_received_timestamp"]
                name = names.get(camn, f"cam{camn}")
                pixels = np.stack([mine["x"], mine["y"]], axis=1)
                if name in corrections:
                    pixels = corrections[name].apply(pixels)
                yield Piece(name, pixels, mine["frame"], time)
        source = "the trigger" if all(is_triggered.values()) else "the arrival of the images at the computer"
        recording.assumed.append(f"times are those of {source}")


def recognises_cameras(path: Path) -> bool:
    """Whether a file is an XML calibration of flydra or Braid."""
    if path.is_dir():
        return False
    try:
        with open(path, "rb") as stream:
            head = stream.read(4096)
    except OSError:
        return False
    return b"<multi_camera_reconstructor" in head or b"<single_camera_calibration" in head


FORMAT = Format(
    "Braid, flydra: recordings (.braidz) and calibrations (XML)", read=read, recognises_cameras=recognises_cameras
)
