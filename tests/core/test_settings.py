"""How parameters are declared, and how kinds are found."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest

from stereophd.core.motion.settings import motion_models
from stereophd.core.settings import Positive, members, parameter, settings


@settings
class Example:
    """An example."""

    needed: Positive = parameter("is required", unit="px")
    optional: Positive = parameter("has a default", default=2.0, advice="choose it well")
    listed: list[int] = parameter("has a default of its own", default_factory=list)


def test_settings_are_frozen_and_given_by_name() -> None:
    example = Example(needed=1.0)
    assert (example.needed, example.optional, example.listed) == (1.0, 2.0, [])
    with pytest.raises(dataclasses.FrozenInstanceError):
        example.needed = 2.0  # type: ignore[misc]
    with pytest.raises(TypeError, match="needed"):
        Example()  # type: ignore[call-arg]


def test_a_declaration_carries_meaning_unit_and_advice() -> None:
    needed, optional, _ = dataclasses.fields(Example)
    assert needed.metadata["description"] == "is required"
    assert needed.metadata["json_schema_extra"] == {"unit": "px"}
    assert optional.metadata["json_schema_extra"] == {"advice": "choose it well"}


def test_members_are_found_by_the_name_of_their_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "zoo_of_settings"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "lion.py").write_text("SETTINGS = 'roars'")
    (package / "keeper.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    assert dict(members("zoo_of_settings")) == {"lion": "roars"}
    for name in [name for name in sys.modules if name.startswith("zoo_of_settings")]:
        monkeypatch.delitem(sys.modules, name)


@pytest.mark.parametrize("word", sorted(motion_models()))
def test_every_motion_model_has_the_word_of_its_module(word: str) -> None:
    kind = motion_models()[word]
    assert kind.__module__ == f"stereophd.core.motion.{word}"
    model = next(field for field in dataclasses.fields(kind) if field.name == "model")  # type: ignore[arg-type]
    assert model.default == word
    assert all(field.metadata["description"] for field in dataclasses.fields(kind))  # type: ignore[arg-type]
