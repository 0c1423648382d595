"""DLTdv, easyWand and Argus: digitised points (``xypts``) and coefficients of direct linear transformations.

Sources, each recognised by its content: points as DLTdv writes them (``...xypts.csv`` with columns ``pt1_cam1_X``, or
the sparse ``...xypts.tsv``) or Argus (``..._cam_1_x``); one table of 11 rows of DLT coefficients with a column for
each camera; and an Argus or easyWand camera profile (a row for each camera: number, focal length, width, height,
principal point, aspect ratio, k1, k2, p1, p2, k3). Cameras are named ``cam1``, ``cam2``, ...

Conventions: rows count from the bottom of the image, and the centre of the first pixel is (1, 1), as in MATLAB
(``pixel_origin`` and ``rows_from`` state others). Row k of the points is frame k - 1; rows are synchronous, so
frame offsets between the videos do not matter. The coefficients hold for undistorted pixels: with a profile, the
points are undistorted, and the cameras have no lens. A DLT camera may have a skew; it is moved into the points, which
is exact. A left-handed world is recognised by the scene lying behind the cameras; its z axis is reversed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.lens import Lens
from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.cameras import Parts, image_size, put_together, unit
from stereophd.io.interchange.documents.text_tables import (
    first_lines,
    read_batches,
    read_matrix,
    separator_of,
    split_line,
)
from stereophd.io.interchange.pixels import ORIGINS, point_rows
from stereophd.io.interchange.projection import MIRROR, Decomposed, decompose, is_left_handed, triangulate

COEFFICIENTS = 11
PROFILE_COLUMNS = 12
# Header of a column: the point and the camera.
_COLUMN = re.compile(r"(?P<point>.+?)_cam_?(?P<camera>\d+)_(?P<axis>[xy])", re.IGNORECASE)
# Points that decide the handedness.
POINTS_TRIED = 200
# A skew that moves pixels by less than this is rounding.
NEGLIGIBLE_SKEW_PX = 1e-6


@dataclass
class _Sources:
    """The files by what they are."""

    points: list[Path] = field(default_factory=list)
    coefficients: Array | None = None
    profile: Array | None = None


@dataclass(frozen=True)
class _View:
    """How the source's pixels of one camera become native ones."""

    name: str
    height: int
    shift: float
    from_bottom: bool
    lens: Lens | None = None
    lens_matrix: Array | None = None
    skew_slope: float = 0.0
    skew_row: float = 0.0

    def flip(self) -> Array:
        """Return the matrix (3, 3) from the source's homogeneous pixels to native ones."""
        flip = np.array([[1.0, 0.0, -self.shift], [0.0, 1.0, -self.shift], [0.0, 0.0, 1.0]])
        if self.from_bottom:
            flip = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, self.height - 1.0], [0.0, 0.0, 1.0]]) @ flip
        return flip

    def native(self, pixels: Array) -> Array:
        """Return native pixels (..., 2): flipped, undistorted, without skew."""
        flip = self.flip()
        result = pixels * np.diag(flip)[:2] + flip[:2, 2]
        if self.lens is not None and self.lens_matrix is not None:
            focal, center = np.diag(self.lens_matrix)[:2], self.lens_matrix[:2, 2]
            flat = ((result - center) / focal).reshape(-1, 2)
            seen = np.isfinite(flat).all(axis=1)
            flat[seen] = self.lens.undistort(flat[seen])[0]
            result = flat.reshape(result.shape) * focal + center
        result[..., 0] -= self.skew_slope * (result[..., 1] - self.skew_row)
        return result


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read points, cameras, or both."""
    recording = ForeignRecording(files=list(sources))
    found = _classify(sources)
    where = ", ".join(path.name for path in sources)
    views = _views(found, options, recording, where)
    if found.coefficients is not None:
        views = _add_cameras(found, views, options, recording, where)
    if found.points:
        recording.pieces = _pieces(found, views, options, recording)
    return recording


def _classify(sources: Sequence[Path]) -> _Sources:
    found = _Sources()
    for path in sources:
        lines = first_lines(path, 2)
        table = read_matrix(path)
        if (lines and any(_COLUMN.fullmatch(word) for word in split_line(lines[0]))) or (
            len(lines) > 1 and table is None and re.fullmatch(r"\d+\t\d+\t\d+", lines[1].strip())
        ):
            found.points.append(path)
        elif table is not None and is_profile(table):
            found.profile = table
        elif table is not None and table.shape[0] == COEFFICIENTS:
            found.coefficients = table
        else:
            raise InputError(
                f"{path}: expected points (columns like pt1_cam1_X), {COEFFICIENTS} rows of DLT coefficients, or a "
                f"camera profile of {PROFILE_COLUMNS} columns, found none of them"
            )
    return found


def is_profile(table: Array) -> bool:
    """Whether a table is a camera profile: 12 columns, of which the first counts the cameras."""
    return table.shape[1] == PROFILE_COLUMNS and bool((table[:, 0] == np.arange(1, len(table) + 1)).all())


def _views(found: _Sources, options: ImportOptions, recording: ForeignRecording, where: str) -> list[_View]:
    """Return the conventions of each camera; cameras are counted in the coefficients, the profile, or the points."""
    if found.coefficients is not None:
        count = found.coefficients.shape[1]
    elif found.profile is not None:
        count = len(found.profile)
    else:
        count = max((camera for path in found.points for _, camera in _columns(path, 0)[0]), default=0)
    if found.profile is not None and len(found.profile) != count:
        raise InputError(f"{where}: expected a camera profile of {count} rows, found {len(found.profile)}")
    shift = ORIGINS[options.pixel_origin or "one"]
    from_bottom = (options.rows_from or "bottom") == "bottom"
    recording.assumed.append(
        f"rows count from the {'bottom' if from_bottom else 'top'}, and the centre of the first pixel is "
        f"({shift:g}, {shift:g})"
    )
    views = []
    for number in range(1, count + 1):
        name = options.name(f"cam{number}")
        stated = None if found.profile is None else found.profile[number - 1]
        size = image_size(name, None if stated is None else (int(stated[2]), int(stated[3])), options, where)
        view = _View(name, size[1], shift, from_bottom)
        if stated is not None and stated[7:].any():
            view = _with_lens(view, stated)
        views.append(view)
    if any(view.lens is not None for view in views):
        recording.assumed.append("the points are distorted, and are undistorted by the camera profile")
    return views


def _with_lens(view: _View, stated: Array) -> _View:
    """Add the lens of a row of a profile, which is stated in the source's pixels."""
    _, focal, _, _, cx, cy, aspect, k1, k2, p1, p2, k3 = stated
    flip = view.flip()
    up = -1.0 if view.from_bottom else 1.0
    center = flip[:2, :2] @ [cx, cy] + flip[:2, 2]
    matrix = np.array([[focal, 0.0, center[0]], [0.0, focal * (aspect or 1.0), center[1]], [0.0, 0.0, 1.0]])
    # with y reversed, the tangential term of y changes its sign
    lens = Lens("brown_conrady", k1=k1, k2=k2, p1=up * p1, p2=p2, k3=k3)
    return _View(view.name, view.height, view.shift, view.from_bottom, lens, matrix)


