"""Checkpoints hold data, give back what they were given, and never run code."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from stereophd.io.outputs.checkpoints import FORMAT, MARK, is_checkpoint, read_checkpoint, write_checkpoint

from stereophd.errors import InputError


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


@dataclass(frozen=True)
class Unknown:
    x: int


def state(seed: int = 0) -> State:
    rng = np.random.default_rng(seed)
    points = tuple(Point(float(rng.normal()), rng.normal(size=(2, k))) for k in range(3))
    return State(np.asfortranarray(rng.normal(size=(3, 4))), np.arange(5), points, None, "é\ud800")


def assert_same(one: State, other: State) -> None:
    np.testing.assert_array_equal(one.values, other.values)
    assert one.values.flags.f_contiguous == other.values.flags.f_contiguous
    assert one.labels.dtype == other.labels.dtype
    np.testing.assert_array_equal(one.labels, other.labels)
    assert [p.x for p in one.points] == [p.x for p in other.points]
    for p, q in zip(one.points, other.points, strict=True):
        np.testing.assert_array_equal(p.values, q.values)
    assert (one.time_s, one.name) == (other.time_s, other.name)


def test_what_was_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    number = np.float64(1.0) / 3.0
    special = [float("nan"), float("inf"), -0.0, 2**70, True]
    write_checkpoint(path, "me", {"state": state(), "list": [state(1)], "number": number, "special": special})
    assert is_checkpoint(path)
    parts = read_checkpoint(path, "me", [State])
    assert_same(parts["state"], state())
    assert_same(parts["list"][0], state(1))
    assert type(parts["number"]) is np.float64
    assert parts["number"] == number
    assert repr(parts["special"]) == repr(special)
    with pytest.raises(InputError, match="found another's"):
        read_checkpoint(path, "you", [State])


@pytest.mark.parametrize("value", [Unknown, object(), np.array([None]), {1: 2}, {1, 2}, b"x"])
def test_what_is_no_data_cannot_be_written(tmp_path: Path, value: object) -> None:
    with pytest.raises(TypeError, match="a checkpoint cannot hold"):
        write_checkpoint(tmp_path / "checkpoint", "me", {"value": value})


def test_a_class_that_the_reader_does_not_name_is_refused(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "checkpoint", "me", {"value": Unknown(1)})
    with pytest.raises(InputError, match="found something else"):
        read_checkpoint(tmp_path / "checkpoint", "me", [State])


class Bomb:
    """Unpickled, it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.folder),)


def forged(folder: Path) -> dict[str, bytes]:
    """Files that would run code if they were unpickled or trusted."""
    bomb = Bomb(folder / "ran")
    document = {"format": FORMAT, "identity": "me", "parts": {"$class": "os.mkdir", "path": str(folder / "ran")}}
    text = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
    np.savez(folder / "class.npz", **{MARK: text})
    np.savez(folder / "objects.npz", **{MARK: np.array([bomb])})
    np.save(folder / "array.npy", np.array([bomb]), allow_pickle=True)
    return {
        "pickle": pickle.dumps(("me", bomb)),
        "class": (folder / "class.npz").read_bytes(),
        "objects": (folder / "objects.npz").read_bytes(),
        "array": (folder / "array.npy").read_bytes(),
    }


@pytest.mark.parametrize("kind", ["pickle", "class", "objects", "array"])
def test_a_forged_checkpoint_runs_no_code(tmp_path: Path, kind: str) -> None:
    content = forged(tmp_path)[kind]
    (tmp_path / "checkpoint").write_bytes(content)
    with pytest.raises(InputError, match="expected a checkpoint"):
        read_checkpoint(tmp_path / "checkpoint", "me", [State])
    assert not (tmp_path / "ran").exists()


def test_a_damaged_checkpoint_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    write_checkpoint(path, "me", {"state": state()})
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for length in (0, 1, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            read_checkpoint(path, "me", [State])
    for _ in range(100):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        with contextlib.suppress(InputError):
            assert_same(read_checkpoint(path, "me", [State])["state"], state())


def test_a_checkpoint_is_what_numpy_writes(tmp_path: Path) -> None:
    """Arrays of one type lie end to end, also empty ones, of another byte order or in another order of axes."""
    parts = {
        "a": np.arange(6.0).reshape(2, 3).T,
        "b": np.arange(3, dtype=">f8"),
        "c": np.empty((0, 4)),
        "d": np.array([True, False]),
        "e": np.arange(10.0)[::3],
    }
    write_checkpoint(tmp_path / "x.npz", "id", parts)
    with np.load(tmp_path / "x.npz", allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["f8"], [0, 1, 2, 3, 4, 5, 0, 1, 2, 0, 3, 6, 9])
        np.testing.assert_array_equal(archive["b1"], [True, False])
    found = read_checkpoint(tmp_path / "x.npz", "id", [])
    for name, value in parts.items():
        np.testing.assert_array_equal(found[name], value)
        assert found[name].shape == value.shape
