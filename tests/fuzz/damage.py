"""Damage to a valid file: to its bytes, its text, or what its format holds, so that a reader gets to it."""

from __future__ import annotations

import gzip
import io
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from hypothesis import strategies as st

ODD_NUMBERS = [
    "nan", "inf", "-inf", "0", "-0", "-1", "1", "3.5", "1e300", "-1e300", "1e-300", "1e999", "2147483648", "-5",
    "9223372036854775808", "1e15", "", "x", "null", "[]", "{}", "~", "0x10", "1_0", "1,5", "true", '"a"', "\x00", "é",
]  # fmt: skip
ODD_VALUES: list[Any] = [
    None, True, 0, -1, 1, 3.5, -0.0, 1e300, -1e300, 1e-300, 1.8e308, float("nan"), float("inf"), 2**63, 10**30, 1e15,
    "", "x", "left", "../x", "\x00", "=1+1", "a" * 1000, [], {}, [None], [1, 2, 3], {"a": {}},
]  # fmt: skip
# Ten times as fast, where PyYAML has its C library.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]+")


@dataclass(frozen=True)
class Harm:
    """One change of a file: of what kind, two places as shares of the file, and a number that chooses a value."""

    kind: str
    first: float
    second: float
    choice: int


def harmed(path: Path, content: bytes, harm: Harm) -> bytes:
    """Return the content after a change; one that the format does not know is a change of bytes."""
    try:
        return KINDS[harm.kind](path, content, harm)
    except Exception:  # what one format says of a file of another
        return _bytes(path, content, harm)


def _place(share: float, length: int) -> int:
    return min(int(share * length), max(length - 1, 0))


def _bytes(_: Path, content: bytes, harm: Harm) -> bytes:
    """Set, remove, repeat or insert some bytes, or cut the file off."""
    at, length = _place(harm.first, len(content)), 1 + int(harm.second * 40)
    value = bytes([harm.choice % 256])
    return (
        content[:at] + value + content[at + 1 :],
        content[:at] + content[at + length :],
        content[: at + length] + content[at:],
        content[:at] + value * length + content[at:],
        content[:at],
    )[harm.choice % 5]


def _number(_: Path, content: bytes, harm: Harm) -> bytes:
    """Replace a number of a text."""
    found = list(_NUMBER.finditer(content))
    match = found[_place(harm.first, len(found))]
    value = ODD_NUMBERS[harm.choice % len(ODD_NUMBERS)].encode()
    return content[: match.start()] + value + content[match.end() :]


def _word(_: Path, content: bytes, harm: Harm) -> bytes:
    """Replace a word of a text by another one of it."""
    found = list(_WORD.finditer(content))
    match, other = found[_place(harm.first, len(found))], found[_place(harm.second, len(found))]
    return content[: match.start()] + other[0] + content[match.end() :]


def _line(_: Path, content: bytes, harm: Harm) -> bytes:
    """Remove a line, repeat it, move it, empty it, or add a field to it."""
    lines = content.split(b"\n")
    at, other = _place(harm.first, len(lines)), _place(harm.second, len(lines))
    line = lines[at]
    changed = ([], [line, line], [lines[other]], [b""], [line + b",1"], [line.rsplit(b",", 1)[0]])[harm.choice % 6]
    return b"\n".join([*lines[:at], *changed, *lines[at + 1 :]])


def _leaf(path: Path, content: bytes, harm: Harm) -> bytes:
    """Replace, remove or rename a value of a JSON or YAML document."""
    is_json = path.suffix in (".json", ".jsonl")
    lines = content.splitlines()
    line = _place(harm.second, len(lines)) if path.suffix == ".jsonl" else None
    text = content if line is None else lines[line]
    document = json.loads(text) if is_json else yaml.load(text, _LOADER)
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            places.append((node, key))
            walk(node[key])

    walk(document)
    node, key = places[_place(harm.first, len(places))]
    way = harm.choice % 5
    if way == 0:
        del node[key]
    elif way == 1 and isinstance(node, dict):
        node[str(ODD_VALUES[harm.choice % len(ODD_VALUES)])] = node.pop(key)
    elif way == 2:
        other = places[_place(harm.second, len(places))]
        node[key] = json.loads(json.dumps(other[0][other[1]], default=str))
    else:
        node[key] = ODD_VALUES[harm.choice % len(ODD_VALUES)]
    written = (json.dumps(document) if is_json else yaml.dump(document, Dumper=_DUMPER)).encode(errors="replace")
    return written if line is None else b"\n".join([*lines[:line], written, *lines[line + 1 :]])


