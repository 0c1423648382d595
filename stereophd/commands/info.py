"""Describe a file or an output folder: its contents and its origin."""

import contextlib
from pathlib import Path
from typing import Any

from stereophd.config.loading import read_camera_file
from stereophd.errors import InputError
from stereophd.io.file_kinds import CSV, HDF5, LOG, PARQUET, kind_of_file, remedy
from stereophd.io.outputs.commit import refuse_unsettled
from stereophd.io.outputs.json_text import read_report
from stereophd.pipeline.inspection.cameras import summarise_cameras
from stereophd.pipeline.inspection.log import summarise_log
from stereophd.pipeline.inspection.tables import kind_of, provenance_of, summarise_objects, summarise_table

# Endings of the files that people write as text: their faults are described as such.
TEXT = (".yaml", ".yml", ".json", ".toml", ".xml", ".txt")


def info(path: Path | str) -> dict[str, Any]:
    """Describe a log, a table, a file of cameras, a configuration, a report, or an output folder.

    Returns ``path``, ``kind`` (``detections``, ``tracks``, ``truth``, ``cameras``, ``configuration``, ``report``,
    ``folder``, or another kind of table), ``origin`` (command, version, seed, hashes; null if unknown), and values that
    depend on the kind. For a folder, ``files`` describes each file in the same way, and ``origin`` is that of its
    report. Raises InputError if the file does not exist, or its kind is unknown.
    """
    source = Path(path)
    if not source.exists():
        raise InputError(f"{source}: there is no such file or folder")
    refuse_unsettled(source)
    if source.is_dir():
        return _folder(source)
    if kind_of_file(source) == PARQUET:
        return _table(source)
    if source.suffix.lower() == ".json" and (report := _report(source)) is not None:
        return report
    return _text(source)


def _origin(record: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return what a record of provenance says about the origin; None if it is not one of stereophd's."""
    if record is None or not isinstance(record.get("config_sha256"), str):
        return None
    if not isinstance(inputs := record.get("inputs") or {}, dict) or not all(
        isinstance(d, str) for d in inputs.values()
    ):
        return None
    return {key: record.get(key) for key in ("command", "version", "seed", "config_sha256", "inputs")}


def _table(path: Path) -> dict[str, Any]:
    kind = kind_of(path)
    head = {"path": str(path), "kind": kind, "origin": _origin(provenance_of(path))}
    if kind == "detections":
        return {**head, **summarise_log(path)}
    if kind in ("tracks", "truth"):
        return {**head, **summarise_objects(path, "track_id" if kind == "tracks" else "object_id")}
    return {**head, **summarise_table(path)}


def _report(path: Path) -> dict[str, Any] | None:
    """Describe a ``report.json``; None if the file is no report."""
    document: dict[str, Any] = {}
    with contextlib.suppress(InputError):
        document = read_report(path) or {}
    if not document:
        return None
    values = {k: v for k, v in document.items() if isinstance(v, (str, int, float)) and k != "report_version"}
    return {"path": str(path), "kind": "report", "origin": _origin(document["provenance"]), "values": values}


def _text(path: Path) -> dict[str, Any]:
    """Describe a configuration or a file of cameras."""
    from stereophd.config.loading import load_config
    from stereophd.config.yaml import read_yaml

    keys: set[str] = set()
    with contextlib.suppress(InputError):
        data = read_yaml(path)[0].data
        keys = set(data) if isinstance(data, dict) else set()
    if keys & {"filter", "motion", "simulate", "experiment", "calibration", "moments"}:
        loaded = load_config(path)
        result = {"path": str(path), "kind": "configuration", "origin": None, "sections": sorted(keys)}
        if loaded.cameras:
            result |= summarise_cameras(loaded.cameras, loaded.config.units.length)
        return {**result, "config_sha256": loaded.sha256, "seed": loaded.config.seed}
    try:
        cameras, unit, assumed = read_camera_file(path)
    except InputError as error:
        if path.is_dir() or path.suffix.lower() in TEXT:
            raise
        known = "a log, a table, cameras, a configuration, report.json or an output folder"
        if (found := kind_of_file(path)) in (CSV, HDF5):
            raise InputError(f"{path}: expected {known}, found {found}{remedy(LOG, found)}") from error
        raise InputError(f"{path}: expected {known}, found none of these; as cameras: {error}") from error
    head = {"path": str(path), "kind": "cameras", "origin": None, "assumed": assumed}
    return {**head, **summarise_cameras(cameras, unit)}


def _folder(path: Path) -> dict[str, Any]:
    """Describe every file of an output folder, and the folder by its report or by its tables."""
    from stereophd.io.interchange.registry import recognise_cameras

    if recognise_cameras(path) is not None:
        return _text(path)
    files: list[dict[str, Any]] = []
    for file in sorted(path.iterdir()):
        if file.name.startswith("."):
            continue
        if file.is_dir():
            files.append({"path": str(file), "kind": "folder"})
            continue
        try:
            files.append(info(file))
        except InputError as error:
            files.append({"path": str(file), "kind": "other", "reason": str(error).splitlines()[0]})
    if not files:
        raise InputError(f"{path}: expected an output folder, found an empty one")
    origins = [file["origin"] for file in files if file.get("origin")]
    return {"path": str(path), "kind": "folder", "origin": origins[0] if origins else None, "files": files}
