"""Validation errors of pydantic as sentences: place, key path, expected, found, nearest key."""

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

from stereophd.config.known_keys import branches_at, kinds_with, known_keys, places_of
from stereophd.config.yaml import KeyPath, Tree
from stereophd.errors import did_you_mean, near_name, nearest

# What pydantic expected, for each kind of error; the braces are filled from the error's context.
_EXPECTED = {
    "float_type": "a number",
    "float_parsing": "a number",
    "int_type": "an integer",
    "int_parsing": "an integer",
    "int_from_float": "an integer",
    "int_parsing_size": "an integer of at most 64 bits",
    "bool_type": "true or false",
    "string_type": "a text",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "dataclass_type": "a mapping",
    "tuple_type": "a list",
    "list_type": "a list",
    "greater_than": "a number > {gt}",
    "greater_than_equal": "a number >= {ge}",
    "less_than": "a number < {lt}",
    "less_than_equal": "a number <= {le}",
    "finite_number": "a finite number",
    "predicate_failed": "a finite number",
    "literal_error": "{expected}",
    "too_short": "at least {min_length} values",
    "too_long": "at most {max_length} values",
}
# Kinds of error for an unknown key of a model and of a dataclass.
_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
# A lower bound below this means "above 0"; a message names the bound only if the value is below it.
TINY = 1e-5
_MAX_SHOWN = 60
# More places of a key are no suggestion.
MOST_PLACES = 2


def show(value: Any) -> str:
    """Return a value as YAML would write it on one line, shortened."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."


def _part(part: str | int) -> str:
    text = str(part)
    return text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."


def _split_location(location: tuple[str | int, ...], data: Any) -> tuple[KeyPath, KeyPath]:
    """Split pydantic's location into the key path in the data and the tags of unions along it."""
    path: list[str | int] = []
    tags: list[str | int] = []
    for i, part in enumerate(location):
        if _has(data, (part,)):
            path.append(part)
            data = data[part]
        elif i == len(location) - 1 and isinstance(data, (dict, list)):
            # The last part may be a key that is missing (or the name of a union's branch).
            path.append(part)
        else:
            tags.append(part)
    return tuple(path), tuple(tags)


def _value(data: Any, path: KeyPath) -> Any:
    for part in path:
        data = data[part]
    return data


def _has(data: Any, path: KeyPath) -> bool:
    try:
        _value(data, path)
    except (KeyError, IndexError, TypeError):
        return False
    return True


def _expected(error: Mapping[str, Any], found: Any) -> str:
    """Return what an error expected; a validator's own sentence is returned whole."""
    template = _EXPECTED.get(error["type"])
    if template is None:
        return str(error["msg"])
    if error["type"] == "greater_than_equal" and 0.0 < error["ctx"]["ge"] < TINY and found <= 0:
        return "a number > 0"
    context = {k: (f"{v:g}" if isinstance(v, float) else v) for k, v in error.get("ctx", {}).items()}
    return template.format(**context)


def _is_misspelt(error: Mapping[str, Any], path: KeyPath, data: Any, schema: Mapping[str, Any]) -> bool:
    """Whether a key is missing only because it is there under a misspelt name (an error of its own)."""
    if error["type"] != "missing" or not path or isinstance(_value(data, path[:-1]), list):
        return False
    parent = _value(data, path[:-1])
    known = known_keys(schema, path[:-1], parent)
    unknown = [key for key in parent if key not in known]
    return any(near_name(key, known) == path[-1] for key in unknown)


def _discriminator(error: Mapping[str, Any]) -> str:
    """Return the key that selects the branch of a union; pydantic writes it as 'kind', or as kind() of a function."""
    return str(error["ctx"]["discriminator"]).strip("'()")


