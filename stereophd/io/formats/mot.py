"""MOTChallenge: detections of one camera per file in, 3-D tracks out.

Sources: text files, or sequence folders with ``det/det.txt`` (else ``gt/gt.txt``); a ``seqinfo.ini`` beside gives
rate, image size and number of frames. Rows: frame, identity, left, top, width, height, confidence, ... A camera is
named as its file, or as its folder where the file is called ``det`` or ``gt``.

Conventions: frames, pixels and identities count from 1: the centre of the top-left pixel is (1, 1). The detection is
the centre of the box, whose width and height are kept, or the middle of its lower side (`box_point` bottom).
Identity -1 is none. Time is (frame - 1) / rate, frame numbers stay as they are. Tracks are written with 3-D positions
in columns 8 to 10 and boxes of -1; a frame is a reported time, counted from 1.
"""

import configparser
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.documents import expecting
from stereophd.io.interchange.base import ExportOptions, ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.documents.text_tables import header_of, number_batches
from stereophd.io.interchange.pixels import native_pixels
from stereophd.io.interchange.tracks import on_grid, trajectories

# Number of the first frame: at time 0.
FIRST_FRAME = 1
COLUMNS = ("frame", "id", "left", "top", "width", "height", "score")


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read detections, a file or folder for each camera."""
    recording = ForeignRecording(first_frame=FIRST_FRAME)
    files: dict[str, Path] = {}
    for source in sources:
        path = _file_of(source)
        stem = path.stem if path.stem not in ("det", "gt") else path.resolve().parent.parent.name
        camera = options.name(stem)
        if camera in files:
            raise InputError(f"{path}: expected cameras of different names, found {camera} twice")
        files[camera] = path
        _read_sequence_info(path, camera, recording)
        if camera not in recording.rates and options.rates.get(camera) is None:
            raise InputError(f"{path}: expected a seqinfo.ini or `rates` (frames per second), found neither")
    recording.files = [*files.values(), *recording.files]
    recording.assumed.append(f"the detection is the {options.box_point} of its box")
    recording.pieces = _pieces(files, options, recording)
    return recording


def _file_of(source: Path) -> Path:
    if not source.is_dir():
        return source
    for name in ("det/det.txt", "gt/gt.txt"):
        if (source / name).is_file():
            return source / name
    raise InputError(f"{source}: expected det/det.txt or gt/gt.txt in the folder, found neither")


def _read_sequence_info(path: Path, camera: str, recording: ForeignRecording) -> None:
    """Take the rate, the number of frames and the size of the images from ``seqinfo.ini``."""
    info = next((p / "seqinfo.ini" for p in (path.parent, path.parent.parent) if (p / "seqinfo.ini").is_file()), None)
    if info is None:
        return
    parser = configparser.ConfigParser()
    with expecting("[Sequence] with frameRate and seqLength", info):
        parser.read(info, encoding="utf-8-sig")
        sequence = parser["Sequence"]
        recording.rates[camera] = float(sequence["frameRate"])
        if "seqLength" in sequence:
            recording.frames[camera] = (FIRST_FRAME, int(sequence["seqLength"]))
        if "imWidth" in sequence and "imHeight" in sequence:
            recording.image_sizes[camera] = int(sequence["imWidth"]), int(sequence["imHeight"])
    recording.files.append(info)


def _pieces(files: dict[str, Path], options: ImportOptions, recording: ForeignRecording) -> Iterator[Piece]:
    for camera, path in files.items():
        separator, words = header_of(path)
        if len(words) < len(COLUMNS) - 1:
            raise InputError(f"{path}: expected rows of {', '.join(COLUMNS)}, found {len(words)} columns")
        names = [*COLUMNS, *(f"more_{k}" for k in range(len(words) - len(COLUMNS)))][: len(words)]
        for row in number_batches(path, separator, names[: len(COLUMNS)], str(path), names):
            yield _piece(path, camera, row, options, recording)


def _piece(
    path: Path, camera: str, row: dict[str, Array], options: ImportOptions, recording: ForeignRecording
) -> Piece:
    # a box covers the pixels left ... left + width - 1, all counted from 1
    u = row["left"] + (row["width"] - 1.0) / 2
    down = row["height"] - 1.0
    v = row["top"] + (down if options.box_point == "bottom" else down / 2)
    extra = {"object_id": np.where(row["id"] >= 0, row["id"], np.nan)}
    if options.box_point == "center":
        extra |= {"width_px": row["width"], "height_px": row["height"]}
    if "score" in row:
        extra["score"] = row["score"]
    native = native_pixels(np.stack([u, v], axis=1), camera, options, recording, origin="one")
    return Piece(path, camera, native, row["frame"], extra=extra)


def write_tracks(tracks: Path, target: Path, options: ExportOptions) -> list[str]:
    """Write 3-D tracks: one row a time and track, in order of frames."""
    if options.rate_hz is None:
        found = trajectories(tracks, options)
        times = np.unique(np.concatenate([time for time, _ in found.values()]))
        rows = [
            (frame, track, *position)
            for track, (time, state) in found.items()
            for frame, position in zip(np.searchsorted(times, time) + 1, state[:, :3].tolist(), strict=True)
        ]
    else:
        _, times, positions = on_grid(tracks, options)
        rows = [
            (frame + 1, track, *position)
            for track, values in positions.items()
            for frame, position in enumerate(values.tolist())
            if np.isfinite(position).all()
        ]
    with open(target, "w", encoding="utf-8", newline="\n") as stream:
        for frame, track, x, y, z in sorted(rows):
            stream.write(f"{frame},{track},-1,-1,-1,-1,1,{x!r},{y!r},{z!r}\n")
    return [f"frame k is the k-th of {len(times)} reported times: the format holds no times"]


FORMAT = Format("MOTChallenge: detections; 3-D tracks", read=read, write_tracks=write_tracks)
