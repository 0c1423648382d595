"""Detection logs: frames in order of true time, whatever the pieces in which the file is read."""

from __future__ import annotations

import logging
import os
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import stereophd.io.logs.reading as logs
from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError
from stereophd.io.logs.checks import KINDS
from stereophd.io.logs.reading import Frame, LogReader
from stereophd.io.logs.rows import LogWriter, decode
from stereophd.pipeline.inspection.log import summarise_log

from .conftest import TYPES, make_camera, row

CLOCKS = {"left": (0.25, 1.0), "right": (-3.0, 1.5), "top": (0.0, 0.5)}


def plain(frame: Frame) -> tuple[Any, ...]:
    return frame.time_s, frame.camera, frame.frame, frame.pixels.tolist()


@st.composite
def log_rows(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Draw a valid log: times on a coarse grid so that frames coincide, rows of a time in any order."""
    rows = []
    for name in CLOCKS:
        steps = draw(st.lists(st.integers(1, 3), max_size=6))
        for frame, time in enumerate(np.cumsum([0, *steps]) * 0.5):
            count = draw(st.integers(0, 4))
            pixels = draw(
                st.lists(
                    st.tuples(st.integers(0, 639), st.integers(0, 479)),
                    min_size=count,
                    max_size=count,
                    unique=True,
                )
            )
            rows += [row(float(time), name, frame * 2, float(u), float(v)) for u, v in pixels]
            rows += [] if pixels else [row(float(time), name, frame * 2)]
    shuffled = draw(st.permutations(rows))
    return sorted(shuffled, key=lambda r: float(r["time_s"]))


def expected_frames(rows: list[dict[str, Any]], cameras: list[Camera]) -> list[tuple[Any, ...]]:
    """Group the rows in plain Python: the oracle."""
    names = [camera.name for camera in cameras]
    groups: dict[tuple[float, int, int], list[list[float]]] = defaultdict(list)
    for r in rows:
        clock = cameras[names.index(r["camera"])].clock
        key = (clock.offset_s + clock.rate * r["time_s"], names.index(r["camera"]), r["frame"])
        groups[key] += [] if r["u_px"] is None else [[r["u_px"], r["v_px"]]]
    return [(*key, groups[key]) for key in sorted(groups)]


@pytest.mark.parametrize("exact_clocks", [True, False])
@given(rows=log_rows(), piece=st.integers(1, 9), group=st.integers(1, 9))
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_frames_agree_with_plain_grouping(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    exact_clocks: bool,
    rows: list[dict[str, Any]],
    piece: int,
    group: int,
) -> None:
    monkeypatch.setattr(logs, "ROW_GROUP_ROWS", piece)
    table = pa.table({key: pa.array([r[key] for r in rows], TYPES[key]) for key in rows[0]})
    pq.write_table(table, tmp_path / "log.parquet", row_group_size=group)
    cameras = [make_camera(name, *((0.0, 1.0) if exact_clocks else clock)) for name, clock in CLOCKS.items()]
    reader = LogReader(tmp_path / "log.parquet", cameras)
    frames = [plain(frame) for frame in reader]
    assert frames == expected_frames(rows, cameras)
    assert reader.counts["rows"] == len(rows)
    assert reader.counts["frames"] == len(frames)
    assert reader.counts["detections"] == sum(r["u_px"] is not None for r in rows)
    assert not any(reader.counts[kind] for kind in KINDS)


def test_sigma_and_object_id_stay_with_their_detections(cameras: list[Camera], write_rows: Callable[..., Path]) -> None:
    rows = [
        row(0.0, "right", 0, 5.0, 6.0, sigma_u_px=0.5, sigma_v_px=0.6, object_id=4),
        row(0.0, "left", 0, None, None, sigma_u_px=None, sigma_v_px=None, object_id=None),
        row(0.0, "right", 0, 1.0, 2.0, sigma_u_px=0.1, sigma_v_px=0.2, object_id=-1),
    ]
    left, right = LogReader(write_rows(rows), cameras)
    assert left.pixels.shape == (0, 2)
    assert left.sigma is not None
    assert left.sigma.shape == (0, 2)
    assert left.object_id is not None
    assert left.object_id.shape == (0,)
    assert right.pixels.tolist() == [[5.0, 6.0], [1.0, 2.0]]
    assert right.sigma is not None
    assert right.sigma.tolist() == [[0.5, 0.6], [0.1, 0.2]]
    assert right.object_id is not None
    assert right.object_id.tolist() == [4, -1]


def test_two_frames_of_a_camera_at_one_time_come_in_order_of_number(
    cameras: list[Camera], write_rows: Callable[..., Path]
) -> None:
    rows = [row(0.0, "left", 1, 1.0, 1.0), row(0.0, "left", 0, 2.0, 2.0), row(0.0, "left", 1, 3.0, 3.0)]
    frames = list(LogReader(write_rows(rows), cameras))
    assert [(f.frame, f.pixels[:, 0].tolist()) for f in frames] == [(0, [2.0]), (1, [1.0, 3.0])]


def test_detections_within_the_margin_are_kept(cameras: list[Camera], write_rows: Callable[..., Path]) -> None:
    edges = [(-10.5, 0.0), (649.5, 0.0), (0.0, -10.5), (0.0, 489.5)]
    path = write_rows([row(0.0, "left", 0, u, v) for u, v in edges])
    (frame,) = LogReader(path, cameras, image_margin_px=10.0)
    assert len(frame.pixels) == 4
    with pytest.raises(InputError, match="640 x 480 px image"):
        list(LogReader(path, cameras, image_margin_px=9.9))


def test_other_types_of_columns_are_read(cameras: list[Camera], write_rows: Callable[..., Path]) -> None:
    types = {
        "time_s": pa.int32(),
        "camera": pa.dictionary(pa.int8(), pa.large_string()),
        "frame": pa.uint16(),
        "u_px": pa.float32(),
        "v_px": pa.int64(),
    }
    (frame,) = LogReader(write_rows([row(3, "right", 9, 1.5, 2)], types), cameras)
    assert plain(frame) == (3.0, 1, 9, [[1.5, 2.0]])


def test_columns_as_pandas_writes_them_are_read(cameras: list[Camera], write_rows: Callable[..., Path]) -> None:
    rows = [row(0.0, "left", 0, 1.0, 1.0, object_id=2.0), row(0.0, "right", 0, 1.0, 1.0, object_id=None)]
    left, right = LogReader(write_rows(rows, {"object_id": pa.float64()}), cameras)
    assert (left.object_id.tolist(), right.object_id.tolist()) == ([2], [-1])
    path = write_rows([row(0.0, "left", 0, None, None)], {"u_px": pa.null(), "v_px": pa.null()})
    (frame,) = LogReader(path, cameras)
    assert plain(frame) == (0.0, 0, 0, [])


@pytest.mark.parametrize(
    ("name", "values", "kind", "message"),
    [
        ("time_s", [1, 1_700_000_000_000_000_001], pa.int64(), "seconds as float64, found 17.*01 .nanoseconds"),
        ("frame", [1, 2**63 + 5], pa.uint64(), "a whole number of type int64, found 9223372036854775813"),
        ("object_id", [1.0, 1.5], pa.float64(), "a whole number of type int64, found 1.5"),
    ],
)
def test_a_value_that_does_not_fit_its_type_is_named(
    cameras: list[Camera], write_rows: Callable[..., Path], name: str, values: list[Any], kind: Any, message: str
) -> None:
    rows = [{**row(float(k), "left", k, 1.0, 1.0), name: value} for k, value in enumerate(values)]
    path = write_rows(rows, {name: kind})
    for read in (lambda: list(LogReader(path, cameras)), lambda: summarise_log(path)):
        with pytest.raises(InputError, match=f"row 1: column {name}: expected {message}"):
            read()


def test_a_log_without_cameras_has_no_summary(write_rows: Callable[..., Path]) -> None:
    with pytest.raises(InputError, match="expected rows with a camera and a finite time, found none in 1 rows"):
        summarise_log(write_rows([row(0.0, None, 0, 1.0, 1.0)]))


def test_cameras_that_never_appear_are_counted(cameras: list[Camera], write_rows: Callable[..., Path]) -> None:
    reader = LogReader(write_rows([row(0.0, "left", 0, 1.0, 1.0)]), cameras)
    list(reader)
    assert reader.counts["cameras_without_frames"] == 1


def test_a_second_iteration_is_like_the_first(cameras: list[Camera], write_rows: Callable[..., Path]) -> None:
    reader = LogReader(write_rows([row(0.0, "left", 0, 1.0, 1.0), row(1.0, "left", 1)]), cameras)
    first, counts = [plain(f) for f in reader], reader.counts
    assert [plain(f) for f in reader] == first
    assert reader.counts == counts


GOOD = [
    row(0.0, "left", 0, 1.0, 1.0, sigma_u_px=1.0, sigma_v_px=1.0),
    row(0.0, "right", 0, 2.0, 2.0, sigma_u_px=1.0, sigma_v_px=1.0),
    row(1.0, "left", 1, 3.0, 3.0, sigma_u_px=1.0, sigma_v_px=1.0),
    row(1.0, "left", 1, 4.0, 4.0, sigma_u_px=1.0, sigma_v_px=1.0),
    row(1.0, "right", 1, None, None, sigma_u_px=None, sigma_v_px=None),
    row(2.0, "left", 2, 5.0, 5.0, sigma_u_px=1.0, sigma_v_px=1.0),
]


def bad(*values: Any, sigma: float | None = 1.0) -> dict[str, Any]:
    return row(*values, sigma_u_px=sigma, sigma_v_px=1.0)


# position at which the row goes in, the row, its kind, what the message says
BAD_ROWS = [
    pytest.param(2, bad(None, "left", 1, 9.0, 9.0), "null_value", "expected time_s, camera and frame", id="null-time"),
    pytest.param(2, bad(1.0, None, 1, 9.0, 9.0), "null_value", "found null", id="null-camera"),
    pytest.param(2, bad(1.0, "left", None, 9.0, 9.0), "null_value", "found null", id="null-frame"),
    pytest.param(2, bad(np.nan, "left", 1, 9.0, 9.0), "non_finite", "time_s: expected a finite", id="nan-time"),
    pytest.param(2, bad(np.inf, "left", 1, 9.0, 9.0), "non_finite", "time_s: expected a finite", id="inf-time"),
    pytest.param(
        2, bad(1.0, "lfet", 1, 9.0, 9.0), "unknown_camera", "found lfet; did you mean left", id="unknown-camera"
    ),
    pytest.param(2, bad(1.0, "left", 1, None, 9.0), "half_null", "found one null", id="null-u"),
    pytest.param(2, bad(1.0, "left", 1, 9.0, None), "half_null", "found one null", id="null-v"),
    pytest.param(2, bad(1.0, "left", 1, np.nan, 9.0), "non_finite", "found nan, 9.0", id="nan-u"),
    pytest.param(2, bad(1.0, "left", 1, 9.0, -np.inf), "non_finite", "found 9.0, -inf", id="inf-v"),
    pytest.param(2, bad(1.0, "left", 1, np.nan, np.nan), "non_finite", "found nan, nan", id="nan-both"),
    pytest.param(2, bad(1.0, "left", 1, 700.0, 9.0), "outside_image", "found 700, 9", id="outside-right"),
    pytest.param(2, bad(1.0, "left", 1, 9.0, -11.0), "outside_image", "found 9, -11", id="outside-top"),
    pytest.param(2, bad(1.0, "left", 1, 9.0, 9.0, sigma=0.0), "invalid_sigma", "numbers from 1e-06", id="sigma-zero"),
    pytest.param(
        2,
        bad(1.0, "left", 1, 9.0, 9.0, sigma=-1.0),
        "invalid_sigma",
        "numbers from 1e-06",
        id="sigma-negative",
    ),
    pytest.param(2, bad(1.0, "left", 1, 9.0, 9.0, sigma=1e200), "invalid_sigma", "found 1e.200", id="sigma-huge"),
    pytest.param(2, bad(1.0, "left", 1, 9.0, 9.0, sigma=1e-300), "invalid_sigma", "found 1e-300", id="sigma-tiny"),
    pytest.param(
        2, bad(1e308, "left", 1, 9.0, 9.0), "time_out_of_range", "expected a number between -1e", id="time-huge"
    ),
    pytest.param(2, bad(1.0, "left", 1, 9.0, 9.0, sigma=np.nan), "invalid_sigma", "found nan", id="sigma-nan"),
    pytest.param(2, bad(1.0, "left", 1, 9.0, 9.0, sigma=None), "invalid_sigma", "found nan", id="sigma-null"),
    pytest.param(5, bad(0.5, "right", 1, 9.0, 9.0), "time_backwards", r"found 0\.5 after 1", id="time-backwards"),
    pytest.param(5, bad(0.0, "left", 0, 9.0, 9.0), "time_backwards", "found 0 after 1", id="time-back-to-frame"),
    pytest.param(6, bad(3.0, "left", 1, 9.0, 9.0), "frame_out_of_order", "found 1 after 2", id="frame-backwards"),
    pytest.param(6, bad(3.0, "left", 2, 9.0, 9.0), "frame_out_of_order", "frame 2 at two", id="frame-at-two-times"),
    pytest.param(4, bad(1.0, "left", 1, 3.0, 3.0), "duplicate_row", "a duplicate row", id="duplicate"),
    pytest.param(4, bad(1.0, "left", 1, None, None), "duplicate_row", "one row, found others", id="null-beside"),
    pytest.param(5, bad(1.0, "right", 1, None, None), "duplicate_row", "one row, found others", id="two-null-rows"),
]


@pytest.mark.parametrize(("piece", "offset"), [(1, 0.0), (2, 0.125), (3, 0.0), (100, 0.125)])
@pytest.mark.parametrize(("position", "bad_row", "kind", "message"), BAD_ROWS)
class TestBadRow:
    """One bad row in a good log: an error that names it, or dropped and counted."""

    @pytest.fixture
    def path(self, position: int, bad_row: dict[str, Any], write_rows: Callable[..., Path]) -> Path:
        return write_rows([*GOOD[:position], bad_row, *GOOD[position:]])

    @pytest.fixture(autouse=True)
    def _piece(self, piece: int, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(logs, "ROW_GROUP_ROWS", piece)

    def test_is_an_error(
        self, path: Path, position: int, kind: str, message: str, offset: float, write_rows: Any
    ) -> None:
        cameras = [make_camera("left"), make_camera("right", offset)]
        with pytest.raises(InputError, match=message) as caught:
            list(LogReader(path, cameras, "error"))
        assert str(caught.value).startswith(f"{path}: row {position}: ")

    def test_is_dropped(
        self, path: Path, kind: str, message: str, offset: float, write_rows: Callable[..., Path]
    ) -> None:
        cameras = [make_camera("left"), make_camera("right", offset)]
        reader = LogReader(path, cameras, "drop")
        clean = LogReader(write_rows(GOOD, name="clean.parquet"), cameras, "error")
        assert [plain(f) for f in reader] == [plain(f) for f in clean]
        assert reader.counts == {**clean.counts, "rows": clean.counts["rows"] + 1, kind: 1}


@pytest.mark.parametrize("piece", [1, 3, 100])
@pytest.mark.parametrize("offset", [0.0, 0.125])
def test_rows_in_blocks_of_cameras_are_merged(
    piece: int, offset: float, write_rows: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    """A table put together from one of each camera is read as the same rows in order of time, without a word."""
    monkeypatch.setattr(logs, "ROW_GROUP_ROWS", piece)
    monkeypatch.setattr("stereophd.io.logs.order.PIECE_ROWS", piece)
    monkeypatch.setattr(logging.getLogger("stereophd"), "propagate", True)
    caplog.set_level(logging.INFO, "stereophd")
    cameras = [make_camera("left"), make_camera("right", offset)]
    blocks = sorted(GOOD, key=lambda r: str(r["camera"]), reverse=True)
    in_order = LogReader(write_rows(GOOD, name="ordered.parquet"), cameras)
    expected = [plain(f) for f in in_order]
    assert not caplog.records
    for mode in ("error", "drop"):
        reader = LogReader(write_rows(blocks), cameras, mode)  # type: ignore[arg-type]
        assert [plain(f) for f in reader] == expected
        assert reader.counts == in_order.counts
        assert not caplog.records


def test_a_block_that_is_not_in_order_is_an_error(write_rows: Callable[..., Path]) -> None:
    blocks = [row(1.0, "right", 0, 1.0, 1.0), row(0.0, "left", 1, 1.0, 1.0), row(-1.0, "left", 2, 1.0, 1.0)]
    reader = LogReader(write_rows(blocks), [make_camera("left"), make_camera("right")])
    with pytest.raises(InputError, match="found 0 before -1; the longest order leaves out 1 rows"):
        list(reader)


@given(st.data())
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_row_is_accounted_for(tmp_path: Path, data: st.DataObject) -> None:
    value = st.sampled_from([None, np.nan, np.inf, 1.0, 2.0, 900.0])
    rows = data.draw(
        st.lists(
            st.builds(
                row,
                st.sampled_from([0.0, 1.0, 2.0, None, np.nan]),
                st.sampled_from(["left", "right", "other", None]),
                st.sampled_from([0, 1, 2, None]),
                value,
                value,
            ),
            min_size=1,
            max_size=30,
        )
    )
    rows.append(row(9.0, "left", 9))
    pq.write_table(pa.table({k: pa.array([r[k] for r in rows], TYPES[k]) for k in rows[0]}), tmp_path / "log.parquet")
    reader = LogReader(
        tmp_path / "log.parquet",
        [make_camera("left", data.draw(st.sampled_from([0.0, 0.5]))), make_camera("right")],
        "drop",
    )
    frames = list(reader)
    counts = reader.counts
    assert counts["rows"] == len(rows)
    assert counts["detections"] + counts["empty_frames"] + sum(counts[kind] for kind in KINDS) == len(rows)
    assert [f.time_s for f in frames] == sorted(f.time_s for f in frames)
    last: dict[int, int] = {}
    for frame in frames:
        assert frame.frame > last.get(frame.camera, -1)
        last[frame.camera] = frame.frame


def test_a_slice_of_rows_decodes_like_the_rows_themselves() -> None:
    rows = [*GOOD, row(3.0, None, None, np.nan, None, sigma_u_px=1.0, sigma_v_px=None)] * 3
    batch = pa.record_batch({key: pa.array([r[key] for r in rows], TYPES[key]) for key in rows[0]})
    cameras = {"left": 0, "right": 1}
    part = decode(batch.slice(5, 11), 5, cameras)
    whole = decode(batch, 0, cameras)
    for name in ("row", "time_s", "camera", "frame", "pixels", "empty", "sigma"):
        np.testing.assert_array_equal(getattr(part.rows, name), getattr(whole.rows, name)[5:16], name)
    np.testing.assert_array_equal(part.nulls, [r["camera"] is None for r in rows[5:16]])
    np.testing.assert_array_equal(part.half, [(r["u_px"] is None) != (r["v_px"] is None) for r in rows[5:16]])
    np.testing.assert_array_equal(part.rows.empty, [r["u_px"] is None and r["v_px"] is None for r in rows[5:16]])
    assert part.names.to_pylist() == [r["camera"] for r in rows[5:16]]


def test_a_log_of_bad_rows_only_is_an_error(cameras: list[Camera], write_rows: Callable[..., Path]) -> None:
    path = write_rows([row(0.0, "other", 0, 1.0, 1.0)])
    with pytest.raises(InputError, match="all 1 rows are bad"):
        list(LogReader(path, cameras, "drop"))


@pytest.mark.parametrize("on_bad_row", ["error", "drop"])
class TestBadLog:
    """What is wrong with the whole file is an error at once, also under `drop`."""

    def check(self, path: Path, on_bad_row: Any, message: str) -> None:
        with pytest.raises(InputError, match=message) as caught:
            LogReader(path, [make_camera("left")], on_bad_row)
        assert str(caught.value).startswith(f"{path}: ")

    @pytest.mark.parametrize("name", ["time_s", "camera", "frame", "u_px", "v_px"])
    def test_missing_column(self, write_rows: Callable[..., Path], on_bad_row: str, name: str) -> None:
        rows = [{key: value for key, value in GOOD[0].items() if key != name}]
        self.check(write_rows(rows), on_bad_row, f"missing column {name}")

    def test_one_sigma(self, write_rows: Callable[..., Path], on_bad_row: str) -> None:
        self.check(write_rows([row(0.0, "left", 0, 1.0, 1.0, sigma_u_px=1.0)]), on_bad_row, "both of the columns")

    @pytest.mark.parametrize(
        ("name", "value", "kind"),
        [
            ("time_s", "0", pa.string()),
            ("camera", 1, pa.int64()),
            ("frame", 0.0, pa.float64()),
            ("u_px", True, pa.bool_()),
            ("v_px", 1, pa.timestamp("s")),
        ],
    )
    def test_wrong_type(
        self, write_rows: Callable[..., Path], on_bad_row: str, name: str, value: Any, kind: pa.DataType
    ) -> None:
        path = write_rows([{**GOOD[0], name: value}], {name: kind})
        self.check(path, on_bad_row, f"column {name}: expected type")

    def test_no_rows(self, write_rows: Callable[..., Path], on_bad_row: str) -> None:
        self.check(write_rows([]), on_bad_row, "without rows")

    def test_not_there(self, tmp_path: Path, on_bad_row: str) -> None:
        self.check(tmp_path / "log.parquet", on_bad_row, "no such file; expected a detection log")

    def test_truncated(self, write_rows: Callable[..., Path], on_bad_row: str) -> None:
        path = write_rows(GOOD)
        os.truncate(path, path.stat().st_size - 20)
        self.check(path, on_bad_row, "truncated or damaged")


def test_writer_and_reader_agree(tmp_path: Path, cameras: list[Camera]) -> None:
    pixels = np.array([[1.5, 2.5], [3.5, 4.5]])
    with LogWriter(tmp_path / "log.parquet", {b"length_unit": b"cm"}, ["object_id"]) as writer:
        writer.write(0.0, "left", 0, pixels, {"object_id": np.array([3, -1])})
        writer.write(0.0, "right", 0, np.empty((0, 2)))
        writer.write(1.0, "left", 1, np.array([[1.0, 1.0], [2.0, 2.0]]), {"object_id": np.array([5, 5])})
    reader = LogReader(tmp_path / "log.parquet", cameras)
    frames = list(reader)
    assert [plain(f) for f in frames] == [
        (0.0, 0, 0, pixels.tolist()),
        (0.0, 1, 0, []),
        (1.0, 0, 1, [[1.0, 1.0], [2.0, 2.0]]),
    ]
    assert [f.object_id.tolist() for f in frames if f.object_id is not None] == [[3, -1], [], [5, 5]]
    assert reader.metadata[b"length_unit"] == b"cm"
    assert reader.num_rows == 5


@pytest.mark.parametrize(("head", "offset", "words"), [(3, 300.0, "found 300 before"), (3, -300.0, None)])
def test_a_few_rows_with_other_times_are_the_wrong_ones(
    write_rows: Callable[..., Path], head: int, offset: float, words: str | None
) -> None:
    """The longest order is kept: rows at the head whose times are minutes too late go, not all that follow."""
    rows = [row(k / 10.0 + (offset if k < head else 0.0), "left", k, 1.0 + k, 1.0) for k in range(60)]
    path, cameras = write_rows(rows), [make_camera("left")]
    reader = LogReader(path, cameras, "drop")
    frames = [frame.frame for frame in reader]
    assert frames == list(range(head if words else 0, 60))
    assert reader.counts["time_backwards"] == (head if words else 0)
    if words:
        with pytest.raises(InputError, match=f"row 0: time_s: .*{words} 0.3; the longest order leaves out 3 rows"):
            list(LogReader(path, cameras))


def test_a_few_rows_out_of_order_in_a_log_by_camera(write_rows: Callable[..., Path]) -> None:
    blocks = [row(k / 10.0, name, k, 1.0 + k, 1.0) for name in ("left", "right") for k in range(30)]
    blocks[40] = row(9.0, "right", 10, 11.0, 1.0)
    reader = LogReader(write_rows(blocks), [make_camera("left"), make_camera("right")], "drop")
    assert len(list(reader)) == 59
    assert reader.order.by_camera
    assert reader.order.misplaced.tolist() == [40]


def test_places_are_left_out_and_their_frames_stay(write_rows: Callable[..., Path]) -> None:
    rows = [row(k / 10.0, "left", k, u, 5.0) for k in range(3) for u in (7.3, 20.0 + k)]
    path, cameras = write_rows(rows), [make_camera("left")]
    frames = list(LogReader(path, cameras, leave_out={"left": [(7.0, 5.0, 1.0), (20.0, 5.0, 0.5)]}))
    assert [frame.pixels[:, 0].tolist() for frame in frames] == [[], [21.0], [22.0]]
    with pytest.raises(InputError, match=r"input\.leave_out"):
        LogReader(path, cameras, leave_out={"lefd": []})
