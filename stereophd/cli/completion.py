"""Completion of ``--set KEY=VALUE`` in shells: keys and words from the JSON schema, names from the configuration."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def complete_set(incomplete: str) -> list[str]:
    """Return what may stand in place of an unfinished ``KEY=VALUE``; nothing where that cannot be found out.

    Unfinished is, for example, ``filter.bi`` or ``motion.model=``. The configuration on the same line gives the names
    of the cameras and the kinds of sections.
    """
    from stereophd.config.known_keys import branches_at, known_keys
    from stereophd.config.loading import json_schema

    schema, data = json_schema(), _configuration()
    key, equals, _ = incomplete.partition("=")
    path = tuple(key.split("."))
    if equals:
        words = [word for node in branches_at(schema, path) for word in _words(node)]
        return [f"{key}={word}" for word in dict.fromkeys(words)]
    above = path[:-1]
    found = _at(data, above)
    names = [*known_keys(schema, above, found), *(found if isinstance(found, dict) else ())]
    result = []
    for name in dict.fromkeys(names):
        nodes = branches_at(schema, (*above, name))
        prefix = ".".join((*above, name))
        # a section continues with a key of its own
        section = any("properties" in node or isinstance(node.get("additionalProperties"), Mapping) for node in nodes)
        result.append(f"{prefix}." if section else f"{prefix}=")
    return [text for text in result if text.startswith(incomplete)]


def _words(node: Mapping[str, Any]) -> list[str]:
    if "const" in node:
        return [str(node["const"])]
    if node.get("type") == "boolean":
        return ["true", "false"]
    return [str(word) for word in node.get("enum", ())]


def _configuration() -> Any:
    """Return the data of the configuration on the unfinished line, its cameras inline; None if it cannot be read."""
    from stereophd.config.yaml import read_yaml
    from stereophd.errors import InputError

    # The parser stops at an option without a value, so that only the line itself names the file. Bash and the
    # other shells hand it over under different names.
    line = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")
    path = next((Path(word) for word in line.split() if word.endswith((".yaml", ".yml"))), None)
    try:
        data = None if path is None else read_yaml(path)[0].data
        if path is not None and isinstance(data, dict) and isinstance(data.get("cameras"), str):
            data["cameras"] = read_yaml(path.parent / data["cameras"])[0].data["cameras"]
    except (InputError, TypeError, KeyError):
        return None
    return data


def _at(data: Any, path: tuple[str, ...]) -> Any:
    for part in path:
        if not isinstance(data, dict) or part not in data:
            return None
        data = data[part]
    return data
