"""Read files of cameras as YAML trees: native files, and files of other programs, recognised by their content."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path

from stereophd.config.yaml import Tree, parse_yaml, read_yaml
from stereophd.errors import InputError

LOGGER = logging.getLogger("stereophd")


@dataclass(frozen=True)
class CameraTree:
    """The cameras of a file in the native form."""

    tree: Tree  # The content of the file. A complete file has the keys ``units`` and ``cameras``.
    # Whether the file (or its format) states the unit of length; if not, the unit of the configuration is assumed.
    has_unit: bool
    sha256: str  # Hash of the bytes that were read


def read_camera_tree(path: Path) -> CameraTree:
    """Read a file of cameras, native or of another program.

    Raises InputError when the file cannot be read, or its format is unknown.
    """
    refused: InputError | None = None
    native: CameraTree | None = None
    try:
        tree, content = read_yaml(path, "file of cameras")
        native = CameraTree(tree, True, hashlib.sha256(content).hexdigest())
    except InputError as error:
        refused = error
    if native is not None and isinstance(native.tree.data, dict) and {"units", "cameras"} <= native.tree.data.keys():
        return native
    # Imported here: native files do not need the other formats.
    from stereophd.io.interchange.reading import read_foreign_cameras

    foreign = read_foreign_cameras(path)
    if foreign is None:
        if native is None:
            assert refused is not None
            raise refused
        return native
    from stereophd.io.cameras.writing import cameras_text

    form, recording = foreign
    for sentence in (f"read as {form}", *recording.assumed):
        LOGGER.info("%s: %s", path, sentence)
    for sentence in recording.warnings:
        LOGGER.warning("%s", sentence)
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in recording.files)).hexdigest()
    text = cameras_text(recording.cameras, recording.length_unit or "m")
    return CameraTree(parse_yaml(text, str(path), numbered=False), not recording.unit_is_assumed, digest)