def _sentence(error: Mapping[str, Any], path: KeyPath, data: Any, schema: Mapping[str, Any]) -> str:
    kind = error["type"]
    if kind == "missing" and path:
        parent = _value(data, path[:-1])
        if isinstance(parent, list):
            return f"expected more values, found {show(parent)}"
        return "expected this key, found none"
    if kind in _UNKNOWN_KEY:
        known = known_keys(schema, path[:-1], _value(data, path[:-1]))
        name = str(path[-1])
        if other := kinds_with(schema, path[:-1], _value(data, path[:-1]), name):
            selector, kinds = other
            place = ".".join(map(_part, (*path[:-1], selector)))
            return f"belongs to {place} {' or '.join(kinds)}, found {_value(data, (*path[:-1], selector))}"
        forms = [node.get("properties", {}).keys() for node in branches_at(schema, path[:-1])]
        others = [key for key in _value(data, path[:-1]) if key in known and not any({name, key} <= f for f in forms)]
        if name in known and others:
            return f"expected no {name} beside {' and '.join(others)}, which takes its place"
        close = near_name(name, known)
        candidates = [*([close] if close else ()), *_elsewhere(schema, (name,))]
        return f"unknown key{_did_you_mean(candidates) or nearest(name, known)}"
    if kind == "union_tag_not_found":
        return f"expected a key {_discriminator(error)} that selects the kind, found none"
    if kind == "value_error":
        return re.sub(r"^Value error, ", "", str(error["msg"]))
    found = _value(data, path)
    if kind == "union_tag_invalid":
        tags = re.findall(r"'([^']*)'", error["ctx"]["expected_tags"])
        return f"expected one of {', '.join(tags)}, found {show(found)}{did_you_mean(str(found), tags)}"
    if kind in ("too_long", "too_short") and isinstance(found, (list, dict)):
        return f"expected {_expected(error, found)}, found {len(found)}"
    meant = ""
    if isinstance(found, dict) and found and path:
        # a section in place of a plain value: one of another place, such as `detector` of a camera
        meant = _did_you_mean(_elsewhere(schema, (str(path[-1]), str(next(iter(found))))))
    return f"expected {_expected(error, found)}, found {show(found)}{meant}"


def _elsewhere(schema: Mapping[str, Any], keys: tuple[str, ...]) -> list[str]:
    """Return the places where the schema has these keys, one below the other; none if they are many."""
    places = places_of(schema, keys)
    return places if len(places) <= MOST_PLACES else []


def _did_you_mean(names: list[str]) -> str:
    return f"; did you mean {' or '.join(names)}?" if names else ""


def describe(errors: Iterable[Mapping[str, Any]], tree: Tree, schema: Mapping[str, Any]) -> str:
    """Return one line for each error: ``FILE:LINE: key.path: expected ..., found ...``.

    The errors are as `pydantic.ValidationError.errors` returns them. The tree has the data that were validated, with
    their places; the model's JSON schema has the known keys.
    """
    data = tree.data
    by_path: dict[KeyPath, list[Mapping[str, Any]]] = {}
    for error in errors:
        path, tags = _split_location(tuple(error["loc"]), data)
        if path and error["type"] not in ("missing", *_UNKNOWN_KEY) and not _has(data, path):
            path = path[:-1]  # the last part is the branch of a union, not a key
            tags = (*tags, "")
        if error["type"] == "union_tag_invalid":
            # the fault is the value of the key that selects the kind, not the mapping around it
            path = (*path, _discriminator(error))
        if _is_misspelt(error, path, data, schema):
            continue
        by_path.setdefault(path, []).append({**error, "tagged": bool(tags)})
    # Branches of a union that fail at the union itself are not reported if another branch got deeper.
    for path in [p for p, found in by_path.items() if all(e["tagged"] for e in found)]:
        if any(len(other) > len(path) and other[: len(path)] == path for other in by_path):
            del by_path[path]
    lines: list[tuple[int, str]] = []
    for path, found in by_path.items():
        place = tree.place(path)
        sentences = dict.fromkeys(_sentence(error, path, data, schema) for error in found)
        key = f"{'.'.join(map(_part, path))}: " if path else ""
        lines.append((place.line or 0, f"{place}: {key}{_join(list(sentences))}"))
    return "\n".join(line for _, line in sorted(lines, key=lambda item: item[0]))


def _join(sentences: list[str]) -> str:
    """Join the expectations of the branches of a union: expected A or B, found C."""
    pattern = re.compile(r"^expected (.*), found (.*)$", re.DOTALL)
    matches = [pattern.match(sentence) for sentence in sentences]
    if len(sentences) > 1 and all(matches):
        return f"expected {' or '.join(m[1] for m in matches if m)}, found {matches[0][2]}"  # type: ignore[index]
    return "; ".join(sentences)
