"""Checkpoints: the state of an unfinished run as numbers, text and arrays, never as code.

A checkpoint is a NumPy archive without pickles. The arrays of one type lie end to end in one member; the member `MARK`
is a JSON document that holds everything else, with a reference where an array belongs. Objects are rebuilt from the
classes that the reader names (dataclasses and named tuples, and those in their fields): no content of the file is
imported or called.
"""

from __future__ import annotations

import json
import types
import typing
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stereophd.errors import InputError

MARK = "stereophd_checkpoint"
FORMAT = 2

# Kinds of NumPy types that hold plain data: truth values, integers, floats.
_PLAIN_KINDS = "biuf"

# Keys of the JSON document that mark encoded values; no dataclass has a field of such a name.
_ARRAY, _SCALAR, _CLASS, _TUPLE, _MAPPING = "$array", "$scalar", "$class", "$tuple", "$mapping"


def write_checkpoint(path: Path, identity: str, parts: Mapping[str, Any]) -> None:
    """Write a checkpoint.

    Parameters
    ----------
    path
        The file; usually a temporary one of `stereophd.io.outputs.atomic.atomic_write`.
    identity
        Identity of the run: configuration, inputs and version.
    parts
        Name -> numbers, text, None, arrays, sequences, mappings with text keys, dataclasses and named tuples of them.

    Raises
    ------
    TypeError
        A part holds something else: a fault of the program.
    """
    encoder = _Encoder()
    document = {"format": FORMAT, "identity": identity, "parts": encoder.encode(dict(parts))}
    text = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
    with open(path, "wb") as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        _write_member(archive, MARK, [text])
        for name, arrays in encoder.members().items():
            _write_member(archive, name, arrays)


def _write_member(archive: zipfile.ZipFile, name: str, arrays: list[NDArray[Any]]) -> None:
    """Write flat arrays of one type, end to end, as one array, in the format of `numpy.savez`.

    `numpy.savez` takes one array and copies it twice more, which takes as long as to collect what it holds.
    """
    header = {
        "descr": np.lib.format.dtype_to_descr(arrays[0].dtype),
        "fortran_order": False,
        "shape": (sum(array.size for array in arrays),),
    }
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, header)
        for array in arrays:
            if array.size:
                member.write(array.view(np.uint8).data)


