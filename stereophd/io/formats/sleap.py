"""SLEAP: tracked points of an analysis file (HDF5, ``...analysis.h5``), one file per camera.

Read with h5py (extra ``pose``). The project file (``.slp``) changes with SLEAP's versions; export it as an analysis
file. A camera is named as its file. Points are numbered by track and node: ``track * nodes + node``; `least_score`
leaves out points of a smaller score.

Conventions: (0, 0) is the centre of the top-left pixel. Every frame is in the file; frames without points are empty.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.errors import InputError
from stereophd.io.documents import check_hdf5, expecting, need_package
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.pixels import native_pixels, point_rows

#: Order of the axes where the file names none: as MATLAB reads it.
USUAL_AXES = ("track", "xy", "node", "frame")
WANTED_AXES = ("frame", "track", "node", "xy")
FRAMES_OF_A_PIECE = 20_000


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read the points of an analysis file for each camera."""
    recording = ForeignRecording(files=list(sources))
    for path in sources:
        if path.suffix.lower() == ".slp":
            raise InputError(
                f"{path}: expected an analysis file (sleap-convert, format analysis), found a project (.slp)"
            )
    recording.pieces = _pieces(sources, options, recording)
    return recording


def _pieces(sources: Sequence[Path], options: ImportOptions, recording: ForeignRecording) -> Iterator[Piece]:
    h5py = need_package("h5py", f"{sources[0]}: a file of SLEAP")
    for path in sources:
        stem = path.name.removesuffix(path.suffix).removesuffix(".analysis")
        camera = options.name(stem)
        with expecting("an analysis file of SLEAP (tracks, node_names)", path), h5py.File(path, "r") as file:
            check_hdf5(file, path)
            yield from _file_pieces(path, file, camera, options, recording)


def _file_pieces(
    path: Path, file: Any, camera: str, options: ImportOptions, recording: ForeignRecording
) -> Iterator[Piece]:
    tracks = file["tracks"]
    axes = tuple(json.loads(tracks.attrs["dims"])) if "dims" in tracks.attrs else USUAL_AXES
    axes = tuple("xy" if axis == "xy" else axis.rstrip("s") for axis in axes)
    total = tracks.shape[axes.index("frame")]
    names = [_text(name) for name in file["node_names"]]
    labels = [_text(name) for name in file["track_names"]] if "track_names" in file else []
    for start in range(0, total, FRAMES_OF_A_PIECE):
        frames = np.arange(start, min(start + FRAMES_OF_A_PIECE, total))
        values, scores = _in_order(tracks, axes, frames), None
        count, people, nodes, _ = values.shape
        points = values.reshape(count, people * nodes, 2)
        if "point_scores" in file:
            scores = _in_order(file["point_scores"], tuple(axis for axis in axes if axis != "xy"), frames)
            scores = scores.reshape(count, people * nodes)
        for k in range(people * nodes):
            who = labels[k // nodes] if k // nodes < len(labels) else f"track{k // nodes}"
            recording.labels[k] = f"{who}.{names[k % nodes]}"
        flat = native_pixels(points.reshape(-1, 2), camera, options, recording)
        yield point_rows(path, camera, frames.astype(np.float64), flat.reshape(points.shape), scores)


def _in_order(values: Any, axes: tuple[str, ...], frames: Integers) -> Array:
    """Return successive frames of a dataset with these axes, in the order of `WANTED_AXES`."""
    part = slice(frames[0], frames[-1] + 1)
    read = values[tuple(part if axis == "frame" else slice(None) for axis in axes)]
    return np.asarray(np.transpose(read, [axes.index(axis) for axis in WANTED_AXES if axis in axes]), dtype=np.float64)


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


FORMAT = Format("SLEAP: tracked points (analysis HDF5)", read=read)
