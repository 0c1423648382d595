"""Camera files of any kind: the native one, or a foreign one that its content shows."""

from __future__ import annotations

from pathlib import Path

from stereophd.config.cameras import CameraConfig
from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording, ImportOptions
from stereophd.io.interchange.registry import find, recognise_cameras


def read_foreign_cameras(path: Path, options: ImportOptions | None = None) -> tuple[str, ForeignRecording] | None:
    """Read a camera file of another program.

    Parameters
    ----------
    path
        The file (or folder).
    options
        What the user states about it.

    Returns
    -------
    tuple or None
        Name of the format and the recording; None where the content is of no foreign format.

    Raises
    ------
    InputError
        It is of a foreign format, and cannot be read.
    """
    if not path.exists():
        return None
    name = recognise_cameras(path)
    if name is None:
        return None
    read = find(name).read
    assert read is not None
    return name, read([path], options or ImportOptions())


def read_camera_file(
    path: Path, options: ImportOptions | None = None
) -> tuple[dict[str, CameraConfig], str, list[str]]:
    """Return the cameras of a native or foreign file, their unit of length, and what was assumed.

    Raises
    ------
    InputError
        As `stereophd.config.loading.load_cameras`, or of the foreign format.
    """
    foreign = read_foreign_cameras(path, options)
    if foreign is not None:
        name, recording = foreign
        assert recording.length_unit is not None
        return recording.cameras, recording.length_unit, [f"{path.name}: read as {name}", *recording.assumed]
    if path.is_dir():
        raise InputError(f"{path}: expected a file of cameras, or a folder that holds one, found a folder without one")
    from stereophd.config.loading import load_cameras

    file = load_cameras(path)
    return dict(file.cameras), file.units.length, []
