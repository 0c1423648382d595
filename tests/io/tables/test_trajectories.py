"""BodyTrajectory files: Parquet and TUM text hold the same, what is wrong is named, packed poses keep every bit."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.core.geometry.trajectory import COLUMNS, BodyTrajectory
from stereophd.errors import InputError
from stereophd.io.tables.trajectories import MOST_POSES, pack_poses, read_trajectory, unpack_poses

HALF = float(np.sqrt(0.5))
POSES = np.array(
    [[0.0, 1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0], [0.5, 1.5, 2.0, 3.0, HALF, 0.0, HALF, 0.0]]
)  # fmt: skip


def write_table(path: Path, poses: np.ndarray = POSES, unit: str | None = None) -> Path:
    table = pa.table(dict(zip(COLUMNS, poses.T, strict=True)))
    pq.write_table(table.replace_schema_metadata({"length_unit": unit} if unit else {}), path)
    return path


def test_both_forms_hold_the_same(tmp_path: Path) -> None:
    text = tmp_path / "poses.txt"
    lines = ["# timestamp tx ty tz qx qy qz qw", "", "0 1 2 3 0 0 0 1", f"0.5 1.5 2 3 0 {HALF!r} 0 {HALF!r}  # turned"]
    text.write_text("\n".join(lines))
    assert read_trajectory(text) == read_trajectory(write_table(tmp_path / "poses.parquet"))
    np.testing.assert_array_equal(read_trajectory(text).poses, POSES)


def test_packed_poses_keep_every_bit() -> None:
    poses = np.column_stack(
        [np.arange(50.0), np.random.default_rng(1).normal(size=(50, 3)), np.tile(POSES[1, 4:], (50, 1))]
    )
    trajectory = BodyTrajectory(poses)
    assert unpack_poses(pack_poses(trajectory)) == trajectory


@pytest.mark.parametrize("text", ["", "not base64", "AAAA", "eJwDAAAAAAE="])
def test_damaged_poses_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        unpack_poses(text)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0 1 2 3 0 0 0", r"poses.txt:1: expected timestamp tx ty tz qx qy qz qw"),
        ("# none", "expected two or more poses, found 0"),
        ("0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1", "row 1: expected increasing times"),
        ("0 1 2 3 0 0 0 1\n1 1 2 three 0 0 0 1", "poses.txt:2: expected"),
    ],
)
def test_bad_text_is_named(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(content)
    with pytest.raises(InputError, match=message):
        read_trajectory(file)


def test_bad_tables_are_named(tmp_path: Path) -> None:
    file = tmp_path / "poses.parquet"
    pq.write_table(pa.table({"time_s": [0.0]}), file)
    with pytest.raises(InputError, match="missing columns x, y, z"):
        read_trajectory(file)
    with pytest.raises(InputError, match="expected lengths in m, the unit of the cameras, found cm"):
        read_trajectory(write_table(file, unit="cm"), "m")
    many = np.tile(POSES[0], (MOST_POSES + 1, 1))
    with pytest.raises(InputError, match="thin them out"):
        read_trajectory(write_table(file, many))
    with pytest.raises(InputError, match="cannot be read"):
        read_trajectory(tmp_path / "absent.parquet")
