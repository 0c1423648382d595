"""Write the reference of all keys of a configuration, one page per section, from the declarations (`make reference`).

    python docs/make_configuration.py [--check]

With --check nothing is written, and the exit code is 1 if a page is out of date.
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

FOLDER = Path(__file__).resolve().parent / "reference" / "configuration"
# Bounds beyond this exclude only what no set-up reaches, and say nothing to a reader.
LARGEST_SHOWN = 1e6

Node = Mapping[str, Any]

INDEX = """# Configuration

A configuration is one YAML file. [Choosing settings](../../howto/settings.md) explains the values that matter most;
these pages list every key, section by section.

- `stereophd config check FILE --for track` checks a configuration for a command.
- `stereophd config show FILE` prints it with all defaults.
- `--set KEY=VALUE` changes single values on the command line, such as `--set filter.birth.per_s=0.2`.
- `stereophd config schema` prints the JSON schema. Editors that read it complete and check keys.

Lengths are in the unit that `units.length` names, times in seconds, pixels as floats with (0, 0) at the centre of the
top-left pixel, angles in degrees where the key ends in `_deg`. Every number has bounds, which exclude only physically
impossible values: if you see a message about one, you probably used the wrong unit. The tables show the bounds that
say more than that.
"""


class Reference:
    """The reference of a JSON schema, section by section."""

    def __init__(self, schema: Node) -> None:
        self._schema = schema
        self._places: dict[str, str] = {}
        self.lines: list[str] = []

    def write(self) -> dict[str, str]:
        """Return the pages by name: `index` for the top level, and one for each section."""
        properties = self._schema["properties"]
        self._table(self._schema)
        pages = {}
        index = self._taken()
        for key, value in properties.items():
            resolved = self._resolved(value)
            for place, section, kind in self._below(key, resolved):
                self._section(place, section, kind)
            if self.lines:
                head = f"# Configuration: `{key}`\n\n{_sentence(str(resolved.get('description', '')))}\n"
                pages[key] = head + self._taken()
                index = index.replace(f"| `{key}` |", f"| [`{key}`]({key}.md) |")
        return {"index": INDEX + index, **pages}

    def _taken(self) -> str:
        """Return the lines so far as text, and begin anew."""
        text = "\n".join(self.lines) + "\n"
        self.lines.clear()
        return text

    def _resolved(self, node: Node) -> Node:
        """Follow a reference; what stands beside it has priority."""
        if "$ref" not in node:
            return node
        target = self._schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
        return {**target, **{key: value for key, value in node.items() if key != "$ref"}, "is": node["$ref"]}

    def _section(self, path: str, node: Node, word: str = "") -> None:
        """Write the keys of a mapping, and then the sections below it."""
        title = f"`{path}`" + (f" with `{word}`" if word else "")
        self.lines += ["", f"## {title}", ""]
        text = str(node.get("description", ""))
        name = node.get("is")
        if name in self._places:
            self.lines += [f"As {self._places[name]}."]
            return
        if name:
            self._places[name] = title
        if text:
            self.lines += [*textwrap.wrap(_sentence(text), 120, break_long_words=False, break_on_hyphens=False), ""]
        self._table(node)
        for key, value in node.get("properties", {}).items():
            for place, section, kind in self._below(f"{path}.{key}", self._resolved(value)):
                self._section(place, section, kind or word)

    def _table(self, node: Node) -> None:
        """Write one row per key of a mapping."""
        self.lines += ["", "| key | meaning | values | unit | default |", "|---|---|---|---|---|"]
        for key, value in node.get("properties", {}).items():
            entry = self._resolved(value)
            meaning = _sentence(str(entry.get("description", "")))
            if "advice" in entry:
                meaning += f"<br>*Choosing:* {entry['advice']}"
            if key in node.get("required", ()):
                default = "required"
            else:
                default = f"`{_written(entry['default'])}`" if "default" in entry else ""
            cells = [f"`{key}`", meaning, self._values(entry), str(entry.get("unit", "")), default]
            self.lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")

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
    """Return the bounds of a number in words, as far as they say something."""
    low = node.get("minimum", node.get("exclusiveMinimum"))
    high = node.get("maximum", node.get("exclusiveMaximum"))
    has_low = low is not None and abs(low) <= LARGEST_SHOWN
    has_high = high is not None and abs(high) <= LARGEST_SHOWN
    if has_low and 0 < low < 1 / LARGEST_SHOWN:
        return f" above 0, at most {high:g}" if has_high else " above 0"
    if has_low and has_high:
        return f" from {low:g} to {high:g}" + (" (excluded)" if "exclusiveMaximum" in node else "")
    if has_low:
        return f", at least {low:g}"
    return f", at most {high:g}" if has_high else ""


def _written(value: Any) -> str:
    if isinstance(value, str):
        return value or '""'
    return json.dumps(value)


def pages() -> dict[str, str]:
    """Return the text of every page, by its name in the folder."""
    return {f"{name}.md": text for name, text in Reference(json_schema()).write().items()}


def main() -> int:
    """Write the pages, or check them."""
    new = pages()
    old = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.md")}
    if "--check" in sys.argv[1:]:
        return int(new != old)
    for name in old.keys() - new.keys():
        (FOLDER / name).unlink()
    for name, text in new.items():
        (FOLDER / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