def _add_cameras(
    found: _Sources, views: Sequence[_View], options: ImportOptions, recording: ForeignRecording, where: str
) -> list[_View]:
    """Take the coefficients apart into cameras; returns the views with their skews."""
    assert found.coefficients is not None
    projections = [
        view.flip() @ np.append(column, 1.0).reshape(3, 4)
        for view, column in zip(views, found.coefficients.T, strict=True)
    ]
    cameras = [decompose(p, f"{where}: {view.name}") for p, view in zip(projections, views, strict=True)]
    if is_left_handed(cameras, _some_points(found, views, projections)):
        projections = [p @ MIRROR for p in projections]
        cameras = [decompose(p, f"{where}: {view.name}") for p, view in zip(projections, views, strict=True)]
        recording.assumed.append(
            "the world is left-handed (or the rows count from the other side): its z axis is reversed"
        )
    recording.length_unit = unit(options, recording, where)
    result = []
    for view, camera in zip(views, cameras, strict=True):
        size = image_size(view.name, _profile_size(found, view.name, views), options, where)
        matrix = camera.matrix.copy()
        matrix[0, 1] = 0.0
        parts = Parts(matrix, np.zeros(5), False, camera.rotation, camera.center, size)
        recording.cameras[view.name] = put_together(view.name, parts, options, where)
        result.append(_without_skew(view, camera, bool(found.points), recording))
    return result


def _profile_size(found: _Sources, name: str, views: Sequence[_View]) -> tuple[int, int] | None:
    if found.profile is None:
        return None
    row = found.profile[[view.name for view in views].index(name)]
    return int(row[2]), int(row[3])


