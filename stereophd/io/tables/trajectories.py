"""Known trajectories of bodies that carry cameras: Parquet tables, and the text that a configuration keeps of them."""

import base64
import binascii
import zlib
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.trajectory import COLUMNS, BodyTrajectory
from stereophd.errors import InputError
from stereophd.io.documents import expecting

# Poses become part of the configuration, and so of the metadata of every output.
MOST_POSES = 50_000
# Time and position, then the quaternion with its scalar last.
TUM_ORDER = [0, 1, 2, 3, 7, 4, 5, 6]


def read_trajectory(path: Path | str, unit: str | None = None) -> BodyTrajectory:
    """Read a trajectory: a Parquet table, or text in TUM's form.

    The table has the columns ``time_s, x, y, z, qw, qx, qy, qz`` and may state its own unit of length, which must be
    the one given; the text has ``timestamp tx ty tz qx qy qz qw`` in each line, ``#`` before comments. Raises
    InputError when the file cannot be read, a column is missing, or a pose is not valid; the message names its row.
    """
    file = Path(path)
    with expecting("a trajectory", file), open(file, "rb") as stream:
        table = stream.read(4) == b"PAR1"
    rows = _read_table(file, unit) if table else _read_text(file)
    if len(rows) > MOST_POSES:
        raise InputError(
            f"{file}: expected at most {MOST_POSES} poses, found {len(rows)}: thin them out; poses between them are "
            "interpolated"
        )
    try:
        return BodyTrajectory(rows)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None


def _read_table(file: Path, unit: str | None) -> Array:
    from stereophd.io.outputs.provenance import length_unit
    from stereophd.io.tables.reading import read_table
    from stereophd.io.tables.schemas import FLOAT

    table = read_table(file, dict.fromkeys(COLUMNS, FLOAT), what="trajectory")
    stated = length_unit(table.schema.metadata)
    if unit is not None and stated is not None and stated != unit:
        raise InputError(f"{file}: expected lengths in {unit}, the unit of the cameras, found {stated}")
    return np.column_stack([table.column(name).to_numpy() for name in COLUMNS]).astype(np.float64)


def _read_text(file: Path) -> Array:
    rows = []
    with expecting("a trajectory (Parquet, or TUM text)", file):
        text = file.read_text(encoding="utf-8")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != len(COLUMNS):
            shown = line.strip()[:60]
            raise InputError(f"{file}:{number}: expected timestamp tx ty tz qx qy qz qw, found {shown!r}")
        rows.append(values)
    if len(rows) < 2:
        raise InputError(f"{file}: expected two or more poses, found {len(rows)}")
    return np.array(rows)[:, TUM_ORDER]


def pack_poses(trajectory: BodyTrajectory) -> str:
    """Return the poses of a trajectory as text, to the last bit."""
    return base64.b64encode(zlib.compress(trajectory.poses.astype("<f8").tobytes(), 9)).decode("ascii")


def unpack_poses(text: str) -> BodyTrajectory:
    """Return the trajectory of `pack_poses`; ValueError if the text is damaged, or too long."""
    unpacker = zlib.decompressobj()
    most = MOST_POSES * len(COLUMNS) * 8
    try:
        raw = unpacker.decompress(base64.b64decode(text, validate=True), most + 1)
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"expected the poses of a trajectory as stereophd writes them, found {error}") from None
    if len(raw) > most or len(raw) % (len(COLUMNS) * 8):
        raise ValueError(f"expected whole poses, {MOST_POSES} at most, found {len(raw)} bytes")
    return BodyTrajectory(np.frombuffer(raw, dtype="<f8").reshape(-1, len(COLUMNS)))
