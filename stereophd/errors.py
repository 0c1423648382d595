"""Errors that carry their exit code.

Every error that a user can cause is an `InputError`: one sentence that names the file, the place in
it, what was expected and what was found. The command line prints it and exits with its `exit_code`.

A message names a parameter of the function that was called in backquotes (`force`, `force=True`), never an option of
the command line: `stereophd.cli.flags` translates.
"""

from collections.abc import Iterable, Mapping
from typing import Any


class StereophdError(Exception):
    """Base of the errors raised on purpose; `exit_code` is what the command line exits with."""

    exit_code = 3


class InputError(StereophdError, ValueError):
    """A configuration, a log, an option or an output folder is not usable (exit code 2)."""

    exit_code = 2


class SizeError(InputError):
    """A run is so large that the user must confirm it."""


class GateError(StereophdError):
    """The run is done, and a figure is beyond the limit that the user set (exit code 1).

    `report` is that of the run, which has been written, or None.
    """

    exit_code = 1

    def __init__(self, message: str, report: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.report = report


# Letters from which on the beginning of a name stands for it.
LEAST_LETTERS = 2


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ``; did you mean NAME?``, or ``; expected one of ...`` where no known name is near."""
    names = list(known)
    return did_you_mean(name, names) or (f"; expected one of {', '.join(names)}" if names else "")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``; did you mean NAME?``, or an empty text where no known name is near."""
    close = near_name(name, known)
    return f"; did you mean {close}?" if close else ""


def near_name(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that a misspelt one resembles, else the only one that begins with it, else None."""
    import difflib

    names = list(known)
    if close := difflib.get_close_matches(name, names, n=1, cutoff=0.6):
        return close[0]
    begun = [one for one in names if len(name) >= LEAST_LETTERS and one.startswith(name)]
    return begun[0] if len(begun) == 1 else None


def unknown_camera(name: object, known: Iterable[str], source: str = "") -> str:
    """Return the part of a message that refuses the name of a camera: those known, the name found, one near to it.

    `source`, if given, names the files that the known cameras are of.
    """
    names = list(known)
    of = f" of {source}" if source else ""
    return f"expected one of the cameras {', '.join(names)}{of}, found {name}{did_you_mean(str(name), names)}"
