"""Provenance: hashes of the inputs, no paths, and the way into and out of Parquet metadata."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

import stereophd
from stereophd.config.loading import load_config
from stereophd.config.model import Config
from stereophd.errors import InputError
from stereophd.io.outputs.provenance import file_sha256, from_metadata, length_unit, provenance, to_metadata

CONFIG = "units: {length: cm}\nseed: 7\n"


def test_of_a_configuration(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(CONFIG)
    (tmp_path / "log").write_bytes(b"abc")
    loaded = load_config(tmp_path / "config.yaml")
    record = provenance("track", loaded.record, inputs={"log": tmp_path / "log"})
    assert record["version"] == stereophd.__version__
    assert record["command"] == "track"
    assert record["seed"] == 7
    assert record["units"] == {"length": "cm"}
    assert record["config"] == loaded.resolved
    assert record["config_sha256"] == loaded.sha256
    assert record["inputs"] == {
        "config": hashlib.sha256(CONFIG.encode()).hexdigest(),
        "log": hashlib.sha256(b"abc").hexdigest(),
    }
    assert str(tmp_path) not in json.dumps(record)


def test_infinite_settings_are_kept_and_read_again(tmp_path: Path) -> None:
    text = "filter: {kind: pmb, out_of_view_s: .inf, birth: {velocity_std: 1.0, depth_range: [1, 2]}}\n"
    (tmp_path / "config.yaml").write_text(CONFIG + text)
    record = provenance("track", load_config(tmp_path / "config.yaml").record)
    config = Config.model_validate(json.loads(json.dumps(record, allow_nan=False))["config"])
    assert config.filter is not None
    assert config.filter.out_of_view_s == float("inf")


def test_does_not_depend_on_where_files_are(tmp_path: Path) -> None:
    records = []
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.yaml").write_text(CONFIG)
        records.append(provenance("track", load_config(tmp_path / name / f"{name}.yaml").record))
    assert to_metadata(records[0]) == to_metadata(records[1])


def test_metadata_round_trip() -> None:
    record = provenance("evaluate", {"order": 2.0, "cutoff": 20.0}, length_unit="km")
    metadata = to_metadata(record)
    assert from_metadata(metadata) == record
    assert length_unit(metadata) == "km"


@pytest.mark.parametrize("metadata", [None, {}, {b"stereophd": b"not json"}, {b"stereophd": b"[1]"}])
def test_foreign_metadata(metadata: dict[bytes, bytes] | None) -> None:
    assert from_metadata(metadata) is None
    assert length_unit(metadata) is None


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        file_sha256(tmp_path / "nothing")
