"""Number the records of decisions in docs/dev/decisions/ and write their index, docs/decisions.md.

A record is a short Markdown file: a title, a line `Status: in force` (which is the default) or `Status: superseded
by NNNN`, whose first sentence the index shows, then context, decision, measurement and cost. Name a new one by its
topic (`topic.md`) and run `make reference`.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

DOCS = Path(__file__).parent
RECORDS = DOCS / "dev" / "decisions"
NUMBERED = re.compile(r"(\d{4})-(.+)\.md")

HEAD = """# Decisions

Each record holds one choice that the paper or the design leaves open, or the correction of one that was wrong: the
context, the decision and the measurement behind it. Numbers in a record are those of its day and machine; those of the
present release are under *Results*. A record that another one replaces stays, and its status names the successor.

Unless a record says otherwise, "scenes" are simulations of `configs/paper/multi_object.yaml` (six objects, two cameras,
10 false detections per frame, detection probability 0.95), and OSPA has order 2 and cutoff 20 cm and is a mean over the
second half of 100 s.

| record | decision | status |
|---|---|---|
"""


def number_records() -> None:
    """Give records that are named by a topic alone the next free numbers, in the order of their names."""
    numbers = [int(match[1]) for path in RECORDS.glob("*.md") if (match := NUMBERED.fullmatch(path.name))]
    following = max(numbers, default=0) + 1
    for path in sorted(RECORDS.glob("*.md")):
        if not NUMBERED.fullmatch(path.name):
            path.rename(path.with_name(f"{following:04d}-{path.name}"))
            following += 1


def index() -> str:
    """Return the text of the index page."""
    rows = []
    for path in sorted(RECORDS.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        title = re.search(r"^#+ +(.+)$", text, re.MULTILINE)
        status = re.search(r"^\W*status\W+([^.·\n]+)", text, re.MULTILINE | re.IGNORECASE)
        if title is None:
            sys.exit(f"{path}: expected a title, found none")
        shown = title[1].replace("|", "\\|")
        standing = status[1].strip() if status else "in force"
        rows.append(f"| [{path.name[:4]}](dev/decisions/{path.name}) | {shown} | {standing} |\n")
    return HEAD + "".join(rows)


def main() -> None:
    """Number new records, and write the index anew."""
    number_records()
    (DOCS / "decisions.md").write_text(index(), encoding="utf-8")


if __name__ == "__main__":
    main()
