"""Parquet tables: what is written comes back, byte by byte the same; what is bad is refused clearly."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereophd.errors import InputError
from stereophd.io.logs.rows import decode
from stereophd.io.tables import writing
from stereophd.io.tables.reading import read_table
from stereophd.io.tables.schemas import COVARIANCE, DETECTIONS, SCANS, TRACKS, TRUTH
from stereophd.io.tables.writing import TableWriter

POSITIONS = {"time_s": pa.float64(), "object_id": pa.int64(), "x": pa.float64()}


@pytest.fixture(scope="module", autouse=True)
def small_row_groups() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "ROW_GROUP_ROWS", 10)
        yield


def track_columns(n: int, start: int = 0) -> dict[str, Any]:
    index = np.arange(start, start + n)
    numbers = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), index * 0.5)
    covariance = np.eye(6) + index[:, None, None]
    return {
        "time_s": 2.5,
        "camera": "left",
        "frame": 7,
        "track_id": index,
        **numbers,
        "covariance": covariance,
        "existence": [0.5] * n,
        "status": ["confirmed"] * n,
    }


def test_tracks_come_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "tracks.parquet"
    with TableWriter(path, TRACKS, {b"stereophd": b"{}"}) as writer:
        writer.append(track_columns(3))
    table = pq.read_table(path)
    assert table.schema.equals(TRACKS)
    assert table.schema.metadata == {b"stereophd": b"{}"}
    assert table["time_s"].to_pylist() == [2.5] * 3
    assert table["camera"].to_pylist() == ["left"] * 3
    assert table["vx"].to_pylist() == [0.0, 0.5, 1.0]
    found = np.array(table["covariance"].to_pylist()).reshape(3, 6, 6)
    np.testing.assert_array_equal(found, np.eye(6) + np.arange(3)[:, None, None])


@given(st.lists(st.integers(0, 25), min_size=1, max_size=8))
def test_bytes_do_not_depend_on_how_rows_are_handed_over(tmp_path_factory: Any, sizes: list[int]) -> None:
    folder = tmp_path_factory.mktemp("bytes")
    with TableWriter(folder / "pieces.parquet", TRACKS) as writer:
        start = 0
        for size in sizes:
            writer.append(track_columns(size, start))
            start += size
    with TableWriter(folder / "whole.parquet", TRACKS) as writer:
        writer.append(track_columns(sum(sizes)))
    assert (folder / "pieces.parquet").read_bytes() == (folder / "whole.parquet").read_bytes()
    groups = pq.ParquetFile(folder / "whole.parquet").metadata
    assert groups.num_rows == sum(sizes)
    assert groups.num_row_groups == -(-sum(sizes) // 10)


@pytest.mark.parametrize(
    ("u", "expected"),
    [
        (None, [None, None]),
        ([1.5, None], [1.5, None]),
        (np.ma.masked_array([1.5, 2.5], [True, False]), [None, 2.5]),
        (np.array([1.5, 2.5]), [1.5, 2.5]),
        (3, [3.0, 3.0]),
    ],
)
def test_nulls_and_scalars(tmp_path: Path, u: Any, expected: list[float | None]) -> None:
    with TableWriter(tmp_path / "log.parquet", DETECTIONS) as writer:
        writer.append({"time_s": [0.0, 1.0], "camera": ["a", "b"], "frame": np.array([0, 1]), "u_px": u, "v_px": u})
    assert pq.read_table(tmp_path / "log.parquet")["u_px"].to_pylist() == expected


def test_rows_are_written_as_they_come(tmp_path: Path) -> None:
    with TableWriter(tmp_path / "t.parquet", TRACKS) as writer:
        for size in (4, 25, 1, 10):
            writer.append(track_columns(size))
            assert writer._buffered < 10
            assert sum(rows for _, rows in writer._buffer) == writer._buffered
        assert writer.rows == 40


def test_a_table_without_rows_has_its_columns(tmp_path: Path) -> None:
    TableWriter(tmp_path / "scans.parquet", SCANS).close()
    assert pq.read_table(tmp_path / "scans.parquet").schema.equals(SCANS)


@pytest.mark.parametrize(
    "change",
    [
        lambda columns: columns.pop("x"),
        lambda columns: columns.update(extra=1.0),
        lambda columns: columns.update(x=np.zeros(2)),
    ],
)
def test_wrong_columns_are_refused(tmp_path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    columns = track_columns(3)
    change(columns)
    with TableWriter(tmp_path / "t.parquet", TRACKS) as writer, pytest.raises(ValueError, match="expected"):
        writer.append(columns)


def test_null_in_a_column_that_has_none_is_refused(tmp_path: Path) -> None:
    writer = TableWriter(tmp_path / "t.parquet", TRUTH)
    columns: dict[str, Any] = dict.fromkeys(TRUTH.names, 0)
    writer.append({**columns, "x": [None]})
    with pytest.raises((pa.ArrowInvalid, ValueError)):
        writer.close()


def test_a_full_disk_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = TableWriter(tmp_path / "t.parquet", TRACKS)
    writer.append(track_columns(3))

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(writer._writer, "write_table", full)
    with pytest.raises(OSError, match="No space left") as caught:
        writer.close()
    assert caught.value.errno == errno.ENOSPC
    assert caught.value.filename == str(tmp_path / "t.parquet")


def write(path: Path, columns: dict[str, pa.Array]) -> Path:
    pq.write_table(pa.table(columns), path)
    return path


def test_read_widens_numbers_and_texts_and_keeps_metadata(tmp_path: Path) -> None:
    table = pa.table(
        {
            "other": pa.array([0, 0]),
            "time_s": pa.array([1, 2], pa.int32()),
            "x": pa.array([0.5, 1.5], pa.float32()),
            "camera": pa.array(["a", "b"]).dictionary_encode(),
            "object_id": pa.array([3, 4], pa.uint8()),
        }
    ).replace_schema_metadata({b"length_unit": b"cm"})
    pq.write_table(table, tmp_path / "t.parquet")
    found = read_table(tmp_path / "t.parquet", {**POSITIONS, "camera": pa.string()}, {"vx": pa.float64()})
    assert found.schema.names == ["time_s", "object_id", "x", "camera"]
    assert [str(field.type) for field in found.schema] == ["double", "int64", "double", "string"]
    assert found.schema.metadata[b"length_unit"] == b"cm"
    assert found["x"].to_pylist() == [0.5, 1.5]


def test_read_gives_the_optional_columns_that_are_there(tmp_path: Path) -> None:
    path = write(tmp_path / "t.parquet", {"x": pa.array([1.0]), "vy": pa.array([None], pa.float64())})
    found = read_table(path, {"x": pa.float64()}, {"vx": pa.float64(), "vy": pa.float64()})
    assert found.to_pydict() == {"x": [1.0], "vy": [None]}


def good_bytes(path: Path) -> bytes:
    n = 5000
    rng = np.random.default_rng(1)
    columns = {
        "time_s": pa.array(rng.random(n)),
        "object_id": pa.array(range(n)),
        "x": pa.array(rng.random(n)),
    }
    return write(path, columns).read_bytes()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: b"", "found an empty file"),
        (lambda content: b"time_s,x\n1,2\n", "found a CSV table"),
        (lambda content: b"time_s", "found something that is not Parquet"),
        (lambda content: content[: len(content) // 2], "truncated or damaged"),
        (lambda content: content[:-1], "truncated or damaged"),
        (
            lambda content: content[:4] + b"\xff" * (len(content) // 2) + content[4 + len(content) // 2 :],
            "damaged",
        ),
    ],
)
def test_files_that_are_not_whole_parquet(tmp_path: Path, damage: Callable[[bytes], bytes], message: str) -> None:
    path = tmp_path / "t.parquet"
    path.write_bytes(damage(good_bytes(path)))
    with pytest.raises(InputError, match=message) as caught:
        read_table(path, POSITIONS)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_file_that_is_not_there_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_table(tmp_path / "t.parquet", POSITIONS)
    with pytest.raises(InputError, match="found a folder"):
        read_table(tmp_path, POSITIONS)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": pa.array([1.0])}, r"missing columns time_s, object_id; expected .*, found x"),
        (
            {"time_s": pa.array(["1"]), "object_id": pa.array([1]), "x": pa.array([1.0])},
            "column time_s: expected type double, found string",
        ),
        (
            {"time_s": pa.array([1.0]), "object_id": pa.array([1.5]), "x": pa.array([1.0])},
            "column object_id: expected type int64, found double",
        ),
        (
            {"time_s": pa.array([1.0]), "object_id": pa.array([1]), "x": pa.array([True])},
            "column x: expected type double, found bool",
        ),
        (
            {"time_s": pa.array([1.0, None]), "object_id": pa.array([1, 1]), "x": pa.array([1.0, 1.0])},
            "row 1: column time_s: expected a value, found null",
        ),
        (
            {"time_s": pa.array([1.0]), "object_id": pa.array([2**63], pa.uint64()), "x": pa.array([1.0])},
            "9223372036854775808",
        ),
    ],
)
def test_wrong_tables_are_refused(tmp_path: Path, columns: dict[str, pa.Array], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_table(write(tmp_path / "t.parquet", columns), POSITIONS)


def test_covariances_of_another_size_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "t.parquet", {"covariance": pa.array([[1.0] * 9], pa.list_(pa.float64(), 9))})
    with pytest.raises(InputError, match="column covariance: expected type"):
        read_table(path, {"covariance": COVARIANCE})


def not_utf8(texts: list[bytes]) -> pa.Array:
    """Return a column of strings as another program may write it."""
    array = pa.array(texts, pa.binary())
    return pa.Array.from_buffers(pa.string(), len(array), array.buffers())


def test_text_that_is_not_utf8_is_named(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    pq.write_table(pa.table({"camera": not_utf8([b"left", b"right", b"\xed\xa0\x80"])}), path)
    with pytest.raises(InputError, match=r"row 2: column camera: expected text in UTF-8, found b'\\xed\\xa0\\x80'"):
        read_table(path, {"camera": pa.string()})
    rows = {"time_s": [0.0, 0.0], "frame": [0, 0], "u_px": [1.0, 1.0], "v_px": [1.0, 1.0]}
    batch = pa.record_batch({**rows, "camera": not_utf8([b"left", b"\xff"])})
    with pytest.raises(InputError, match=r"log.parquet: row 8: column camera: expected text in UTF-8, found b'\\xff'"):
        decode(batch, 7, {"left": 0}, "log.parquet")
