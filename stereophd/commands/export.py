"""Write tracks or cameras as a file of another program."""

from pathlib import Path
from typing import Any

from stereophd.config.loading import read_camera_file
from stereophd.errors import InputError
from stereophd.io.file_kinds import CSV, HDF5, PARQUET, kind_of_file
from stereophd.io.interchange.base import ExportOptions, Format, consulted, refuse_unread
from stereophd.io.interchange.registry import find, find_able, names
from stereophd.io.outputs.atomic import OutputFolder, atomic_write
from stereophd.io.outputs.commit import refuse_unsettled
from stereophd.io.outputs.json_text import REPORT_VERSION
from stereophd.io.outputs.provenance import provenance

TRACKS_FILE, CAMERAS_FILE = "tracks.parquet", "cameras.yaml"


def export(
    form: str, source: Path | str, out: Path | str, options: ExportOptions | None = None, force: bool = False
) -> dict[str, Any]:
    """Export tracks or cameras; the content of the source decides which.

    The form is the name of a module of `stereophd.io.formats`. The source is a ``tracks.parquet``, a native or foreign
    file of cameras, or an output folder that holds one of them. `out` is a file (a folder where the format is one),
    written whole or not at all; the options say which tracks, and at which rate. Returns ``format``, ``what``
    (``tracks`` or ``cameras``), ``file``, ``notes`` (sentences about what the format cannot hold) and ``provenance``.

    Raises InputError for an unknown format or one that holds no such thing, an unusable source, an option for which the
    format has no use, and an existing target without `force`.
    """
    options = options or ExportOptions()
    written, _ = find_able(form, lambda one: one.write_tracks or one.write_cameras)
    path, target = Path(source), Path(out)
    what, path = _find_source(written, form, path)
    if what == "cameras" and (stated := list(options.plain())):
        raise InputError(f"`{stated[0]}`: expected only for tracks, found cameras ({path})")
    _check_target(target, written)
    if what == "tracks":
        assert written.write_tracks is not None
        noted, read, _ = consulted(options)
        with atomic_write(target, replace=force) as temporary:
            notes = written.write_tracks(path, temporary, noted)
            refuse_unread(options, read, f"a file of format {form}")
    else:
        notes = _write_cameras(written, path, target, force)
    inputs = {what: path} if path.is_file() else {}
    return {
        "report_version": REPORT_VERSION,
        "command": "export",
        "format": form,
        "what": what,
        "file": target.name,
        "notes": notes,
        "provenance": provenance("export", {"format": form, **options.plain()}, inputs=inputs),
    }


def _find_source(written: Format, form: str, path: Path) -> tuple[str, Path]:
    """Return whether a source holds tracks or cameras, and the file."""
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    refuse_unsettled(path)
    wants_tracks = written.write_tracks is not None
    if path.is_dir() and wants_tracks and (path / TRACKS_FILE).is_file():
        path = path / TRACKS_FILE
    elif path.is_dir() and (path / CAMERAS_FILE).is_file():
        path = path / CAMERAS_FILE
    found = kind_of_file(path)
    what = "tracks" if found == PARQUET else "cameras"
    if wants_tracks and written.write_cameras is None and found in (CSV, HDF5):
        raise InputError(f"{path}: expected a table of tracks (Parquet file), found {found}")
    if getattr(written, f"write_{what}") is None:
        able = [name for name in names() if getattr(find(name), f"write_{what}") is not None]
        raise InputError(f"{path}: expected a format that holds {what} ({', '.join(able)}), found {form}")
    return what, path


def _check_target(target: Path, written: Format) -> None:
    if target.is_dir() and not written.folder_files:
        raise InputError(f"{target}: expected a file to write, found a folder")
    if not target.parent.is_dir():
        raise InputError(f"{target.parent}: expected a folder, found none")


def _write_cameras(written: Format, path: Path, target: Path, force: bool) -> list[str]:
    assert written.write_cameras is not None
    cameras, unit, assumed = read_camera_file(path)
    if not written.folder_files:
        with atomic_write(target, replace=force) as temporary:
            return [*assumed, *written.write_cameras(cameras, unit, temporary)]
    with OutputFolder(target, written.folder_files, force) as out:
        notes = written.write_cameras(cameras, unit, out.path(written.folder_files[0]).parent)
        for name in written.folder_files:
            if not out.path(name).stat().st_size and (target / name).is_file() and (target / name).stat().st_size:
                raise InputError(f"{target / name}: expected none or an empty file, found content; move it away")
    return [*assumed, *notes]
