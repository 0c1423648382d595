"""List every measured number with a unit that stands on two user pages: each should have one home, or be a definition.

    python docs/list_numbers.py

Numbers inside code, in the generated pages and in docs/dev are left out. A reader decides; a test only asks for a
reason (`REVIEWED`) where a number with a decimal point, which somebody measured, stands twice.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
GENERATED = ("docs/dev", "docs/reference/configuration", "docs/notebooks", "docs/decisions.md")
UNIT = r"(?:%|px|mm|cm|m|km|ms|us|s|minutes?|hours?|degrees?|Hz|MB|GB|GiB|times|objects|cameras|frames|rows|bounds)"
NUMBER = re.compile(rf"(?<![\w.^-])(\d[\d,.]*\d|\d) ({UNIT})(?![\w/^])")

# Numbers with a decimal point on two pages that are not one quantity.
REVIEWED = {
    "1.4 times": "a ratio of shares that a check asks for; errors whose NEES is twice as large",
}


def pages() -> list[Path]:
    """Return the pages that users read, but those that are made from the code."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [path for path in found if not path.relative_to(ROOT).as_posix().startswith(GENERATED)]


def twice() -> dict[str, dict[str, str]]:
    """Return the numbers on two pages or more, each with its pages and the first line of each."""
    places: dict[str, dict[str, str]] = defaultdict(dict)
    for path in pages():
        text = re.sub(r"^```.*?^```|`[^`\n]*`", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        for line in text.splitlines():
            for match in NUMBER.finditer(line):
                places[f"{match[1]} {match[2]}"].setdefault(path.relative_to(ROOT).as_posix(), line.strip())
    ordered = sorted(places.items(), key=lambda item: item[0].split()[::-1])
    return {number: lines for number, lines in ordered if len(lines) > 1}


def main() -> None:
    """Print the numbers, with the lines that hold them."""
    for number, lines in twice().items():
        print(number)
        for page, line in lines.items():
            print(f"  {page}: {line[:110]}")


if __name__ == "__main__":
    main()
