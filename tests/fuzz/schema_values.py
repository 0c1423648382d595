"""Random values for any key of the configuration, from its JSON schema: new keys are covered by themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

# Values that arithmetic, YAML and text do not expect.
ODD_NUMBERS = [0, -1, 1, 1e-300, -1e-300, 1e300, -1e300, 1.8e308, float("inf"), float("nan"), 2**63, 2**70, 10**400]
ODD_TEXTS = ["", " ", "\x00", "é", "\ud800", "null", "../x", "a" * 1000, "1e999", "left"]
ODD = st.one_of(
    st.sampled_from([*ODD_NUMBERS, *ODD_TEXTS, None, True, [], {}, [None], {"a": {}}]),
    st.floats(),
    st.integers(),
    st.lists(st.sampled_from(ODD_NUMBERS), max_size=4),
)

Path = tuple[str, ...]


def resolve(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """Return the schema that a reference stands for."""
    while "$ref" in node:
        found: Any = schema
        for part in node["$ref"].removeprefix("#/").split("/"):
            found = found[part]
        node = found
    return node


def alternatives(schema: dict[str, Any], node: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the schemas of which a value fits one."""
    node = resolve(schema, node)
    for word in ("anyOf", "oneOf", "allOf"):
        if word in node:
            return [one for part in node[word] for one in alternatives(schema, part)]
    return [node]


def leaves(schema: dict[str, Any], node: dict[str, Any] | None = None, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield the dotted path of every key of the schema, and its own schema; a name that is free is ``left``."""
    for one in alternatives(schema, schema if node is None else node):
        if len(path) > 8:
            continue
        children = {**one.get("properties", {})}
        free = one.get("additionalProperties")
        if isinstance(free, dict):
            children["left"] = free
        if children:
            for name, child in children.items():
                yield from leaves(schema, child, (*path, name))
        else:
            yield path, one


def near_bounds(node: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Return values at, and just beyond, the bounds of a number; other values for other types."""
    bounds = [node[word] for word in ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum") if word in node]
    values = [value * factor for value in bounds for factor in (1, 0.999, 1.001)]
    if "enum" in node:
        values += node["enum"]
    if "const" in node:
        values.append(node["const"])
    if node.get("type") == "integer":
        values += [1, 2, 3, 1000]
    return st.one_of(st.sampled_from(values), ODD) if values else ODD
