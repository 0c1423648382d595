"""Files of unfinished runs hold data, give back what they were given, and never run code."""

from __future__ import annotations

import os
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from stereophd.errors import InputError
from stereophd.io.outputs import saved
from stereophd.io.outputs.saved import (
    MARK,
    KeptParts,
    decoder,
    encode,
    is_saved,
    read_saved,
    write_saved,
)


class Point(NamedTuple):
    x: float
    values: NDArray[np.float64]


@dataclass(frozen=True)
class State:
    values: NDArray[np.float64]
    labels: NDArray[np.int64]
    points: tuple[Point, ...]
    time_s: float | None
    name: str
    counts: dict[int, dict[str, int]]


class Model:
    """What the reader knows anyway."""


@dataclass(frozen=True)
class WithModel:
    number: int
    model: Model


def state(seed: int = 0) -> State:
    rng = np.random.default_rng(seed)
    points = tuple(Point(float(rng.normal()), rng.normal(size=(2, k))) for k in range(3))
    values = np.asfortranarray(rng.normal(size=(3, 4)))
    return State(values, np.arange(5), points, None, "é", {-1: {"left": 2}})


def assert_same(one: State, other: State) -> None:
    np.testing.assert_array_equal(one.values, other.values)
    assert one.values.flags.f_contiguous == other.values.flags.f_contiguous
    assert one.labels.dtype == other.labels.dtype
    np.testing.assert_array_equal(one.labels, other.labels)
    assert [p.x for p in one.points] == [p.x for p in other.points]
    for p, q in zip(one.points, other.points, strict=True):
        np.testing.assert_array_equal(p.values, q.values)
    assert (one.time_s, one.name, one.counts) == (other.time_s, other.name, other.counts)


def test_what_was_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "state.saved"
    write_saved(path, "me", [state(), state(1)])
    assert is_saved(path)
    for one, other in zip(read_saved(path, "me", decoder(list[State])), (state(), state(1)), strict=True):
        assert_same(one, other)
        assert one.labels.flags.writeable
    with pytest.raises(InputError, match="found another's"):
        read_saved(path, "you", decoder(list[State]))


def test_numbers_come_back_to_the_bit() -> None:
    special = [float("nan"), float("inf"), -0.0, 0.1, 5e-324]
    assert repr(decoder(list[float])(encode(special))) == repr(special)
    assert repr(decoder(list[float])(encode([np.float64(0.1), np.float32(0.5)]))) == "[0.1, 0.5]"
    for array in (
        np.arange(6.0).reshape(2, 3).T,
        np.empty((0, 4)),
        np.array([True, False]),
        np.arange(10.0)[::3],
        np.array(1.5),
        np.arange(3, dtype=np.uint8),
    ):
        back = decoder(NDArray[Any])(encode(array))
        assert (back.dtype, back.shape, back.tobytes()) == (array.dtype, array.shape, array.tobytes())


@pytest.mark.parametrize("value", [object(), np.array([None]), np.array(["a"]), np.arange(3, dtype=">f8"), Model()])
def test_what_is_no_data_cannot_be_written(value: object) -> None:
    with pytest.raises(TypeError, match="cannot keep"):
        encode(value)


def test_what_the_reader_knows_is_not_read() -> None:
    model = Model()
    content = encode({"number": 1, "model": {"anything": 2}})
    found = decoder(WithModel, {Model: model})(content)
    assert found == WithModel(1, model)
    with pytest.raises(ValueError, match="Model"):
        decoder(WithModel)(content)


class Bomb:
    """Unpickled, it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("kind", ["pickle", "objects", "type", "another class"])
def test_a_forged_file_runs_no_code(tmp_path: Path, kind: str) -> None:
    bomb = Bomb(tmp_path / "ran")
    path = tmp_path / "state.saved"
    values = ("O", (1,), False, pickle.dumps(bomb)) if kind == "objects" else ("d", (1,), False, b"x" * 8)
    document = {"values": values, "labels": ("l", (-1,), False, b""), "$class": "os.mkdir"}
    if kind == "pickle":
        path.write_bytes(pickle.dumps(bomb))
    else:
        write_saved(path, "me", [] if kind == "type" else document)
    with pytest.raises(InputError, match="expected"):
        read_saved(path, "me", decoder(State))
    assert not (tmp_path / "ran").exists()


def test_a_damaged_file_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "state.saved"
    write_saved(path, "me", state())
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for length in (0, 1, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            read_saved(path, "me", decoder(State))
    for _ in range(100):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        with pytest.raises(InputError):
            read_saved(path, "me", decoder(State))


def test_a_link_is_no_file_of_a_run(tmp_path: Path) -> None:
    write_saved(tmp_path / "other", "me", 1)
    (tmp_path / "state.saved").symlink_to(tmp_path / "other")
    assert not is_saved(tmp_path / "state.saved")
    with pytest.raises(InputError, match="found something else"):
        read_saved(tmp_path / "state.saved", "me", decoder(int))


@pytest.mark.parametrize("part_bytes", [1, 8_000_000])
def test_parts_count_as_far_as_they_are_said_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part_bytes: int
) -> None:
    monkeypatch.setattr(saved, "PART_BYTES", part_bytes)
    parts = KeptParts(tmp_path / "rows", "me")
    assert not list(parts)
    parts.append(b"one")
    count = parts.flush()
    parts.append(b"two")
    assert parts.flush() == count + 1
    assert list(KeptParts(tmp_path / "rows", "me", count)) == [b"one"]
    assert list(KeptParts(tmp_path / "rows", "me", count + 1)) == [b"one", b"two"]
    more = KeptParts(tmp_path / "rows", "me", count)
    more.append(b"three")
    more.append(b"four")
    after = more.flush()
    assert list(KeptParts(tmp_path / "rows", "me", after)) == [b"one", b"three", b"four"]
    with pytest.raises(InputError, match="found none"):
        list(KeptParts(tmp_path / "rows", "me", after + 1))
    with pytest.raises(InputError, match="found another's"):
        list(KeptParts(tmp_path / "rows", "you", after))


def test_a_copy_of_a_part_by_a_hard_link_stays_whole(tmp_path: Path) -> None:
    parts = KeptParts(tmp_path / "rows", "me")
    parts.append(b"one")
    parts.flush()
    (path,) = tmp_path.iterdir()
    os.link(path, tmp_path / "copy")
    before = (tmp_path / "copy").read_bytes()
    more = KeptParts(tmp_path / "rows", "me")
    more.append(b"two")
    more.flush()
    assert path.read_bytes() != before
    assert (tmp_path / "copy").read_bytes() == before


def test_a_file_that_ends_early_or_is_not_encoded_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "state.saved"
    for content in (b"", bytes(3), msgspec.msgpack.encode(1)):
        path.write_bytes(MARK + b"me\n" + content)
        with pytest.raises(InputError, match="damaged or cut off"):
            read_saved(path, "me", decoder(int))
    path.write_bytes(MARK + b"me\n" + bytes(4))  # the checksum of nothing
    with pytest.raises(InputError, match="found something else"):
        read_saved(path, "me", decoder(int))