def _table(_: Path, content: bytes, harm: Harm) -> bytes:
    """Change a cell, a column or the rows of a Parquet table; its metadata stay."""
    table = pq.read_table(io.BytesIO(content))
    k, way = _place(harm.first, table.num_columns), harm.choice % 9
    field, column = table.schema.field(k), table.column(k)
    if way <= 2:
        values = column.to_pylist()
        values[_place(harm.second, len(values))] = ODD_VALUES[(harm.choice // 9) % len(ODD_VALUES)]
        try:
            table = table.set_column(k, field.with_nullable(True), pa.array(values, field.type))
        except (pa.ArrowException, OverflowError):
            table = table.set_column(k, field.name, pa.array([str(value) for value in values]))
    elif way == 3:
        table = table.remove_column(k)
    elif way == 4:
        table = table.set_column(k, field.with_nullable(True), pa.nulls(len(table), field.type))
    elif way == 5:
        table = table.set_column(k, field.name, column.cast(pa.string()))
    elif way == 6:
        table = table.take(np.sort(np.random.default_rng(harm.choice).integers(0, max(len(table), 1), len(table))))
    elif way == 7:
        table = table.take(np.arange(len(table))[::-1])
    else:
        table = table.slice(0, int(harm.second * 3))
    target = io.BytesIO()
    pq.write_table(table, target)
    return target.getvalue()


def _metadata(path: Path, content: bytes, harm: Harm) -> bytes:
    """Change the JSON that a Parquet table carries."""
    table = pq.read_table(io.BytesIO(content))
    metadata = dict(table.schema.metadata or {})
    key = sorted(metadata)[_place(harm.first, len(metadata))]
    inside = Harm(("leaf", "bytes", "number")[harm.choice % 3], harm.second, harm.first, harm.choice)
    metadata[key] = harmed(path.with_suffix(".json"), metadata[key], inside)
    target = io.BytesIO()
    pq.write_table(table.replace_schema_metadata(metadata), target)
    return target.getvalue()


def _member(_: Path, content: bytes, harm: Harm) -> bytes:
    """Change a member of an archive, unpacked, or leave it out."""
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(target, "w") as out:
        names = archive.namelist()
        chosen = names[_place(harm.first, len(names))]
        for name in names:
            text = archive.read(name)
            if name == chosen and harm.choice % 10 == 0:
                continue
            if name == chosen:
                inside = Harm(
                    ("bytes", "number", "line", "word")[harm.choice % 4], harm.second, harm.first, harm.choice
                )
                packed = name.endswith(".gz")
                text = harmed(Path(name), gzip.decompress(text) if packed else text, inside)
                text = gzip.compress(text) if packed else text
            out.writestr(name, text)
    return target.getvalue()


def _dataset(_: Path, content: bytes, harm: Harm) -> bytes:
    """Change, reshape or remove a dataset or an attribute of an HDF5 file."""
    import h5py

    stream = io.BytesIO(content)
    with h5py.File(stream, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = names[_place(harm.first, len(names))]
        item, way = file[name], harm.choice % 5
        attributes = sorted(item.attrs)
        if attributes and way == 0:
            item.attrs[attributes[0]] = str(ODD_VALUES[harm.choice % len(ODD_VALUES)]).replace("\x00", "")
        elif way == 1 or not hasattr(item, "shape"):
            del file[name]
        else:
            values = item[()]
            del file[name]
            if way == 2:
                values = values[..., : int(harm.second * 3)] if values.ndim else values
            elif way == 3:
                values = values.ravel() if values.ndim > 1 else values[:, None]
            else:
                values = np.array(values)
                values.flat[_place(harm.second, values.size)] = 1e300 if values.dtype.kind == "f" else values.flat[0]
            file[name] = values
    return stream.getvalue()


KINDS: dict[str, Callable[[Path, bytes, Harm], bytes]] = {
    "bytes": _bytes, "number": _number, "word": _word, "line": _line, "leaf": _leaf, "table": _table,
    "metadata": _metadata, "member": _member, "dataset": _dataset,
}  # fmt: skip

# What may become of a file, by the end of its name; else what becomes of a text.
BY_SUFFIX = {
    ".parquet": ("table", "table", "table", "metadata", "bytes"),
    ".json": ("leaf", "leaf", "number", "word", "bytes"),
    ".jsonl": ("leaf", "leaf", "line", "number", "bytes"),
    ".yaml": ("leaf", "leaf", "number", "word", "line", "bytes"),
    ".yml": ("number", "word", "line", "bytes"),
    ".h5": ("dataset", "dataset", "bytes"),
    ".npz": ("member", "member", "bytes"),
    ".braidz": ("member", "member", "bytes"),
}
OF_TEXT = ("number", "number", "word", "line", "bytes")


# Places in a file as shares of it. (Floats that hypothesis draws are tiny, 0 or 1 too often: always the same place.)
SHARES = st.integers(0, 9999).map(lambda count: count / 10000)


def harms(suffix: str) -> st.SearchStrategy[list[Harm]]:
    """Return one change of a file, seldom more."""
    kinds = st.sampled_from(BY_SUFFIX.get(suffix, OF_TEXT))
    one = st.builds(Harm, kinds, SHARES, SHARES, st.integers(0, 10**6))
    return st.lists(one, min_size=1, max_size=3)
