"""YOLO: detections as text, a folder for each camera with a file for each frame.

Sources: folders of files such as ``street_000123.txt``, or folders that hold them in ``labels``. A camera is named as
its folder, or as the one above ``labels``. The frame is the last number in the name of the file, and counts from 1,
as in Ultralytics' films, unless a file has 0; a frame without a file has no detections. Rows: class, middle (x, y),
width, height, and optionally score and identity, as Ultralytics writes them with ``save_txt`` and ``save_conf``.

Conventions: places and sizes are shares of the width and the height of the image, from its corner. The detection is the
middle of the box, whose width and height are kept, or the middle of its lower side (`box_point` bottom). All classes
are taken.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.cameras import image_size
from stereophd.io.interchange.documents.text_tables import read_matrix
from stereophd.io.interchange.pixels import native_pixels

LABELS = "labels"
COLUMNS = ("class", "x", "y", "width", "height", "score", "identity")


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read detections, a folder for each camera."""
    folders: dict[str, Path] = {}
    for source in sources:
        folder = source / LABELS if (source / LABELS).is_dir() else source
        if not folder.is_dir():
            raise InputError(f"{source}: expected a folder of text files, one for each frame, found a file")
        camera = options.name((folder.resolve().parent if folder.name == LABELS else folder.resolve()).name)
        if camera in folders:
            raise InputError(f"{source}: expected cameras of different names, found {camera} twice")
        folders[camera] = folder
    files = {camera: _frames(folder) for camera, folder in folders.items()}
    recording = ForeignRecording(files=[path for frames in files.values() for path in frames.values()])
    recording.assumed.append(f"the detection is the {options.box_point} of its box")
    recording.first_frame = 0 if any(0 in frames for frames in files.values()) else 1
    first = f"frame {recording.first_frame} is at the time 0"
    recording.assumed.append(f"the frame is the last number in the name of its file, and {first}")
    recording.pieces = _pieces(files, options, recording)
    return recording


def _frames(folder: Path) -> dict[int, Path]:
    frames: dict[int, Path] = {}
    for path in sorted(folder.glob("*.txt")):
        words = re.findall(r"\d+", path.stem)
        if not words:
            continue  # such as classes.txt
        frame = int(words[-1])
        if frame in frames:
            raise InputError(f"{path}: expected one file for each frame, found frame {frame} also in {frames[frame]}")
        frames[frame] = path
    if not frames:
        raise InputError(f"{folder}: expected text files with frame numbers in their names, found none")
    return frames


def _pieces(files: dict[str, dict[int, Path]], options: ImportOptions, recording: ForeignRecording) -> Iterator[Piece]:
    for camera, frames in files.items():
        size = np.array(image_size(camera, None, options, "boxes are shares of images"), dtype=float)
        for frame, path in frames.items():
            rows = np.full((1, len(COLUMNS)), np.nan)
            if path.stat().st_size:
                table = read_matrix(path)
                if table is None or not 5 <= table.shape[1] <= len(COLUMNS):
                    raise InputError(f"{path}: expected rows of numbers: {', '.join(COLUMNS)}; found others")
                rows = np.pad(table, ((0, 0), (0, len(COLUMNS) - table.shape[1])), constant_values=np.nan)
            middle, extent = rows[:, 1:3] * size, rows[:, 3:5] * size
            extra = {"score": rows[:, 5], "object_id": rows[:, 6]}
            if options.box_point == "bottom":
                middle[:, 1] += extent[:, 1] / 2.0
            else:
                extra |= {"width_px": extent[:, 0], "height_px": extent[:, 1]}
            pixels = native_pixels(middle, camera, options, recording, origin="corner")
            yield Piece(path, camera, pixels, np.full(len(rows), float(frame)), extra=extra)


FORMAT = Format("YOLO: detections (text, a file for each frame)", read=read)
