"""DeepLabCut: predicted body parts, one file per camera, as CSV or HDF5.

The CSV has three header lines (scorer, bodyparts, coords) or four (individuals before bodyparts), then a row for each
frame: its number, and x, y, likelihood of every part. The HDF5 file holds the same table as pandas writes it; it is
read with h5py (extra ``pose``). A camera is named as its file, without what DeepLabCut adds (from ``DLC_`` on). Parts
are numbered in the order of the columns; `least_score` leaves out those of a smaller likelihood.

Conventions: pixel (0, 0) is the top-left pixel, taken as its centre. Every frame of the video has a row.
"""

import io
import pickle
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.documents import check_hdf5, expecting, need_package
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.documents.text_tables import first_lines, number_batches
from stereophd.io.interchange.pixels import native_pixels, point_rows

ADDED = re.compile(r"_?DLC_.*$|_?DLC$")
# (individual and body part, coordinate) of a column of values.
Column = tuple[str, str]


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read the body parts of a file for each camera."""
    recording = ForeignRecording(files=list(sources))
    recording.assumed.append("pixel (0, 0) is the centre of the top-left pixel")
    recording.pieces = _pieces(sources, options, recording)
    return recording


def _pieces(sources: Sequence[Path], options: ImportOptions, recording: ForeignRecording) -> Iterator[Piece]:
    parts: list[str] = []
    for path in sources:
        is_hdf = path.suffix.lower() in (".h5", ".hdf5")
        columns, batches = _hdf(path) if is_hdf else _csv(path)
        parts += [part for part in dict.fromkeys(part for part, _ in columns) if part not in parts]
        recording.labels.update(enumerate(parts))
        camera = options.name(ADDED.sub("", path.stem) or path.stem)
        index = {column: k for k, column in enumerate(columns)}
        for frames, values in batches:
            points = np.full((len(frames), len(parts), 2), np.nan)
            scores = np.full((len(frames), len(parts)), np.nan)
            for k, part in enumerate(parts):
                for axis, coordinate in enumerate(("x", "y")):
                    if (part, coordinate) in index:
                        points[:, k, axis] = values[:, index[part, coordinate]]
                if (part, "likelihood") in index:
                    scores[:, k] = values[:, index[part, "likelihood"]]
            flat = native_pixels(points.reshape(-1, 2), camera, options, recording)
            yield point_rows(path, camera, frames, flat.reshape(points.shape), scores)


def _csv(path: Path) -> tuple[list[Column], Iterator[tuple[Array, Array]]]:
    lines = [line.split(",") for line in first_lines(path, 4)]
    heads = {words[0]: words[1:] for words in lines}
    individuals = heads.get("individuals")
    expected = ["scorer", *([] if individuals is None else ["individuals"]), "bodyparts", "coords"]
    if list(heads)[: len(expected)] != expected:
        raise InputError(f"{path}: expected the header lines scorer, bodyparts and coords, found {list(heads)}")
    columns = _named(heads["bodyparts"], heads["coords"], individuals)
    names = ["frame", *(f"{k} ({part} {axis})" for k, (part, axis) in enumerate(columns, start=2))]
    batches = number_batches(path, ",", names, str(path), names, skip=len(expected))
    return columns, ((b["frame"], np.stack([b[name] for name in names[1:]], axis=1)) for b in batches)


def _named(parts: Sequence[str], coordinates: Sequence[str], individuals: Sequence[str] | None) -> list[Column]:
    names = list(parts)
    if individuals is not None:
        names = [f"{who}.{part}" for who, part in zip(individuals, parts, strict=True)]
    return list(zip(names, coordinates, strict=True))


def _hdf(path: Path) -> tuple[list[Column], Iterator[tuple[Array, Array]]]:
    """Return the columns and rows of a table that pandas wrote (format ``table``, one block of numbers)."""
    h5py = need_package("h5py", f"{path}: a file of DeepLabCut in HDF5")
    with expecting("the table of DeepLabCut (df_with_missing)", path), h5py.File(path, "r") as file:
        check_hdf5(file, path)
        group = file["df_with_missing" if "df_with_missing" in file else next(iter(file), "df_with_missing")]
        axes = _unpickled(group.attrs["non_index_axes"])
        rows = group["table"][:]
    keys = [tuple(map(str, key)) for key in axes[0][1]]
    individuals = [key[1] for key in keys] if len(keys[0]) == 4 else None
    columns = _named([key[-2] for key in keys], [key[-1] for key in keys], individuals)
    index = rows["index"]
    if not np.issubdtype(index.dtype, np.number):
        raise InputError(f"{path}: expected frame numbers as index (predictions), found names of images (labels)")
    return columns, iter([(index.astype(np.float64), rows["values_block_0"].astype(np.float64))])


class _PlainUnpickler(pickle.Unpickler):
    """Reads lists, tuples, numbers and text only: a file cannot make it run anything."""

    def find_class(self, module: str, name: str) -> Any:
        raise ValueError(f"expected plain names of columns, found {module}.{name}")


def _unpickled(attribute: Any) -> Any:
    content = attribute if isinstance(attribute, bytes) else bytes(np.asarray(attribute).tobytes())
    return _PlainUnpickler(io.BytesIO(content), encoding="utf-8").load()


FORMAT = Format("DeepLabCut: body parts (CSV, HDF5)", read=read)
