"""YAML read with the place of every key, and overrides: nodes are kept, so that an error can name its line.

Scalars follow the YAML 1.2 core schema (``1e-6`` is a number, ``yes`` and ``2020-01-01`` are text),
keys are taken as written, and a key that occurs twice is an error.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import yaml

from stereophd.errors import InputError, unknown_camera
from stereophd.io.documents import MAX_DOCUMENT_BYTES, SAFE_LOADER, compose_yaml
from stereophd.io.file_kinds import CONFIGURATION, CSV, HDF5, HEAD_BYTES, PARQUET, kind_of_content, remedy
from stereophd.io.outputs.commit import refuse_unsettled

KeyPath = tuple[str | int, ...]

# Longer integers are refused by Python itself, and mean nothing here.
MAX_DIGITS = 100
# A longer value is shortened in messages.
MAX_SHOWN = 60

_TAG = "tag:yaml.org,2002:"


class _CoreLoader(SAFE_LOADER):  # type: ignore[misc]
    """SafeLoader with the scalars of the YAML 1.2 core schema."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, Any]]] = {}  # noqa: RUF012 (PyYAML's own design)


for _tag, _pattern, _first in (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", r"~|null|Null|NULL", "~nN"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("merge", r"<<", "<"),
):
    _CoreLoader.add_implicit_resolver(_TAG + _tag, re.compile(f"^(?:{_pattern})$"), list(_first))
# PyYAML looks an empty value up under the empty string.
_CoreLoader.add_implicit_resolver(_TAG + "null", re.compile("^$"), [""])


