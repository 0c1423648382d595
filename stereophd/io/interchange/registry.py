"""Foreign formats by name: modules of `stereophd.io.formats` and of plug-ins, imported only when they are used.

Every error of a reader in a malformed file becomes an `InputError`.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from stereophd.errors import InputError, did_you_mean
from stereophd.io.documents import expecting
from stereophd.io.file_kinds import PARQUET, kind_of_file
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.documents.text_tables import header_of
from stereophd.io.interchange.documents.toml_cameras import read_toml
from stereophd.io.logs.rows import REQUIRED
from stereophd.plugins import import_member, module_names

Ability = TypeVar("Ability")

PACKAGE = "stereophd.io.formats"
# Cameras that are farther from each other were probably calibrated in another unit than metres, which are assumed.
MOST_METRES = 200.0


def names() -> list[str]:
    """Return the names of all formats; imports none of them."""
    return list(module_names(PACKAGE))


def find(name: str) -> Format:
    """Return a format by its name; InputError when there is none."""
    return find_able(name, lambda form: form)[0]


def find_able(name: str, ability: Callable[[Format], Ability | None]) -> tuple[Format, Ability]:
    """Return a format by its name, and what it is able to do, such as its reader.

    Raises InputError when there is none that is, and lists those that are.
    """
    known = names()
    if name in known:
        form: Format = import_member(PACKAGE, name).FORMAT
        if (able := ability(form)) is not None:
            return form, able
    known = [word for word in known if ability(import_member(PACKAGE, word).FORMAT) is not None]
    raise InputError(f"format: expected one of {', '.join(known)}, found {name}{did_you_mean(name.lower(), known)}")


def description(name: str) -> str:
    """Return the docstring of the module of a format; empty if the format does not exist."""
    return (import_member(PACKAGE, name).__doc__ or "") if name in names() else ""


def recognise_cameras(path: Path) -> str | None:
    """Return the name of the format of a foreign camera file, by its content, or None if there is none."""
    return next((name for name in names() if recognises(find(name), path)), None)


def recognises(form: Format, path: Path) -> bool:
    """Whether a file is of a format; one that its reader cannot parse is not."""
    with contextlib.suppress(Exception):
        return form.recognises_cameras is not None and form.recognises_cameras(path)
    return False


def read_foreign(form: str, sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read files or folders of a foreign format; the pieces of the recording are read as they are consumed.

    Raises InputError for no such format, one for export only, or files that are not of it (also while the pieces are
    consumed).
    """
    found, read = find_able(form, lambda one: one.read)
    for source in sources:
        if kind_of_file(source) != PARQUET:
            continue
        is_log = set(REQUIRED) <= set(header_of(source)[1])
        if is_log or not found.reads_parquet:
            help_ = "a log needs no import" if is_log else "`stereophd import csv` reads tables of any columns"
            raise InputError(f"{source}: expected a file of format {form}, found a Parquet file; {help_}")
    with _reading(form, sources):
        recording = read(sources, options)
    if recording.unit_is_assumed:
        _assume_metres(recording)
    if recording.pieces is not None:
        recording.pieces = _pieces(recording.pieces, form, sources)
    return recording


def _assume_metres(recording: ForeignRecording) -> None:
    """Note that metres are assumed, where there are lengths, and warn where cameras would be far from each other."""
    known = [camera.build(name) for name, camera in recording.cameras.items() if not camera.pose.unknown]
    text = f"{recording.source}: lengths are in metres: neither the file nor `length_unit` names a unit"
    recording.assumed += [text] if known else []
    centers = np.array([camera.pose.center for camera in known]).reshape(-1, 3)
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)[np.triu_indices(len(centers), 1)]
    if apart.max(initial=0.0) > MOST_METRES:
        recording.warnings.append(
            f"cameras are {apart.max():.4g} m apart, the nearest {apart.min():.4g} m, as metres are assumed: if the "
            "board of the calibration was in mm, state `length_unit` mm; if only some centres are, correct the file"
        )


def _pieces(pieces: Iterable[Piece], form: str, sources: Sequence[Path]) -> Iterator[Piece]:
    """Yield pieces; only errors of their reader are translated, not those of the consumer."""
    with _reading(form, sources):
        iterator = iter(pieces)
    while True:
        with _reading(form, sources):
            piece = next(iterator, None)
        if piece is None:
            return
        yield piece


@contextlib.contextmanager
def _reading(form: str, sources: Sequence[Path]) -> Iterator[None]:
    # numbers are checked when they have arrived, whatever a reader makes of them
    with np.errstate(all="ignore"), expecting(f"files of the format {form}", ", ".join(map(str, sources))):
        yield


def read_foreign_cameras(path: Path, options: ImportOptions | None = None) -> tuple[str, ForeignRecording] | None:
    """Read a camera file (or folder) of another program; None where the content is of no foreign format.

    Returns the name of the format and the recording. Raises InputError when it is of a foreign format, and cannot be
    read.
    """
    if not path.exists():
        return None
    name = recognise_cameras(path)
    if name is None:
        if path.suffix.lower() == ".toml":
            read_toml(path)  # no native file is TOML: its error is that of TOML
        return None
    return name, read_foreign(name, [path], options or ImportOptions())
