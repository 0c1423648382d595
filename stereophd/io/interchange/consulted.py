"""Which of the options that a user states a format makes use of: one that nothing reads would silently do nothing."""

from __future__ import annotations

from typing import Any, TypeVar

from stereophd.errors import InputError
from stereophd.io.interchange.base import ExportOptions, ImportOptions

Options = TypeVar("Options", ImportOptions, ExportOptions)


def consulted(options: Options) -> tuple[Options, set[str]]:
    """Return options that note what is read of them, and the names noted so far."""
    read: set[str] = set()

    class Noted(type(options)):  # type: ignore[misc]
        def __getattribute__(self, name: str) -> Any:
            read.add(name)
            return super().__getattribute__(name)

    noted: Options = Noted(**vars(options))
    return noted, read


def refuse_unread(options: Options, read: set[str], what: str) -> None:
    """Refuse options that differ from their defaults and that nothing has read.

    Parameters
    ----------
    options
        As the user stated them.
    read
        Names of those that were read, from `consulted`.
    what
        What was read or written, such as "a source of format mot".

    Raises
    ------
    InputError
        Names the first of them.
    """
    for name in options.plain():
        if name not in read:
            raise InputError(f"`{name}`: expected an option that {what} has a use for, found one that it has not")