def _integer(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError
    return int(text, 0) if text[:2] in ("0x", "0o") else int(text)


def _text(text: str) -> str:
    """Refuse what no file name and no UTF-8 file can hold."""
    if "\0" in text or any("\ud800" <= character <= "\udfff" for character in text):
        raise ValueError
    return text


_SCALARS: dict[str, Callable[[str], Any]] = {
    "str": _text,
    "bool": lambda text: text.lower() == "true",
    "null": lambda text: None,
    "int": _integer,
    "float": lambda text: float(text.lower().replace(".inf", "inf").replace(".nan", "nan")),
}


_EXPECTED = {
    "str": "text of Unicode characters, without NUL",
    "bool": "true or false",
    "null": "null",
    "int": f"an integer of at most {MAX_DIGITS} digits",
    "float": "a number",
}


def shortened(text: str) -> str:
    """Return a text in quotes, cut where it is long, with what cannot be printed escaped."""
    shown = ascii(text[: MAX_SHOWN + 1])
    return shown if len(text) <= MAX_SHOWN else f"{shown[:MAX_SHOWN]}... ({len(text)} characters)"


@dataclass(frozen=True)
class Place:
    """Where a value was written: a file and a line (from 1), or an option of the command line."""

    source: str
    line: int | None = None

    def __str__(self) -> str:
        return self.source if self.line is None else f"{self.source}:{self.line}"


@dataclass
class Tree:
    """Plain data (dicts, lists, scalars), and the place of every key path in it."""

    data: Any
    places: dict[KeyPath, Place] = field(default_factory=dict)

    def place(self, path: KeyPath) -> Place:
        """Return the place of a key path, or of the nearest one above it."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.places:
                return self.places[path[:length]]
        raise KeyError(path)

    def graft(self, path: KeyPath, other: Self, key: KeyPath = ()) -> None:
        """Put the value at `key` of another tree at `path` of this one, with its places.

        Raises `TypeError` where the value above `path` is not a mapping or a list.
        """
        value = other.data
        for part in key:
            value = value[part]
        container = self.data
        exact: list[str | int] = []
        for part in path[:-1]:
            if isinstance(container, dict) and container.get(str(part)) is None:
                # A mapping that only this change makes: a fault in it is the change's fault.
                container[str(part)] = {}
                self.places[(*exact, str(part))] = other.place(())
            exact.append(_key(container, part))
            container = container[exact[-1]]
        exact.append(_key(container, path[-1]))
        container[exact[-1]] = value
        path = tuple(exact)
        for old in [old for old in self.places if old[: len(path)] == path]:
            del self.places[old]
        for old, place in other.places.items():
            if old[: len(key)] == key:
                self.places[path + old[len(key) :]] = place


def _key(container: Any, part: str | int) -> str | int:
    """Return the key that a part of a path means: a number may be an index, or the name of a camera."""
    if isinstance(container, dict):
        return str(part)
    if isinstance(container, list) and isinstance(part, int) and part < len(container):
        return part
    raise TypeError(part)


class _Builder:
    """Turns YAML nodes into a `Tree`."""

    def __init__(self, source: str, numbered: bool) -> None:
        self._source = source
        self._numbered = numbered
        self.places: dict[KeyPath, Place] = {}

    def _place(self, node: yaml.Node) -> Place:
        return Place(self._source, node.start_mark.line + 1 if self._numbered else None)

    def build(self, node: yaml.Node, path: KeyPath, key: yaml.Node | None = None) -> Any:
        # The place of a value is that of its key; the value of an alias would be elsewhere.
        self.places[path] = self._place(key or node)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self.build(item, (*path, i)) for i, item in enumerate(node.value)]
        return self._scalar(node)

    def _scalar(self, node: yaml.Node) -> Any:
        kind = node.tag.removeprefix(_TAG)
        convert = _SCALARS.get(kind)
        if convert is None:
            raise InputError(f"{self._place(node)}: expected plain YAML values, found the tag {node.tag}")
        try:
            return convert(node.value)
        except ValueError:
            raise InputError(
                f"{self._place(node)}: expected {_EXPECTED[kind]}, found {shortened(node.value)}"
            ) from None

    def _mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, Any]:
        result: dict[str, Any] = {}
        seen: dict[str, int] = {}
        merged: list[yaml.Node] = []
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise InputError(f"{self._place(key)}: expected a plain key, found a list or mapping as key")
            if key.tag == _TAG + "merge":
                merged += value.value if isinstance(value, yaml.SequenceNode) else [value]
                continue
            name = str(key.value)
            if name != key.value.encode("utf-8", "replace").decode() or "\0" in name:
                raise InputError(f"{self._place(key)}: expected {_EXPECTED['str']} as key, found {shortened(name)}")
            if name in seen:
                where = ".".join(map(str, (*path, name)))
                raise InputError(
                    f"{self._place(key)}: {where}: expected each key once, found it again (first at line {seen[name]})"
                )
            seen[name] = key.start_mark.line + 1
            result[name] = self.build(value, (*path, name), key)
        for source in merged:
            if not isinstance(source, yaml.MappingNode):
                raise InputError(f"{self._place(source)}: expected a mapping after <<, found something else")
            extra = _Builder(self._source, self._numbered)
            values = extra._mapping(source, path)
            new = values.keys() - result.keys()
            result |= {name: value for name, value in values.items() if name in new}
            depth = len(path)
            self.places |= {p: q for p, q in extra.places.items() if len(p) > depth and p[depth] in new}
        return result


def parse_yaml(text: str | bytes, source: str, numbered: bool = True) -> Tree:
    """Parse one YAML document from a file (or option), the `source` that messages name.

    `numbered` says whether lines are worth naming (not for the value of an option). Raises InputError for text that is
    not YAML or not text, several documents, a duplicate key, or a value that is not plain.
    """
    builder = _Builder(source, numbered)
    try:
        node = compose_yaml(text, source, _CoreLoader)
        data = None if node is None else builder.build(node, ())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        last = text.count(b"\n" if isinstance(text, bytes) else "\n")  # type: ignore[arg-type]
        # the end of a document that breaks off is a line after its last
        place = Place(source, min(mark.line, last) + 1 if mark and numbered else None)
        raise InputError(f"{place}: expected YAML, found a syntax error: {error.problem or error.context}") from error
    except (yaml.YAMLError, UnicodeError) as error:
        raise InputError(f"{source}: expected YAML text, found {str(error).splitlines()[0]}") from error
    except RecursionError as error:
        raise InputError(f"{source}: expected YAML, found lists or mappings nested too deeply") from error
    builder.places[()] = Place(source, 1 if numbered else None)
    return Tree(data, builder.places)


def read_yaml(path: Path, what: str = CONFIGURATION) -> tuple[Tree, bytes]:
    """Read a YAML file, which should be a `what`, and return it with its bytes.

    Raises InputError when the file is not there or not readable, or a table; or as `parse_yaml`.
    """
    try:
        refuse_unsettled(path)
        with open(path, "rb") as stream:
            content = stream.read(MAX_DOCUMENT_BYTES + 1)
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError:
        raise InputError(f"{str(path)!a}: expected the path of a file, found one with a NUL") from None
    if len(content) > MAX_DOCUMENT_BYTES:
        raise InputError(f"{path}: expected a configuration of at most {MAX_DOCUMENT_BYTES // 10**6} MB, found more")
    if (found := kind_of_content(content[:HEAD_BYTES])) in (PARQUET, HDF5, CSV):
        raise InputError(f"{path}: expected a {what} (YAML), found {found}{remedy(what, found)}")
    return parse_yaml(content, str(path)), content


# A longer number in a key path is a name, not the index of a list.
MAX_INDEX_DIGITS = 9
# A longer override is shortened in messages.
MAX_SHOWN_OVERRIDE = 200


def parse_override(text: str) -> tuple[KeyPath, Tree]:
    """Return the key path and the value of `KEY.PATH=VALUE`."""
    key, separator, value = text.partition("=")
    source = f"`overrides` {text}" if len(text) <= MAX_SHOWN_OVERRIDE else f"`overrides` {text[:MAX_SHOWN_OVERRIDE]}..."
    if not separator or not all(key.strip().split(".")):
        raise InputError(f"{source}: expected KEY.PATH=VALUE")
    return key_path(key), parse_yaml(value, source, numbered=False)


def key_path(key: str) -> KeyPath:
    """Return the parts of a dotted key; a part of digits is the index of a list."""
    return tuple(
        int(part) if part.isdecimal() and len(part) <= MAX_INDEX_DIGITS else part for part in key.strip().split(".")
    )


def apply_override(tree: Tree, path: KeyPath, value: Tree, key: KeyPath = ()) -> None:
    """Put a value at a path of the tree; an InputError if something on the path is no mapping or list."""
    _refuse_unknown_camera(tree, path, value)
    try:
        tree.graft(path, value, key)
    except TypeError as error:
        where = ".".join(map(str, path))
        raise InputError(
            f"{value.place(())}: {where}: expected the path of a key, found no mapping or list that has {error}"
        ) from None


def _refuse_unknown_camera(tree: Tree, path: KeyPath, value: Tree) -> None:
    """Refuse a single value of a camera that is not there: its other values would be missed one by one."""
    cameras = tree.data.get("cameras") if isinstance(tree.data, dict) else None
    if path[0] != "cameras" or len(path) <= 2 or not isinstance(cameras, dict) or not cameras:
        return
    if str(path[1]) not in cameras:
        raise InputError(f"{value.place(())}: {'.'.join(map(str, path))}: {unknown_camera(path[1], cameras)}")
