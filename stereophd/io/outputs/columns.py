"""Many objects of one class as a few arrays: one column a field, for checkpoints that hold thousands of them.

A column of arrays is their rows end to end, one of objects is columns of its own. Numbers, truth values, text and
counts (number -> text -> count) have columns too. The objects that come back are equal to those that went in, to the
bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import chain, pairwise
from operator import attrgetter, methodcaller
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Keys of a column: what it is, and what it holds.
_KIND, _VALUES = "kind", "values"


def pack(objects: Sequence[Any], leave_out: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Return the columns of objects of one dataclass or named tuple, for `io.outputs.checkpoints.write_checkpoint`.

    Fields of the names `leave_out`, of the objects and of those in them, come back as None.

    Raises
    ------
    TypeError
        A field holds what has no column: a fault of the program.
    """
    names = _field_names(type(objects[0])) or ()
    columns = {
        name: _nothing(len(objects))
        if name in leave_out
        else _column(list(map(attrgetter(name), objects)), name, leave_out)
        for name in names
    }
    return {_KIND: type(objects[0]).__name__, "count": len(objects), _VALUES: columns}


def unpack(packed: Mapping[str, Any], classes: Mapping[str, type]) -> list[Any]:
    """Return the objects of columns.

    Parameters
    ----------
    packed : mapping
        What `pack` returned.
    classes : mapping
        Dataclasses by name (`stereophd.io.outputs.checkpoints.reachable_classes`).
    """
    kind, count, columns = classes[packed[_KIND]], int(packed["count"]), packed[_VALUES]
    names = list(columns)
    values = [_values(columns[name], count, classes) for name in names]
    return [kind(**dict(zip(names, row, strict=True))) for row in zip(*values, strict=True)]


def pack_counts(counts: Mapping[int, Mapping[str, int]]) -> dict[str, Any]:
    """Return counts (number -> text -> count) as columns; `unpack_counts` returns them."""
    return _counts([counts])


def unpack_counts(packed: Mapping[str, Any]) -> dict[int, dict[str, int]]:
    """Return the counts of columns."""
    return dict(_values(packed, 1, {})[0])


def _field_names(kind: type) -> tuple[str, ...] | None:
    """Return the names of the fields of a dataclass or named tuple, None of anything else."""
    if is_dataclass(kind):
        return tuple(field.name for field in fields(kind))
    return getattr(kind, "_fields", None) if issubclass(kind, tuple) else None


def _column(values: Sequence[Any], name: str, leave_out: frozenset[str]) -> dict[str, Any]:
    """Return the column of one field; thousands of values a second pass here, so that loops are those of built-ins."""
    kinds = set(map(type, values))
    if type(None) in kinds:
        inner = [value for value in values if value is not None]
        if not inner:
            return _nothing(len(values))
        there = np.array([value is not None for value in values])
        return {_KIND: "some", "there": there, _VALUES: _column(inner, name, leave_out)}
    if len(kinds) == 1:
        kind = next(iter(kinds))
        if kind in _DTYPES:
            return {_KIND: kind.__name__, _VALUES: np.array(values, dtype=_DTYPES[kind])}
        if issubclass(kind, np.generic) and kind is not np.object_:
            return {_KIND: "scalars", _VALUES: np.array(values, dtype=kind)}
        if kind is str:
            words = sorted(set(values))
            places = {word: place for place, word in enumerate(words)}
            return {_KIND: "text", "words": words, _VALUES: np.array([places[value] for value in values])}
        if kind is np.ndarray and values[0].ndim and _one_dtype(values):
            return {_KIND: "arrays", "lengths": _lengths(values), _VALUES: np.concatenate(values)}
        if kind is tuple:
            items = list(chain.from_iterable(values))
            column = _column(items, name, leave_out) if items else None
            return {_KIND: "tuples", "lengths": _lengths(values), _VALUES: column}
        if _field_names(kind) is not None:
            return {_KIND: "objects", _VALUES: pack(values, leave_out)}
    if all(issubclass(kind, Mapping) for kind in kinds):
        return _counts(values)
    raise TypeError(f"no column for the values of {name}")


def _nothing(count: int) -> dict[str, Any]:
    """Return the column of so many None."""
    return {_KIND: "some", "there": np.zeros(count, dtype=np.bool_), _VALUES: None}


def _one_dtype(arrays: Sequence[NDArray[Any]]) -> bool:
    """Whether all arrays have one type; most often it is one object, and objects are compared sooner than types."""
    dtypes = list(map(attrgetter("dtype"), arrays))
    return len(set(map(id, dtypes))) == 1 or len(set(dtypes)) == 1


def _lengths(values: Sequence[Any]) -> NDArray[np.int64]:
    return np.fromiter(map(len, values), dtype=np.int64, count=len(values))


def _counts(values: Sequence[Mapping[int, Mapping[str, int]]]) -> dict[str, Any]:
    """Return the column of mappings number -> text -> count."""
    inner = list(chain.from_iterable(map(methodcaller("values"), values)))
    sizes = _lengths(inner)
    texts = list(chain.from_iterable(inner))
    words = sorted(set(texts))
    codes = {word: code for code, word in enumerate(words)}
    table = np.empty((4, len(texts)), dtype=np.int64)
    table[0] = np.repeat(np.repeat(np.arange(len(values)), _lengths(values)), sizes)
    table[1] = np.repeat(np.fromiter(chain.from_iterable(values), dtype=np.int64, count=len(inner)), sizes)
    table[2] = np.fromiter(map(codes.__getitem__, texts), dtype=np.int64, count=len(texts))
    numbers = chain.from_iterable(map(methodcaller("values"), inner))
    table[3] = np.fromiter(numbers, dtype=np.int64, count=len(texts))
    return {_KIND: "counts", "words": words, _VALUES: table}


_DTYPES: dict[type, Any] = {bool: np.bool_, int: np.int64, float: np.float64}


def _values(column: Mapping[str, Any], count: int, classes: Mapping[str, type]) -> list[Any]:
    """Return the values of a column."""
    kind, values = column[_KIND], column[_VALUES]
    if kind == "some":
        there = np.asarray(column["there"], dtype=bool)
        inner = iter([] if values is None else _values(values, int(there.sum()), classes))
        return [next(inner) if one else None for one in there.tolist()]
    if kind == "counts":
        found: list[dict[int, dict[str, int]]] = [{} for _ in range(count)]
        for place, key, code, number in values.T.tolist():
            found[place].setdefault(key, {})[column["words"][code]] = number
        return list(found)
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
