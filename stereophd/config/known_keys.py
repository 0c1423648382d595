"""Keys that the JSON schema of a model knows: in a place, and anywhere."""

from collections.abc import Iterator, Mapping
from typing import Any

from stereophd.config.yaml import KeyPath

# What stands in a path for a name that the user chooses, such as that of a camera.
ANY_NAME = "NAME"


def _branches(schema: Mapping[str, Any], root: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the alternatives of a JSON schema node, references followed."""
    if "$ref" in schema:
        yield from _branches(root["$defs"][schema["$ref"].rsplit("/", 1)[1]], root)
        return
    yield schema
    for kind in ("anyOf", "oneOf", "allOf"):
        for branch in schema.get(kind, ()):
            yield from _branches(branch, root)


def _of_this_kind(node: Mapping[str, Any], data: Any) -> bool:
    """Whether a branch is the one that the data choose, by a key constant in it (`model: fisheye`)."""
    if not isinstance(data, dict):
        return True
    return all(
        data[key] == rule["const"]
        for key, rule in node.get("properties", {}).items()
        if key in data and isinstance(rule, Mapping) and "const" in rule
    )


def known_keys(schema: Mapping[str, Any], path: KeyPath, data: Any = None) -> list[str]:
    """Return the keys that a JSON schema knows in the mapping `data` at a key path."""
    nodes = [node for node in branches_at(schema, path) if _of_this_kind(node, data)]
    return list(dict.fromkeys(key for node in nodes for key in node.get("properties", {})))


def kinds_with(schema: Mapping[str, Any], path: KeyPath, data: Any, key: str) -> tuple[str, list[str]] | None:
    """Return the key that selects the kind of the mapping `data` at a path, and the other kinds that know a key.

    None if no other kind knows it.
    """
    kinds: dict[str, list[str]] = {}
    for node in branches_at(schema, path):
        properties = node.get("properties", {})
        if key in properties and not _of_this_kind(node, data):
            for name, rule in properties.items():
                if name in data and isinstance(rule, Mapping) and "const" in rule:
                    kinds.setdefault(name, []).append(str(rule["const"]))
    return next(iter(kinds.items()), None)


def branches_at(schema: Mapping[str, Any], path: KeyPath) -> list[Mapping[str, Any]]:
    """Return the alternatives of a JSON schema for the value at a key path; none for an unknown one."""
    nodes: list[Mapping[str, Any]] = list(_branches(schema, schema))
    for part in path:
        below: list[Mapping[str, Any]] = []
        for node in nodes:
            child = node.get("properties", {}).get(part)
            if child is None and isinstance(part, int):
                child = node.get("items")
            if child is None and isinstance(node.get("additionalProperties"), Mapping):
                child = node["additionalProperties"]
            if isinstance(child, Mapping):
                below.extend(_branches(child, schema))
        nodes = below
    return nodes


def places_of(schema: Mapping[str, Any], keys: tuple[str, ...]) -> list[str]:
    """Return the dotted paths of a JSON schema that end with these keys; `ANY_NAME` in them is a name."""
    found = (".".join(path) for path in _paths(schema, schema, ()) if path[-len(keys) :] == keys)
    return list(dict.fromkeys(found))


def _paths(node: Mapping[str, Any], root: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield the paths of all keys at and below a node."""
    if path:
        yield path
    for branch in _branches(node, root):
        for key, child in branch.get("properties", {}).items():
            yield from _paths(child, root, (*path, key))
        if isinstance(named := branch.get("additionalProperties"), Mapping):
            yield from _paths(named, root, (*path, ANY_NAME))
