"""Foreign formats by name: modules of `stereophd.io.formats` and of plug-ins, imported only when they are used."""

import contextlib
from pathlib import Path

from stereophd.errors import InputError, did_you_mean
from stereophd.io.interchange.base import Format
from stereophd.plugins import import_member, module_names

PACKAGE = "stereophd.io.formats"


def names() -> list[str]:
    """Return the names of all formats; imports none of them."""
    return list(module_names(PACKAGE))


def find(name: str, readable: bool = False) -> Format:
    """Return a format by its name.

    Raises InputError when there is none; it lists all formats, or only those that can be read.
    """
    known = names()
    if name not in known:
        known = [word for word in known if find(word).read is not None] if readable else known
        raise InputError(f"format: expected one of {', '.join(known)}, found {name}{did_you_mean(name.lower(), known)}")
    form: Format = import_member(PACKAGE, name).FORMAT
    return form


def description(name: str) -> str:
    """Return what the module of a format says of it; empty of a format that does not exist."""
    return (import_member(PACKAGE, name).__doc__ or "") if name in names() else ""


def recognise_cameras(path: Path) -> str | None:
    """Return the name of the format of a foreign camera file, by its content, or None if there is none."""
    return next((name for name in names() if recognises(find(name), path)), None)


def recognises(form: Format, path: Path) -> bool:
    """Whether a file is of a format; one that its reader cannot parse is not."""
    with contextlib.suppress(Exception):
        return form.recognises_cameras is not None and form.recognises_cameras(path)
    return False