def is_checkpoint(path: Path) -> bool:
    """Whether a file is a checkpoint of this program, of any version."""
    try:
        with zipfile.ZipFile(path) as archive:
            return f"{MARK}.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def read_checkpoint(path: Path, identity: str, classes: Iterable[type]) -> dict[str, Any]:
    """Read a checkpoint.

    Parameters
    ----------
    path
        The file.
    identity
        The identity with which it must have been written.
    classes
        Dataclasses and named tuples that the parts may hold; those in their fields are found by their annotations.

    Returns
    -------
    dict
        The parts.

    Raises
    ------
    InputError
        The file is missing, damaged, not a checkpoint, or one of another run.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            document = json.loads(bytes(archive[MARK]))
            if not isinstance(document, dict) or document.get("format") != FORMAT:
                raise InputError(f"{path}: expected a checkpoint of this version, found another format")
            if document["identity"] != identity:
                raise InputError(f"{path}: expected a checkpoint of this configuration and log, found another's")
            members = {name: archive[name] for name in archive.files if name != MARK}
        parts = _Decoder(members, reachable_classes(classes)).decode(document["parts"])
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"expected a checkpoint {path}, found none") from None
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        EOFError,
        RecursionError,
        zipfile.BadZipFile,
    ) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected a checkpoint of this version, found something else ({reason})") from error
    if not isinstance(parts, dict):
        raise InputError(f"{path}: expected a checkpoint of this version, found one without parts")
    return parts


def _is_named_tuple(kind: type) -> bool:
    return issubclass(kind, tuple) and hasattr(kind, "_fields")


def reachable_classes(classes: Iterable[type]) -> dict[str, type]:
    """Return dataclasses and named tuples, and those in the annotations of their fields, by name."""
    found: dict[str, type] = {}
    waiting = list(classes)
    while waiting:
        kind = waiting.pop()
        if isinstance(kind, type) and not isinstance(kind, types.GenericAlias):
            if (is_dataclass(kind) or _is_named_tuple(kind)) and kind.__name__ not in found:
                found[kind.__name__] = kind
                waiting += typing.get_type_hints(kind).values()
        else:
            waiting += [one for one in typing.get_args(kind) if not isinstance(one, (str, int))]
    return found


class _Encoder:
    """Turns objects into a JSON document and flat arrays, one for each NumPy type."""

    def __init__(self) -> None:
        self._arrays: dict[str, list[NDArray[Any]]] = {}
        self._sizes: dict[str, int] = {}

    def members(self) -> dict[str, list[NDArray[Any]]]:
        """Return the flat arrays, contiguous and of native byte order, by the name of their type."""
        return self._arrays

    def encode(self, value: Any) -> Any:
        """Return the JSON value of an object."""
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, np.generic):
            return {_SCALAR: self._array(np.asarray(value))}
        if isinstance(value, np.ndarray):
            return {_ARRAY: self._array(value)}
        if is_dataclass(value) and not isinstance(value, type):
            values = {field.name: self.encode(getattr(value, field.name)) for field in fields(value)}
            return {_CLASS: type(value).__name__, **values}
        if isinstance(value, tuple) and _is_named_tuple(type(value)):
            return {_CLASS: type(value).__name__, **{k: self.encode(v) for k, v in value._asdict().items()}}  # type: ignore[attr-defined]
        if isinstance(value, tuple):
            return {_TUPLE: [self.encode(item) for item in value]}
        if isinstance(value, list):
            return [self.encode(item) for item in value]
        if isinstance(value, Mapping) and all(type(key) is str for key in value):
            return {_MAPPING: {key: self.encode(item) for key, item in value.items()}}
        raise TypeError(f"a checkpoint cannot hold a {type(value).__name__}")

    def _array(self, array: NDArray[Any]) -> list[Any]:
        if array.dtype.kind not in _PLAIN_KINDS:
            raise TypeError(f"a checkpoint cannot hold an array of {array.dtype}")
        if not array.dtype.isnative:
            array = array.astype(array.dtype.newbyteorder("="))
        name = array.dtype.str.lstrip("<>|=")
        order: Literal["C", "F"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        start = self._sizes.get(name, 0)
        self._sizes[name] = start + array.size
        self._arrays.setdefault(name, []).append(array.ravel(order=order))
        return [name, start, list(array.shape), order]


class _Decoder:
    """Turns what `_Encoder` made back into objects of the classes given, and of no others."""

    def __init__(self, members: Mapping[str, NDArray[Any]], classes: Mapping[str, type]) -> None:
        self._members = members
        self._classes = classes

    def decode(self, value: Any) -> Any:
        """Return the object of a JSON value."""
        if isinstance(value, list):
            return [self.decode(item) for item in value]
        if not isinstance(value, dict):
            return value
        if _ARRAY in value:
            return self._array(*value[_ARRAY])
        if _SCALAR in value:
            return self._array(*value[_SCALAR])[()]
        if _TUPLE in value:
            return tuple(self.decode(item) for item in value[_TUPLE])
        if _MAPPING in value:
            return {key: self.decode(item) for key, item in value[_MAPPING].items()}
        rest = dict(value)
        kind = self._classes[rest.pop(_CLASS)]
        return kind(**{key: self.decode(item) for key, item in rest.items()})

    def _array(self, name: str, start: int, shape: list[int], order: str) -> NDArray[Any]:
        flat = self._members[name]
        size = int(np.prod(shape, dtype=np.int64))
        if not 0 <= start <= start + size <= len(flat):
            raise ValueError("an array lies outside the file")
        # A copy of its own, aligned as any other array.
        return np.array(flat[start : start + size].reshape(shape, order=order), order=order)  # type: ignore[call-overload, no-any-return]
