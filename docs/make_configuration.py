"""Write the reference part of docs/reference/configuration.md from the declarations (`make reference`).

    python docs/make_configuration.py [--check]

Everything above the marker in the page is written by hand and kept. With --check nothing is written, and the exit
code is 1 if the page is out of date.
"""

from __future__ import annotations

import json
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from stereophd.config.loading import json_schema

PAGE = Path(__file__).resolve().parent / "reference" / "configuration.md"
MARKER = "<!-- Everything below is written by `make reference`. -->"
WIDTH = 120

Node = Mapping[str, Any]


class Reference:
    """The reference of a JSON schema, section by section."""

    def __init__(self, schema: Node) -> None:
        self._schema = schema
        self._places: dict[str, str] = {}
        self.lines: list[str] = []

    def write(self) -> str:
        """Return the text of all sections."""
        self._section("", self._schema)
        return "\n".join(self.lines) + "\n"

    def _resolved(self, node: Node) -> Node:
        """Follow a reference; what stands beside it has priority."""
        if "$ref" not in node:
            return node
        target = self._schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
        return {**target, **{key: value for key, value in node.items() if key != "$ref"}, "is": node["$ref"]}

    def _section(self, path: str, node: Node, word: str = "") -> None:
        """Write the keys of a mapping, and then the sections below it."""
        title = f"`{path}`" + (f" with `{word}`" if word else "") if path else "Top level"
        self.lines += ["", f"### {title}", ""]
        text = str(node.get("description", ""))
        name = node.get("is")
        if name in self._places:
            self.lines += [f"As {self._places[name]}."]
            return
        if name:
            self._places[name] = title
        if path and text:
            self._paragraph(_sentence(text))
            self.lines.append("")
        below: list[tuple[str, Node, str]] = []
        for key, value in node.get("properties", {}).items():
            resolved = self._resolved(value)
            self._key(key, resolved, key in node.get("required", ()))
            below += self._below(f"{path}.{key}" if path else key, resolved)
        for place, section, kind in below:
            self._section(place, section, kind)

    def _key(self, key: str, node: Node, required: bool) -> None:
        parts = [_sentence(str(node.get("description", "")))]
        if values := self._values(node):
            parts.append(f"Values: {values}.")
        if "unit" in node:
            parts.append(f"Unit: {node['unit']}.")
        if required:
            parts.append("Required.")
        elif "default" in node:
            parts.append(f"Default: `{_written(node['default'])}`.")
        self._paragraph(f"- **`{key}`**: {' '.join(parts)}", "  ")
        if "advice" in node:
            self._paragraph(f"  *Choosing:* {node['advice']}", "  ")

    def _paragraph(self, text: str, indent: str = "") -> None:
        self.lines += textwrap.wrap(
            text, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )

    def _values(self, node: Node) -> str:
        """Return the values that a key takes, in words; empty for a section."""
        node = self._resolved(node)
        if "anyOf" in node or "oneOf" in node:
            words = [self._values(branch) for branch in node.get("anyOf", node.get("oneOf"))]
            return " or ".join(dict.fromkeys(word for word in words if word))
        if "const" in node:
            return f"`{node['const']}`"
        if "enum" in node:
            return ", ".join(f"`{word}`" for word in node["enum"])
        kind = node.get("type")
        if kind == "array":
            return self._list(node)
        if kind in ("number", "integer"):
            return ("integer" if kind == "integer" else "number") + _bounds(node)
        if kind == "object":
            return "a mapping (see below)" if "properties" in node else "a mapping of names"
        return {"boolean": "`true`, `false`", "string": "text", "null": "`null`"}.get(str(kind), "any value")

    def _list(self, node: Node) -> str:
        if "prefixItems" in node:
            kinds = list(dict.fromkeys(self._values(item) for item in node["prefixItems"]))
            return f"list of {len(node['prefixItems'])} ({'; '.join(kinds)})"
        return f"list ({self._values(node.get('items', {}))})"

    def _below(self, path: str, node: Node) -> Iterator[tuple[str, Node, str]]:
        """Yield the sections that a key holds: its path, its schema, and the word that chooses it among several."""
        node = self._resolved(node)
        if "properties" in node:
            yield path, node, ""
        elif "discriminator" in node:
            key = node["discriminator"]["propertyName"]
            for word, reference in node["discriminator"]["mapping"].items():
                yield path, self._resolved({"$ref": reference}), f"{key}: {word}"
        elif isinstance(node.get("additionalProperties"), Mapping):
            yield from self._below(f"{path}.NAME", node["additionalProperties"])
        elif node.get("type") == "array" and "items" in node:
            yield from self._below(f"{path}.NUMBER", node["items"])
        else:
            for branch in node.get("anyOf", ()):
                yield from self._below(path, branch)


def _sentence(text: str) -> str:
    """Return a description as a sentence."""
    text = " ".join(text.replace("``", "`").split())
    if not re.match(r"\w+: ", text):  # a word of a choice is written as it is
        text = text[:1].upper() + text[1:]
    return text if text.endswith(".") else f"{text}."


def _bounds(node: Node) -> str:
    low = node.get("minimum", node.get("exclusiveMinimum"))
    high = node.get("maximum", node.get("exclusiveMaximum"))
    below = " (excluded)" if "exclusiveMaximum" in node else ""
    if low is None:
        return ""
    return f" from {low:g} to {high:g}{below}" if high is not None else f" from {low:g} on"


def _written(value: Any) -> str:
    if isinstance(value, str):
        return value or '""'
    return json.dumps(value)


def page(text: str) -> str:
    """Return the text of the page with its reference part written anew."""
    by_hand = text.split(MARKER)[0]
    return f"{by_hand}{MARKER}\n\n## Reference of all keys\n{Reference(json_schema()).write()}"


def main() -> int:
    """Write the page, or check it."""
    old = PAGE.read_text(encoding="utf-8")
    new = page(old)
    if "--check" in sys.argv[1:]:
        return int(new != old)
    PAGE.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
