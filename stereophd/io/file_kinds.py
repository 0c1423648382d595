"""What a file that cannot be used looks like, for messages: the likely cause, and what helps."""

import re
from pathlib import Path

# Bytes from which the kind is read.
HEAD_BYTES = 4096
PARQUET, HDF5, JSON, CSV, YAML = "a Parquet file", "an HDF5 file", "a JSON file", "a CSV table", "a YAML file"
# What callers expect of a file, where more can be said.
LOG, CONFIGURATION = "detection log", "configuration"

_MAGIC = {b"PAR1": PARQUET, b"\x89HDF": HDF5}
_KEY = re.compile(r"^[A-Za-z_]\w*:(\s|$)", re.MULTILINE)
_ORDER = "commands take the configuration first, then the logs"
_IMPORT_CSV, _IMPORT = "`stereophd import csv` turns it into a log", "`stereophd import` reads files of other programs"
_HELP = {
    (LOG, CSV): _IMPORT_CSV,
    (LOG, YAML): _ORDER,
    (LOG, JSON): _IMPORT,
    (LOG, HDF5): _IMPORT,
    (CONFIGURATION, PARQUET): _ORDER,
    (CONFIGURATION, CSV): f"{_IMPORT_CSV}; {_ORDER}",
}


def kind_of_content(head: bytes) -> str:
    """Return what the first bytes of a file look like: one of the kinds of this module, or an empty text."""
    if head[:4] in _MAGIC:
        return _MAGIC[head[:4]]
    try:
        text = head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 3:  # not the last character, cut in two
            return ""
        text = head[: error.start].decode("utf-8-sig")
    lines = [line for line in text.splitlines() if line.strip()]
    if "\0" in text or not lines:
        return ""
    if lines[0].lstrip()[0] in "{[":
        return JSON
    if _is_csv(lines):
        return CSV
    return YAML if _KEY.search(text) else ""


def _is_csv(lines: list[str]) -> bool:
    """Whether the first two lines have the same number of separators, and the first is no key of YAML."""
    if len(lines) < 2 or lines[0].startswith(("#", "- ", "%")) or re.search(r":(\s|$)", lines[0]):
        return False
    return any(0 < lines[0].count(separator) == lines[1].count(separator) for separator in ",;\t")


def kind_of_file(path: Path | str) -> str:
    """Return what a file looks like; an empty text if it is no file or cannot be read."""
    try:
        with open(path, "rb") as stream:
            return kind_of_content(stream.read(HEAD_BYTES))
    except OSError:
        return ""


def remedy(expected: str, found: str) -> str:
    """Return ``; ...`` with what helps where a file of the kind `found` was given for `expected`, or an empty text."""
    text = _HELP.get((expected, found))
    return f"; {text}" if text else ""
