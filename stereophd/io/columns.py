"""Many objects of one class as a few arrays: one column a field, for checkpoints that hold thousands of them.

A column of arrays is their rows end to end, one of objects is columns of its own; fields of numbers, truth values,
text and small mappings go as they are. The objects that come back are equal to those that went in, to the bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import pairwise
from typing import Any

import numpy as np

# Keys of a column: what it is, and what it holds.
_KIND, _VALUES = "kind", "values"


def pack(objects: Sequence[Any]) -> dict[str, Any]:
    """Return the columns of objects of one dataclass or named tuple, for `stereophd.io.checkpoints.write_checkpoint`.

    Raises
    ------
    TypeError
        A field holds what has no column: a fault of the program.
    """
    names = _field_names(type(objects[0])) or ()
    columns = {name: _column([getattr(one, name) for one in objects], name) for name in names}
    return {_KIND: type(objects[0]).__name__, "count": len(objects), _VALUES: columns}


def unpack(packed: Mapping[str, Any], classes: Mapping[str, type]) -> list[Any]:
    """Return the objects of columns.

    Parameters
    ----------
    packed : mapping
        What `pack` returned.
    classes : mapping
        Dataclasses by name (`stereophd.io.checkpoints.reachable_classes`).
    """
    kind, count, columns = classes[packed[_KIND]], int(packed["count"]), packed[_VALUES]
    names = list(columns)
    values = [_values(columns[name], count, classes) for name in names]
    return [kind(**dict(zip(names, row, strict=True))) for row in zip(*values, strict=True)]


def _field_names(kind: type) -> tuple[str, ...] | None:
    """Return the names of the fields of a dataclass or named tuple, None of anything else."""
    if is_dataclass(kind):
        return tuple(field.name for field in fields(kind))
    return getattr(kind, "_fields", None) if issubclass(kind, tuple) else None


def _column(values: list[Any], name: str) -> dict[str, Any]:
    """Return the column of one field."""
    there = [value is not None for value in values]
    if not all(there):
        inner = [value for value in values if value is not None]
        return {_KIND: "some", "there": np.array(there), _VALUES: _column(inner, name) if inner else None}
    kinds = {type(value) for value in values}
    if len(kinds) == 1:
        kind = kinds.pop()
        if kind in (bool, int, float):
            return {_KIND: kind.__name__, _VALUES: np.array(values, dtype=_DTYPES[kind])}
        if issubclass(kind, np.generic) and kind is not np.object_:
            return {_KIND: "scalars", _VALUES: np.array(values, dtype=kind)}
        if kind is str:
            words = sorted(set(values))
            places = {word: place for place, word in enumerate(words)}
            return {_KIND: "text", "words": words, _VALUES: np.array([places[value] for value in values])}
        if kind is np.ndarray and len({(v.dtype, v.ndim, v.shape[1:]) for v in values}) == 1 and values[0].ndim:
            lengths = np.array([len(value) for value in values])
            return {_KIND: "arrays", "lengths": lengths, _VALUES: np.concatenate(values)}
        if kind is tuple:
            items = [item for value in values for item in value]
            lengths = np.array([len(value) for value in values])
            return {_KIND: "tuples", "lengths": lengths, _VALUES: _column(items, name) if items else None}
        if _field_names(kind) is not None:
            return {_KIND: "objects", _VALUES: pack(values)}
    if all(isinstance(value, Mapping) for value in values):
        full = [(place, _pairs(value)) for place, value in enumerate(values) if value]
        return {_KIND: "mappings", _VALUES: [list(pair) for pair in full]}
    raise TypeError(f"no column for the values of {name}")


_DTYPES: dict[type, Any] = {bool: np.bool_, int: np.int64, float: np.float64}


def _pairs(value: Any) -> Any:
    """Return a mapping as lists of pairs: JSON knows text keys only."""
    return [[key, _pairs(item)] for key, item in value.items()] if isinstance(value, Mapping) else value


def _mapping(value: Any) -> Any:
    return {key: _mapping(item) for key, item in value} if isinstance(value, list) else value


def _values(column: Mapping[str, Any], count: int, classes: Mapping[str, type]) -> list[Any]:
    """Return the values of a column."""
    kind, values = column[_KIND], column[_VALUES]
    if kind == "some":
        there = np.asarray(column["there"], dtype=bool)
        inner = iter([] if values is None else _values(values, int(there.sum()), classes))
        return [next(inner) if one else None for one in there.tolist()]
    if kind == "mappings":
        found: list[Any] = [{} for _ in range(count)]
        for place, pairs in values:
            found[place] = _mapping(pairs)
        return found
    return _PLAIN[kind](column, classes)


def _tuples(column: Mapping[str, Any], classes: Mapping[str, type]) -> list[Any]:
    """Return the tuples of a column."""
    ends = np.concatenate([[0], np.cumsum(column["lengths"])]).tolist()
    items = [] if column[_VALUES] is None else _values(column[_VALUES], ends[-1], classes)
    return [tuple(items[start:end]) for start, end in pairwise(ends)]


def _arrays(column: Mapping[str, Any]) -> list[Any]:
    """Return the arrays of a column, as views of one."""
    ends = np.concatenate([[0], np.cumsum(column["lengths"])]).tolist()
    values = column[_VALUES]
    return [values[start:end] for start, end in pairwise(ends)]


_PLAIN: dict[str, Callable[[Mapping[str, Any], Mapping[str, type]], list[Any]]] = {
    **dict.fromkeys(("bool", "int", "float"), lambda column, _: column[_VALUES].tolist()),
    "scalars": lambda column, _: list(column[_VALUES]),
    "text": lambda column, _: [column["words"][place] for place in column[_VALUES].tolist()],
    "arrays": lambda column, _: _arrays(column),
    "tuples": _tuples,
    "objects": lambda column, classes: unpack(column[_VALUES], classes),
}
