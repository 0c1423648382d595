"""A configuration that works, and a log of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config

QUICKSTART = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"

# A scene that takes a moment.
SMALL = {"simulate": {"duration_s": 3.0}, "moments": {"samples": 64}}


@pytest.fixture(scope="module")
def base() -> dict[str, Any]:
    """A configuration that works."""
    document: dict[str, Any] = yaml.safe_load(QUICKSTART.read_text(encoding="utf-8"))
    for section, values in SMALL.items():
        document[section] = {**document.get(section, {}), **values}
    return document


@pytest.fixture(scope="module")
def log(base: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of the configuration that works."""
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / "config.yaml").write_text(yaml.safe_dump(base))
    simulate(load_config(folder / "config.yaml"), folder / "out")
    return folder / "out" / "detections.parquet"
