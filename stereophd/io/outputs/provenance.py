"""Where an output comes from: version, command, configuration, seed and hashes of the inputs.

A provenance is a plain dict without paths and without the time of day, so that the same inputs give
the same bytes. Parquet files carry it as key-value metadata, JSON reports under ``provenance``.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import stereophd
from stereophd.io.documents import expecting
from stereophd.io.outputs.json_text import infinity_as_text

METADATA_KEY = b"stereophd"
LENGTH_UNIT_KEY = b"length_unit"


@dataclass(frozen=True)
class ConfigRecord:
    """The record of a configuration in the provenance."""

    resolved: Mapping[str, Any]  # The resolved configuration as JSON-able values
    sha256: str  # SHA-256 of its `canonical_json`
    inputs: Mapping[str, str]  # Role -> SHA-256 of the files that the configuration names
    seed: int
    length_unit: str


def file_sha256(path: Path | str) -> str:
    """Return the SHA-256 of a file, read in pieces; InputError if the file cannot be read."""
    with expecting("a file", path), open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def origin(path: Path | str) -> dict[str, str] | None:
    """Return the command that made a Parquet file and the SHA-256 of its provenance; None if it carries none.

    All files of one run of `simulate` carry the same provenance, so tracks can be matched with their truth.
    """
    with open(path, "rb") as stream:
        if stream.read(4) != b"PAR1":
            return None
        import pyarrow.parquet as pq  # only here: most commands name no Parquet file that carries a provenance

        from stereophd.io.tables.reading import DAMAGED

        try:
            metadata = pq.read_schema(stream).metadata  # by the stream: names may be no text
        except DAMAGED:
            return None  # The file is damaged; the reader of its rows reports that.
    text = (metadata or {}).get(METADATA_KEY)
    record = from_metadata(metadata)
    if text is None or record is None:
        return None
    return {"command": str(record.get("command")), "sha256": hashlib.sha256(text).hexdigest()}


def canonical_json(value: Any) -> str:
    """Return compact JSON in the order of the keys.

    The keys are not sorted: the order of the cameras decides ties between simultaneous frames and so is part of what is
    recorded. Resolved configurations have the order of the models, not the order of the file.
    """
    return json.dumps(infinity_as_text(value), separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def sha256_of(value: Any) -> str:
    """Return the SHA-256 of the `canonical_json` of a value."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def provenance(
    command: str,
    configuration: ConfigRecord | Mapping[str, Any],
    inputs: Mapping[str, Path | str] | None = None,
    length_unit: str | None = None,
) -> dict[str, Any]:
    """Return the provenance of a run of the command of this name, such as ``track``.

    The configuration is the record of the loaded one, or (of commands without one) their options as JSON-able values;
    it gives the seed, and the default of the unit of length. `inputs`, role -> path, are the files that were read
    besides the configuration's own; only their hashes are kept.

    Returns ``version, command, config, config_sha256, seed, inputs {role: sha256}, origins {role: {command, sha256}},
    units {length}``; an origin is the command that made an input, and the hash of the provenance that it carries.
    """
    hashes = {role: file_sha256(path) for role, path in (inputs or {}).items()}
    origins = {role: origin(path) for role, path in (inputs or {}).items()}
    seed: int | None = None
    if isinstance(configuration, Mapping):
        resolved = dict(configuration)
        digest = sha256_of(resolved)
    else:
        resolved = dict(configuration.resolved)
        digest = configuration.sha256
        hashes = {**configuration.inputs, **hashes}
        seed = configuration.seed
        length_unit = length_unit or configuration.length_unit
    return {
        "version": stereophd.__version__,
        "command": command,
        "config": infinity_as_text(resolved),
        "config_sha256": digest,
        "seed": seed,
        "inputs": dict(sorted(hashes.items())),
        "origins": {role: found for role, found in sorted(origins.items()) if found is not None},
        "units": {"length": length_unit},
    }


def to_metadata(record: Mapping[str, Any]) -> dict[bytes, bytes]:
    """Return Parquet key-value metadata: the record as JSON, and the unit of length separately."""
    metadata = {METADATA_KEY: canonical_json(record).encode()}
    unit = record.get("units", {}).get("length")
    if unit is not None:
        metadata[LENGTH_UNIT_KEY] = str(unit).encode()
    return metadata


def from_metadata(metadata: Mapping[bytes, bytes] | None) -> dict[str, Any] | None:
    """Return the provenance that Parquet metadata carry, or None if there is none (or not ours)."""
    text = (metadata or {}).get(METADATA_KEY)
    if text is None:
        return None
    try:
        record = json.loads(text)
    except ValueError:
        return None
    return record if isinstance(record, dict) else None


def length_unit(metadata: Mapping[bytes, bytes] | None) -> str | None:
    """Return the unit of length that Parquet metadata name, or None."""
    unit = (metadata or {}).get(LENGTH_UNIT_KEY)
    return None if unit is None else unit.decode(errors="replace")
