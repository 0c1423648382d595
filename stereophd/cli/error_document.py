"""An error as a JSON document: the file, the place in it, what was expected and what was found.

Messages of the package have one form (`stereophd.errors`): ``FILE[:LINE]: PLACE: expected THIS, found THAT``, one line
an error. The parts are taken from that form; what a message does not have is null.
"""

import os
import re
from typing import Any

_EXPECTED = re.compile(r"\bexpected (?P<expected>.+?)(?:, found (?P<found>.+?))?(?:; |$)", re.DOTALL)
_UNKNOWN_KEY = re.compile(r"unknown key(?:; (?:did you mean |expected one of )(?P<expected>.+?)\??)?$")
_NO_FILE = "there is no such file"
_LINE = re.compile(r"^(?P<file>.+?):(?P<line>\d+)$")
# A word that ends like this names a file although it does not exist.
_SUFFIX = re.compile(r"\.[A-Za-z0-9]{1,8}$")
# The part before "expected" names a place in a file or on the command line.
_PLACE = re.compile(r"^(--?[a-z]|`|row \d|column |line \d|camera|[A-Za-z_0-9]+(\.[A-Za-z_0-9]+)*$)")

# Usage errors are sentences of typer: INVALID VALUE FOR PLACE: FOUND is not EXPECTED, and a few more.
_SEE_HELP = re.compile(r" \(see '[^']*--help'\)$")
_INVALID = re.compile(r"^Invalid value for (?P<place>.+?): (?P<reason>.*)$", re.DOTALL)
_IS_NOT = re.compile(r"^(?P<found>.+?) is not (?P<expected>.+)$", re.DOTALL)
_SHOULD_BE = re.compile(r"^Input should be (?P<expected>[^,]+)")
_MISSING = re.compile(r"^(?:Missing \w+|Option) '(?P<place>[^']+)'")
_NO_SUCH = re.compile(r"^No such (?P<what>option|command):? '?(?P<found>[^\s']+)")
_EXTRA = re.compile(r"^Got unexpected extra arguments?(?:\(s\))? \((?P<found>.+)\)")


def error_document(message: str, kind: str, code: int) -> dict[str, Any]:
    """Return the document of an error: ``error`` with ``kind, exit_code, message`` and the parts of its first line.

    The message has one line for each error. The parts of the first are ``file, line, place, expected, found``; further
    lines are in ``others``. The kind is `usage`, `input`, `gate`, `interrupted` or `internal`; `code` is the exit code.
    """
    first, *others = message.splitlines() or [""]
    parts = _usage_parts(first) if kind == "usage" else _parts(first)
    return {
        "error": {
            "kind": kind,
            "exit_code": code,
            "message": message,
            **parts,
            "others": [{"message": line, **_parts(line)} for line in others],
        }
    }


def _usage_parts(sentence: str) -> dict[str, Any]:
    text = _SEE_HELP.sub("", sentence)
    parts = _parts(text)
    if match := _INVALID.match(text):
        parts["place"] = match["place"].replace("'", "")
        if reason := _IS_NOT.match(match["reason"]):
            expected = reason["expected"]
            parts["expected"] = f"a value {expected}" if expected.startswith("in ") else expected
            parts["found"] = reason["found"].strip("'")
        elif reason := _SHOULD_BE.match(match["reason"]):
            expected = reason["expected"]
            parts["expected"] = expected if expected.startswith("a ") else f"a value {expected}"
    elif match := _MISSING.match(text):
        parts |= {"place": match["place"], "expected": "a value", "found": "none"}
    elif match := _NO_SUCH.match(text):
        found = match["found"].rstrip(".")
        parts |= {"place": found, "expected": f"a known {match['what']}", "found": found}
    elif match := _EXTRA.match(text):
        parts |= {"expected": "no further argument", "found": match["found"]}
    return parts


def _parts(sentence: str) -> dict[str, Any]:
    """Return the parts of a sentence; None for those that it does not have."""
    parts: dict[str, Any] = dict.fromkeys(("file", "line", "place", "expected", "found"))
    head = sentence
    if match := _UNKNOWN_KEY.search(sentence):
        parts["expected"], parts["found"] = match["expected"], "an unknown key"
        head = sentence[: match.start()]
    elif sentence.endswith(_NO_FILE):
        parts["expected"], parts["found"] = "a file", "none"
        head = sentence.removesuffix(_NO_FILE)
    elif match := _EXPECTED.search(sentence):
        parts["expected"], parts["found"] = match["expected"], match["found"]
        head = sentence[: match.start()]
    pieces = [piece for piece in head.rstrip(": ").split(": ") if piece]
    if pieces:
        file, line = _file(pieces[0])
        if file is not None:
            parts["file"], parts["line"] = file, line
            pieces = pieces[1:]
    places = []
    for piece in pieces:
        if not _PLACE.match(piece):
            break
        places.append(piece)
    parts["place"] = ": ".join(places) or None
    return parts


def _file(text: str) -> tuple[str | None, int | None]:
    """Return the file that a piece of a message names, and the line in it."""
    name, line = text, None
    if match := _LINE.match(text):
        name, line = match["file"], int(match["line"])
    if os.path.lexists(name) or (
        " " not in name and (_SUFFIX.search(name) or "/" in name) and not name.startswith("-")
    ):
        return name, line
    return None, None
