"""DLTdv, easyWand and Argus: digitised points (``xypts``) and coefficients of direct linear transformations.

Sources, each recognised by its content: points as DLTdv writes them (``...xypts.csv`` with columns ``pt1_cam1_X``, or
the sparse ``...xypts.tsv``) or Argus (``..._cam_1_x``); one table of 11 rows of DLT coefficients with a column for
each camera; and an Argus or easyWand camera profile (a row for each camera: number, focal length, width, height,
principal point, aspect ratio, k1, k2, p1, p2, k3). Cameras are named ``cam1``, ``cam2``, ...

Conventions: rows count from the bottom of the image, and the centre of the first pixel is (1, 1), as in MATLAB
(`pixel_origin` and `rows_from` set others). Row k of the points is frame k - 1; rows are synchronous, so
frame offsets between the videos do not matter. The coefficients hold for undistorted pixels, the points are as
digitised: with a profile, the cameras get the lens with which the coefficients see the points. A DLT camera may have
a skew; it is moved into the points, which is exact. A left-handed world is recognised by the scene lying behind the
cameras; its z axis is reversed. Points in space (``...xyzpts.csv`` with columns ``pt1_X``) are the truth.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.documents import check_claim, expecting
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece, TruePoints
from stereophd.io.interchange.cameras import Parts, image_size, put_together, unit
from stereophd.io.interchange.documents.text_tables import first_lines, header_of, number_batches, read_matrix
from stereophd.io.interchange.fitted import StatedLens, parts_of_projection
from stereophd.io.interchange.pixels import ORIGINS, point_rows
from stereophd.io.interchange.projection import MIRROR, Decomposed, decompose, is_left_handed, triangulate
from stereophd.io.interchange.truth import stacked, wide_truth

COEFFICIENTS = 11
PROFILE_COLUMNS = 12
# Header of a column: the point and the camera.
_COLUMN = re.compile(r"(?P<point>.+?)_cam_?(?P<camera>\d+)_(?P<axis>[xy])", re.IGNORECASE)
# Points that decide the handedness.
POINTS_TRIED = 200


@dataclass
class _Sources:
    points: list[Path] = field(default_factory=list)
    coefficients: Array | None = None
    profile: Array | None = None


@dataclass(frozen=True)
class _View:
    """How the source's pixels of one camera become native ones."""

    name: str
    size: tuple[int, int]
    shift: float
    from_bottom: bool
    lens: StatedLens | None = None
    skewed: Decomposed | None = None

    def flip(self) -> Array:
        """Return the matrix (3, 3) from the source's homogeneous pixels to native ones."""
        flip = np.array([[1.0, 0.0, -self.shift], [0.0, 1.0, -self.shift], [0.0, 0.0, 1.0]])
        if self.from_bottom:
            flip = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, self.size[1] - 1.0], [0.0, 0.0, 1.0]]) @ flip
        return flip

    def native(self, pixels: Array) -> Array:
        """Return native pixels (..., 2) of the source's: flipped, without skew."""
        flip = self.flip()
        native = pixels * np.diag(flip)[:2] + flip[:2, 2]
        return native if self.skewed is None else self.skewed.upright(native)


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read points, cameras, or both."""
    recording = ForeignRecording(files=list(sources))
    tables = _classify(sources)
    where = ", ".join(path.name for path in sources)
    views = _views(tables, options, recording, where)
    flips_z = False
    if tables.coefficients is not None:
        if tables.profile is None:
            recording.assumed.append("pixels are undistorted, as without a camera profile there is no lens")
        views, flips_z = _add_cameras(tables, views, options, recording, where)
    elif tables.profile is not None:
        _add_unplaced(views, options, recording, where)
    if tables.points:
        recording.pieces = _pieces(tables, views, options, recording)
    if options.truth is not None:
        recording.truth = _truth(options.truth, flips_z)
    return recording


def _classify(sources: Sequence[Path]) -> _Sources:
    tables = _Sources()
    for path in sources:
        table, is_named = read_matrix(path), any(_COLUMN.fullmatch(word) for word in header_of(path)[1])
        if is_named or (table is None and _is_sparse(path)):
            tables.points.append(path)
        elif table is not None and is_profile(table):
            tables.profile = table
        elif table is not None and table.shape[0] == COEFFICIENTS:
            tables.coefficients = table
        else:
            raise InputError(
                f"{path}: expected points (columns like pt1_cam1_X), {COEFFICIENTS} rows of DLT coefficients, or a "
                f"camera profile of {PROFILE_COLUMNS} columns, found none of them (points in space are a `truth`; "
                "offsets and residuals are not needed)"
            )
    return tables


def is_profile(table: Array) -> bool:
    """Whether a table is a camera profile: 12 columns, of which the first counts the cameras."""
    return table.shape[1] == PROFILE_COLUMNS and bool((table[:, 0] == np.arange(1, len(table) + 1)).all())


def _views(tables: _Sources, options: ImportOptions, recording: ForeignRecording, where: str) -> list[_View]:
    """Return the conventions of each camera; cameras are counted in the coefficients, the profile, or the points."""
    calibrated = tables.profile if tables.coefficients is None else tables.coefficients.T
    count = 0 if calibrated is None else len(calibrated)
    pointed = max((camera for path in tables.points for _, camera in _columns(path, count)[0]), default=0)
    if 0 < count < pointed:
        recording.warnings.append(f"{where}: cam{count + 1} and later have no calibration: their points are left out")
    count = count or pointed
    if tables.profile is not None and len(tables.profile) != count:
        raise InputError(f"{where}: expected a camera profile of {count} rows, found {len(tables.profile)}")
    shift = ORIGINS[options.pixel_origin or "one"]
    from_bottom = (options.rows_from or "bottom") == "bottom"
    recording.assumed.append(
        f"rows count from the {'bottom' if from_bottom else 'top'}, and the centre of the first pixel is "
        f"({shift:g}, {shift:g})"
    )
    views = []
    for number in range(1, count + 1):
        name = options.name(f"cam{number}")
        stated = None if tables.profile is None else tables.profile[number - 1]
        size = image_size(name, None if stated is None else stated[2:4], options, where)
        view = _View(name, size, shift, from_bottom)
        if stated is not None:
            view = _with_lens(view, stated)
        views.append(view)
    return views


def _with_lens(view: _View, stated: Array) -> _View:
    """Add the lens of a row of a profile, which is stated in the source's pixels."""
    _, focal, _, _, cx, cy, aspect, k1, k2, p1, p2, k3 = stated
    flip = view.flip()
    up = -1.0 if view.from_bottom else 1.0
    center = flip[:2, :2] @ [cx, cy] + flip[:2, 2]
    matrix = np.array([[focal, 0.0, center[0]], [0.0, focal * (aspect or 1.0), center[1]], [0.0, 0.0, 1.0]])
    # with y reversed, the tangential term of y changes its sign
    return replace(view, lens=StatedLens(matrix, np.array([k1, k2, up * p1, p2, k3])))


