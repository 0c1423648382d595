"""MyPTV: segmented particles (blobs) of each camera, and its particles or trajectories as a truth.

Sources: a file of blobs for each camera, without a header: row and column of the centre, size along both, area, and the
number of the image (the manual calls the first two x and y; the program counts rows first). Cameras are named as their
files, without ``blobs_``. Points in space: ``particles`` (x, y, z, ..., frame), or ``trajectories`` and
``smoothed_trajectories``, whose first column is the number of the trajectory, -1 for a particle that is in none.

Conventions: the centre of the top-left pixel is (0, 0). Images that no row names are frames without detections.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece, TruePoints
from stereophd.io.interchange.documents.text_tables import header_of, number_batches
from stereophd.io.interchange.pixels import native_pixels

COLUMNS = ("row", "column", "height", "width", "area", "frame")
# Columns of `particles` beside the number of each camera's blob: position, error and frame.
LEAST_COLUMNS = 5


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read blobs, a file for each camera."""
    recording = ForeignRecording(files=list(sources))
    for path in sources:
        if path.is_dir() or len(header_of(path)[1]) != len(COLUMNS):
            raise InputError(f"{path}: expected a file of blobs ({', '.join(COLUMNS)}), found none")
    recording.pieces = _pieces(sources, options, recording)
    if options.truth is not None:
        recording.truth = _read_truth(options.truth)
    return recording


def _pieces(sources: Sequence[Path], options: ImportOptions, recording: ForeignRecording) -> Iterator[Piece]:
    for path in sources:
        camera = options.name(path.stem.removeprefix("blobs_"))
        for row, column, *_, frame in _batches(path, COLUMNS):
            pixels = native_pixels(np.stack([column, row], axis=1), camera, options, recording)
            yield Piece(path, camera, pixels, frame)


def _batches(path: Path, names: Sequence[str]) -> Iterator[list[Array]]:
    for batch in number_batches(path, header_of(path)[0], names, str(path), list(names)):
        yield list(batch.values())


def _read_truth(path: Path) -> TruePoints:
    """Return particles or trajectories; in the latter whole numbers of trajectories stand first."""
    _, words = header_of(path)
    if len(words) < LEAST_COLUMNS:
        raise InputError(f"{path}: expected particles or trajectories of MyPTV, found {len(words)} columns")
    rows = np.concatenate([np.stack(batch, axis=1) for batch in _batches(path, [str(k) for k in range(len(words))])])
    is_numbered = "." not in words[0]
    label = rows[:, 0].astype(np.int64) if is_numbered else np.full(len(rows), -1)
    # a particle of no trajectory is an object of its own
    lone = label < 0
    label[lone] = label.max(initial=-1) + 1 + np.arange(lone.sum())
    return TruePoints(label, rows[:, is_numbered : 3 + is_numbered], frame=rows[:, -1])


FORMAT = Format("MyPTV: blobs of each camera", read=read)