def _without_skew(view: _View, camera: Decomposed, has_points: bool, recording: ForeignRecording) -> _View:
    largest = abs(camera.skew_slope) * view.height / 2
    if largest < NEGLIGIBLE_SKEW_PX:
        return view
    way = "moved into the points" if has_points else "left out"
    recording.assumed.append(f"{view.name}: its skew of up to {largest:.2g} px is {way}: native cameras have none")
    slope, row = camera.skew_slope, float(camera.matrix[1, 2])
    return _View(view.name, view.height, view.shift, view.from_bottom, view.lens, view.lens_matrix, slope, row)


def _some_points(found: _Sources, views: Sequence[_View], projections: Sequence[Array]) -> Array | None:
    """Return some world points of the recording, in the world of the coefficients."""
    for path in found.points:
        for _, points in _batches(path, len(views)):
            native = np.stack([view.native(points[:, :, k]) for k, view in enumerate(views)], axis=2)
            # frames x points x cameras x 2
            return triangulate(projections, native.reshape(-1, len(views), 2)[:POINTS_TRIED])
    return None


def _pieces(
    found: _Sources, views: Sequence[_View], options: ImportOptions, recording: ForeignRecording
) -> Iterator[Piece]:
    if len(found.points) > 1:
        raise InputError(f"expected one table of points, found {', '.join(map(str, found.points))}")
    path = found.points[0]
    names = list(dict.fromkeys(name for name, _ in _columns(path, len(views))[0]))
    recording.labels.update(enumerate(names))
    for frames, points in _batches(path, len(views)):
        for k, view in enumerate(views):
            yield point_rows(view.name, frames, view.native(points[:, :, k]), None, None)


def _columns(path: Path, cameras: int) -> tuple[list[tuple[str, int]], list[str]]:
    """Return (point, camera) of each pair of columns, and the names of all columns."""
    lines = first_lines(path, 2)
    words = split_line(lines[0])
    matches = [_COLUMN.fullmatch(word) for word in words]
    if any(matches):
        found = [(m["point"], int(m["camera"])) for m in matches if m is not None and m["axis"].lower() == "x"]
        return found, words
    columns = int(lines[1].split()[1])
    if not cameras or columns % (2 * cameras):
        raise InputError(f"{path}: expected DLT coefficients with sparse points, because their columns have no names")
    return [(f"pt{k // cameras + 1}", k % cameras + 1) for k in range(columns // 2)], []


def _batches(path: Path, cameras: int) -> Iterator[tuple[Array, Array]]:
    """Yield frame numbers (n,) and the source's pixels (n, points, cameras, 2) in pieces."""
    pairs, words = _columns(path, cameras)
    names = list(dict.fromkeys(name for name, _ in pairs))
    cameras = max(cameras, max(camera for _, camera in pairs))
    if not words:
        yield _sparse(path, len(names), cameras)
        return
    import pyarrow as pa

    columns = {
        (m["point"], int(m["camera"]), m["axis"].lower()): word for word in words if (m := _COLUMN.fullmatch(word))
    }
    start = 0
    for batch in read_batches(
        path, separator_of(first_lines(path, 1)[0]), dict.fromkeys(columns.values(), pa.float64()), str(path)
    ):
        points = np.full((len(batch), len(names), cameras, 2), np.nan)
        for (name, camera, axis), word in columns.items():
            points[:, names.index(name), camera - 1, "xy".index(axis)] = batch.column(word).to_numpy(
                zero_copy_only=False
            )
        yield np.arange(start, start + len(batch), dtype=np.float64), points
        start += len(batch)


def _sparse(path: Path, points: int, cameras: int) -> tuple[Array, Array]:
    """Return the content of a sparse table: row, column, value; what is not there is not seen."""
    rows = int(first_lines(path, 2)[1].split()[0])
    values = np.full((rows, points * cameras * 2), np.nan)
    try:
        entries = np.loadtxt(path, skiprows=2, ndmin=2)
        for row, column, value in entries:
            values[int(row) - 1, int(column) - 1] = value
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{path}: expected rows of row, column and value within the stated size, found: {error}"
        ) from error
    return np.arange(rows, dtype=np.float64), values.reshape(rows, points, cameras, 2)


FORMAT = Format("DLTdv, easyWand, Argus: digitised points and DLT coefficients", read=read)
