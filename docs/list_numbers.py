"""List every measured number with a unit that stands on two user pages: each should have one home, or be a definition.

    python docs/list_numbers.py

Numbers inside code, in the generated pages and in docs/dev are left out. A reader decides; nothing is checked.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
GENERATED = ("docs/dev", "docs/reference/configuration", "docs/notebooks", "docs/decisions.md")
UNIT = r"(?:%|px|mm|cm|m|km|ms|us|s|minutes?|hours?|degrees?|Hz|MB|GB|GiB|times|objects|cameras|frames|rows|bounds)"
NUMBER = re.compile(rf"(?<![\w.^-])(\d[\d,.]*\d|\d) ({UNIT})(?![\w/^])")


def pages() -> list[Path]:
    """Return the pages that users read, but those that are made from the code."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [path for path in found if not path.relative_to(ROOT).as_posix().startswith(GENERATED)]


def main() -> None:
    """Print the numbers, with the lines that hold them."""
    places: dict[str, dict[str, str]] = defaultdict(dict)
    for path in pages():
        text = re.sub(r"^```.*?^```|`[^`\n]*`", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        for line in text.splitlines():
            for match in NUMBER.finditer(line):
                places[f"{match[1]} {match[2]}"].setdefault(path.relative_to(ROOT).as_posix(), line.strip())
    for number, lines in sorted(places.items(), key=lambda item: item[0].split()[::-1]):
        if len(lines) > 1:
            print(number)
            for page, line in lines.items():
                print(f"  {page}: {line[:110]}")


if __name__ == "__main__":
    main()
