"""Every file of configs/ loads as it stands and carries the line by which editors find its schema."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest

from stereophd.config.loading import json_schema, load_config, schema_text

CONFIGS = Path(__file__).parents[2] / "configs"
DOCS = CONFIGS.parent / "docs"
FILES = sorted(CONFIGS.rglob("*.yaml"))


def test_every_kind_of_configuration_is_there() -> None:
    """A test over `FILES` would pass without any file."""
    names = {path.stem for path in FILES}
    assert {"quickstart", "drone", "multi_object", "single_object", "calibration"} <= names


def test_schema_is_up_to_date() -> None:
    found = (CONFIGS / "schema.json").read_text(encoding="utf-8")
    assert found == schema_text(), "configs/schema.json is out of date: run `make schema`"


def test_every_key_of_the_schema_says_what_it_is() -> None:
    schema = json_schema()
    models = {"": schema, **schema["$defs"]}
    bare = [
        f"{name}.{key}"
        for name, model in models.items()
        for key, value in model.get("properties", {}).items()
        if "description" not in value
    ]
    assert not bare


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(CONFIGS)))
class TestEveryConfiguration:
    def test_names_its_schema(self, path: Path) -> None:
        schema = os.path.relpath(CONFIGS / "schema.json", path.parent)
        first = path.read_text(encoding="utf-8").splitlines()[0]
        assert first == f"# yaml-language-server: $schema={schema}"

    def test_loads_with_cameras(self, path: Path) -> None:
        assert load_config(path).build_cameras()


def test_reference_page_is_up_to_date() -> None:
    """`make reference` writes it from the declarations of the parameters."""
    script = importlib.util.spec_from_file_location("make_configuration", DOCS / "make_configuration.py")
    assert script is not None
    module = importlib.util.module_from_spec(script)
    script.loader.exec_module(module)  # type: ignore[union-attr]
    written = {path.name: path.read_text(encoding="utf-8") for path in module.FOLDER.glob("*.md")}
    assert written == module.pages(), "docs/reference/configuration/ is out of date: run `make reference`"
