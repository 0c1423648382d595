"""Camera files of other programs, recognised by their content."""

from __future__ import annotations

from pathlib import Path

from stereophd.io.interchange.base import ForeignRecording, ImportOptions
from stereophd.io.interchange.reading import read_foreign
from stereophd.io.interchange.registry import recognise_cameras


def read_foreign_cameras(path: Path, options: ImportOptions | None = None) -> tuple[str, ForeignRecording] | None:
    """Read a camera file (or folder) of another program; None where the content is of no foreign format.

    Returns the name of the format and the recording. Raises InputError when it is of a foreign format, and cannot be
    read.
    """
    if not path.exists():
        return None
    name = recognise_cameras(path)
    if name is None:
        return None
    return name, read_foreign(name, [path], options or ImportOptions())
