"""Random values for any key of the configuration, from its JSON schema: new keys are covered by themselves."""

from __future__ import annotations

import math
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

# What a configuration may hold in place of a text: names of cameras, of parameters and of quantities.
WORDS = ["left", "right", "auto", "center", "rotation", "focal", "position_error", "ospa_p2_c20", "x"]

Path = tuple[str, ...]


def resolve(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """Return the schema that a reference stands for."""
    while "$ref" in node:
        found: Any = schema
        for part in node["$ref"].removeprefix("#/").split("/"):
            found = found[part]
        node = found
    return node


def alternatives(schema: dict[str, Any], node: dict[str, Any], value: Any = None) -> list[dict[str, Any]]:
    """Return the schemas of which a value fits one; of a section in several kinds that of the value's kind alone."""
    node = resolve(schema, node)
    kinds = node.get("discriminator")
    if kinds is not None and isinstance(value, dict) and (kind := value.get(kinds["propertyName"])) in kinds["mapping"]:
        return alternatives(schema, {"$ref": kinds["mapping"][kind]}, value)
    for word in ("anyOf", "oneOf", "allOf"):
        if word in node:
            return [one for part in node[word] for one in alternatives(schema, part, value)]
    return [node]


def leaves(
    schema: dict[str, Any], node: dict[str, Any] | None = None, path: Path = (), document: Any = None
) -> Iterator[tuple[Path, Any]]:
    """Yield the dotted path of every key of the schema, and its own schema; a name that is free is ``left``.

    With a document, sections in several kinds have the keys of the kind that it holds.
    """
    for one in alternatives(schema, schema if node is None else node, document):
        if len(path) > 8:
            continue
        children = {**one.get("properties", {})}
        free = one.get("additionalProperties")
        if isinstance(free, dict):
            children["left"] = free
        if children:
            for name, child in children.items():
                below = document.get(name) if isinstance(document, dict) else None
                yield from leaves(schema, child, (*path, name), below)
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


def fitting(schema: dict[str, Any], node: dict[str, Any], found: Any = None) -> st.SearchStrategy[Any]:
    """Return values of the types of the schema, numbers within their bounds; also multiples of what is found."""
    kinds = [kind for one in alternatives(schema, node) if (kind := _fitting(schema, one)) is not None]
    if numbers := _numbers(found):
        powers = st.lists(st.floats(-4, 4), min_size=len(numbers), max_size=len(numbers))
        kinds += 2 * [powers.map(lambda exponents: _times(found, [10**power for power in exponents]))]
    return st.one_of(kinds) if kinds else ODD


def _fitting(schema: dict[str, Any], node: dict[str, Any]) -> st.SearchStrategy[Any] | None:
    """Return values of a schema without alternatives; None of a section, whose keys have schemas of their own."""
    if "const" in node or "enum" in node:
        return st.sampled_from(node.get("enum", [node.get("const")]))
    kind = node.get("type")
    if kind in ("number", "integer"):
        return _sizes(node)
    if kind == "array":
        if "prefixItems" in node:
            return st.tuples(*(fitting(schema, item) for item in node["prefixItems"])).map(list)
        least = node.get("minItems", 0)
        most = min(node.get("maxItems", 4), max(least, 4))
        return st.lists(fitting(schema, node.get("items", {})), min_size=least, max_size=most)
    return {"boolean": st.booleans(), "null": st.none(), "string": st.sampled_from(WORDS)}.get(kind or "")


def _sizes(node: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Return numbers within bounds, their powers of ten uniform."""
    low = node.get("minimum", node.get("exclusiveMinimum", 0))
    high = node.get("maximum", node.get("exclusiveMaximum", 1e15))
    least = math.log10(low) if low > 0 else min(-12.0, math.log10(high))
    sizes = st.floats(least, math.log10(high)).map(lambda power: min(max(10.0**power, low), high))
    if node["type"] == "integer":
        return sizes.map(round)
    return st.one_of(sizes, sizes.map(lambda value: max(-value, low))) if low < 0 else sizes


def _numbers(value: Any) -> list[float]:
    """Return the number, or the numbers of a list."""
    values = value if isinstance(value, list) else [value]
    plain = [one for one in values if isinstance(one, (int, float)) and not isinstance(one, bool)]
    return plain if len(plain) == len(values) else []


def _times(value: Any, factors: list[float]) -> Any:
    """Return a number, or the numbers of a list, times factors; integers stay integers."""
    if isinstance(value, list):
        return [_times(one, [factor]) for one, factor in zip(value, factors, strict=True)]
    return round(value * factors[0]) if isinstance(value, int) else value * factors[0]