def _add_unplaced(views: Sequence[_View], options: ImportOptions, recording: ForeignRecording, where: str) -> None:
    """Add cameras of which the profile is all that is known."""
    recording.length_unit = unit(options, recording)
    recording.assumed.append("the poses of the cameras are unknown: the sources have no DLT coefficients")
    for view in views:
        assert view.lens is not None
        parts = Parts(view.lens.matrix, view.lens.coefficients, False, np.eye(3), np.zeros(3), view.size)
        recording.cameras[view.name] = put_together(view.name, parts, options, where, pose="unknown")


def _add_cameras(
    tables: _Sources, views: Sequence[_View], options: ImportOptions, recording: ForeignRecording, where: str
) -> tuple[list[_View], bool]:
    """Take the coefficients apart into cameras; returns the views with their skews, and whether z is reversed."""
    assert tables.coefficients is not None
    projections = [
        view.flip() @ np.append(column, 1.0).reshape(3, 4)
        for view, column in zip(views, tables.coefficients.T, strict=True)
    ]
    cameras = [decompose(p, f"{where}: {view.name}") for p, view in zip(projections, views, strict=True)]
    flips_z = is_left_handed(cameras, _some_points(tables, views, projections))
    if flips_z:
        projections = [p @ MIRROR for p in projections]
        cameras = [decompose(p, f"{where}: {view.name}") for p, view in zip(projections, views, strict=True)]
        other = "top" if views[0].from_bottom else "bottom"
        recording.assumed.append(
            "the world is left-handed, and its z axis is reversed; or rows count from the other side (`rows_from` "
            f"{other}), and all tracks would be mirror images, in which rays meet as well"
        )
    recording.length_unit = unit(options, recording)
    result = []
    for view, camera in zip(views, cameras, strict=True):
        lens = None if options.undistorted else view.lens
        parts, skewed = parts_of_projection(camera, lens, view.size, bool(tables.points), recording, view.name)
        recording.cameras[view.name] = put_together(view.name, parts, options, where)
        result.append(replace(view, skewed=skewed))
    return result, flips_z


