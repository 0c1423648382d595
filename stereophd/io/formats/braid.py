"""Braid and flydra: a recording (``.braidz``), and the calibration (XML of ``multi_camera_reconstructor``).

A ``.braidz`` is a zip with ``data2d_distorted.csv.gz`` (detections, lens distortion included), ``cam_info.csv.gz``
(number and name of each camera) and usually ``calibration.xml``. A frame without detections is a row of NaN. Frames
are synchronous over the cameras; the time is the trigger's where it is there, else the one at which the image
arrived.

Conventions: pixels and camera axes are the native ones. The calibration is a projection matrix of undistorted pixels,
with a lens as OpenCV's (k1, k2, p1, p2) about its own principal point and focal lengths (``non_linear_parameters``):
where they differ from those of the projection, the lens about the latter that fits best takes its place. A skew is
moved into the detections. Lengths are in metres.
"""

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.documents import expecting, open_packed_table, read_bytes, read_member
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.cameras import put_together
from stereophd.io.interchange.documents.text_tables import number_batches, read_batches
from stereophd.io.interchange.fitted import StatedLens, parts_of_projection
from stereophd.io.interchange.projection import Decomposed, decompose, is_left_handed

DETECTIONS, CAMERAS, CALIBRATION = "data2d_distorted.csv", "cam_info.csv", "calibration.xml"


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read recordings and calibrations."""
    recording = ForeignRecording(files=list(sources))
    archives = [path for path in sources if zipfile.is_zipfile(path)]
    skewed: dict[str, Decomposed] = {}
    for path in sources:
        if path not in archives:
            _read_calibration(read_bytes(path), str(path), bool(archives), options, recording, skewed)
    for path in archives:
        content = None if recording.cameras else read_member(path, CALIBRATION)
        if content is not None:
            _read_calibration(content, f"{path}: {CALIBRATION}", True, options, recording, skewed)
    if archives:
        recording.pieces = _pieces(archives, options, skewed, recording)
    return recording


def _read_calibration(
    content: bytes,
    where: str,
    has_points: bool,
    options: ImportOptions,
    recording: ForeignRecording,
    skewed: dict[str, Decomposed],
) -> None:
    import xml.etree.ElementTree as ElementTree

    with expecting("a calibration of flydra or Braid (XML)", where):
        root = ElementTree.fromstring(content)
        entries = [_entry(element) for element in root.iter("single_camera_calibration")]
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
        parts, with_skew = parts_of_projection(camera, _lens_of(lens), size, has_points, recording, f"{where}: {name}")
        recording.cameras[name] = put_together(name, parts, options, where)
        if with_skew is not None:
            skewed[name] = with_skew


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


def _lens_of(stated: dict[str, float]) -> StatedLens | None:
    coefficients = np.array([stated.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
    if not coefficients.any():
        return None
    matrix = [[stated["fc1"], 0.0, stated["cc1"]], [0.0, stated["fc2"], stated["cc2"]], [0.0, 0.0, 1.0]]
    return StatedLens(np.array(matrix), coefficients)


def _pieces(
    archives: Sequence[Path], options: ImportOptions, skewed: dict[str, Decomposed], recording: ForeignRecording
) -> Iterator[Piece]:
    import io

    import pyarrow as pa

    for path in archives:
        info = read_member(path, CAMERAS)
        if info is None:
            raise InputError(f"{path}: expected {CAMERAS}.gz in the archive, found none")
        kinds = {"camn": pa.float64(), "cam_id": pa.string()}
        info = b"\n".join(line for line in info.splitlines() if not line.startswith(b"#"))
        rows = [row for b in read_batches(io.BytesIO(info), ",", kinds, str(path)) for row in b.to_pylist()]
        names = {int(row["camn"]): options.name(row["cam_id"]) for row in rows}
        yield from _detections(path, names, skewed, recording)


def _detections(
    path: Path, names: dict[int, str], skewed: dict[str, Decomposed], recording: ForeignRecording
) -> Iterator[Piece]:
    columns = ("camn", "frame", "timestamp", "cam_received_timestamp", "x", "y")
    with open_packed_table(path, f"{DETECTIONS}.gz") as table:
        is_triggered: dict[int, bool] = {}
        for row in number_batches(table, ",", columns, f"{path}: {DETECTIONS}"):
            for camn in np.unique(row["camn"]).astype(int).tolist():
                mine = {name: values[row["camn"] == camn] for name, values in row.items()}
                trigger = is_triggered.setdefault(camn, bool(np.isfinite(mine["timestamp"]).all()))
                time = mine["timestamp" if trigger else "cam_received_timestamp"]
                name = names.get(camn, f"cam{camn}")
                pixels = np.stack([mine["x"], mine["y"]], axis=1)
                if name in skewed:
                    pixels = skewed[name].upright(pixels)
                yield Piece(path, name, pixels, mine["frame"], time)
        source = "the trigger" if all(is_triggered.values()) else "the arrival of the images at the computer"
        recording.assumed.append(f"times are those of {source}")


def recognises_cameras(path: Path) -> bool:
    """Whether a file is an XML calibration of flydra or Braid."""
    with open(path, "rb") as stream:
        head = stream.read(4096)
    return b"<multi_camera_reconstructor" in head or b"<single_camera_calibration" in head


FORMAT = Format(
    "Braid, flydra: recordings (.braidz) and calibrations (XML)", read=read, recognises_cameras=recognises_cameras
)