def _some_points(tables: _Sources, views: Sequence[_View], projections: Sequence[Array]) -> Array | None:
    """Return some world points of the recording, in the world of the coefficients."""
    for path in tables.points:
        for _, points in _batches(path, len(views)):
            rows = points.reshape(-1, len(views), 2)[:POINTS_TRIED]
            native = [view.native(rows[:, k]) for k, view in enumerate(views)]
            flat = [n if view.lens is None else view.lens.undistort(n) for n, view in zip(native, views, strict=True)]
            return triangulate(projections, np.stack(flat, axis=1))
    return None


def _pieces(
    tables: _Sources, views: Sequence[_View], options: ImportOptions, recording: ForeignRecording
) -> Iterator[Piece]:
    if len(tables.points) > 1:
        raise InputError(f"expected one table of points, found {', '.join(map(str, tables.points))}")
    path = tables.points[0]
    names = list(dict.fromkeys(name for name, _ in _columns(path, len(views))[0]))
    recording.labels.update(enumerate(names))
    for frames, points in _batches(path, len(views)):
        for k, view in enumerate(views):
            yield point_rows(path, view.name, frames, view.native(points[:, :, k]), None)


def _columns(path: Path, cameras: int) -> tuple[list[tuple[str, int]], list[str]]:
    """Return (point, camera) of each pair of columns, and the names of all columns."""
    words = header_of(path)[1]
    matches = [_COLUMN.fullmatch(word) for word in words]
    if any(matches):
        pairs = [(m["point"], int(m["camera"])) for m in matches if m is not None and m["axis"].lower() == "x"]
        return pairs, words
    columns = int(first_lines(path, 2)[1].split()[1])
    if not cameras or columns % (2 * cameras):
        raise InputError(f"{path}: expected DLT coefficients with sparse points, because their columns have no names")
    return [(f"pt{k // cameras + 1}", k % cameras + 1) for k in range(columns // 2)], []


def _batches(path: Path, cameras: int) -> Iterator[tuple[Array, Array]]:
    """Yield frame numbers (n,) and the source's pixels (n, points, cameras, 2) in pieces."""
    pairs, words = _columns(path, cameras)
    names = list(dict.fromkeys(name for name, _ in pairs))
    cameras = max(cameras, max(camera for _, camera in pairs))
    if not words:
        values = _read_sparse(path)
        yield np.arange(len(values), dtype=np.float64), values.reshape(len(values), len(names), cameras, 2)
        return
    columns = {
        (m["point"], int(m["camera"]), m["axis"].lower()): word for word in words if (m := _COLUMN.fullmatch(word))
    }
    start = 0
    for batch in number_batches(path, header_of(path)[0], columns.values(), str(path)):
        count = len(next(iter(batch.values())))
        points = np.full((count, len(names), cameras, 2), np.nan)
        for (name, camera, axis), word in columns.items():
            points[:, names.index(name), camera - 1, "xy".index(axis)] = batch[word]
        yield np.arange(start, start + count, dtype=np.float64), points
        start += count


def _truth(path: Path, flips_z: bool) -> TruePoints:
    """Return DLTdv's points in space, in the world of the cameras."""
    truth = stacked(_read_sparse(path)) if _is_sparse(path) else wide_truth(path)
    return replace(truth, position=truth.position * [1.0, 1.0, -1.0 if flips_z else 1.0])


def _is_sparse(path: Path) -> bool:
    """Whether a table is one of DLTdv's sparse ones, whose second line states their size."""
    lines = first_lines(path, 2)
    return len(lines) > 1 and re.fullmatch(r"\d+\t\d+\t\d+", lines[1].strip()) is not None


def _read_sparse(path: Path) -> Array:
    """Return the content of a sparse table of rows of row, column, value; what is not there is not seen."""
    rows, columns = map(int, first_lines(path, 2)[1].split()[:2])
    check_claim(8 * rows * columns, path.stat().st_size, str(path))
    values = np.full((rows, columns), np.nan)
    with expecting("rows of row, column and value within the stated size", path):
        entries = np.loadtxt(path, skiprows=2, ndmin=2)
        values[entries[:, 0].astype(int) - 1, entries[:, 1].astype(int) - 1] = entries[:, 2]
    return values


FORMAT = Format("DLTdv, easyWand, Argus: digitised points and DLT coefficients", read=read)
