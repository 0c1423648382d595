"""No configuration ends a command with an internal error, with a warning of a library, or not at all.

A few changes are made to a small configuration that works, each a value for a key of the JSON schema. `make fuzz` tries
many; the suite tries a few, the same ones each time.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from . import commands
from .commands import budget, changed, outcome
from .schema_values import Path as Keys
from .schema_values import leaves, near_bounds

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SCHEMA = json.loads((CONFIGS / "schema.json").read_text(encoding="utf-8"))
KEYS = sorted({path: node for path, node in leaves(SCHEMA) if path}.items(), key=lambda item: item[0])

CHANGES = st.lists(
    st.sampled_from(KEYS).flatmap(lambda item: st.tuples(st.just(item[0]), near_bounds(item[1]))),
    min_size=1,
    max_size=3,
)


def test_what_does_not_end_is_found(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound on processor time ends a command, and its exit code is one that the other tests refuse."""

    def endless(*_: object) -> None:
        while True:
            pass

    monkeypatch.setattr("stereophd.commands.info.info", endless)
    monkeypatch.setattr(commands, "LONGEST_S", 0.2)
    code, said = outcome(["info", "."], capfd)
    assert code == 3
    assert "no end after 0.2 s" in said


@budget()
@given(changes=CHANGES)
def test_a_configuration_is_usable_or_an_input_error(
    base: dict[str, Any], log: Path, capfd: pytest.CaptureFixture[str], changes: list[tuple[Keys, Any]]
) -> None:
    with tempfile.TemporaryDirectory() as name:
        config = Path(name, "config.yaml")
        config.write_text(yaml.safe_dump(changed(base, changes), allow_unicode=False), encoding="utf-8")
        code, said = outcome(["config", "check", str(config)], capfd)
        assert code in (0, 2), said
        if code == 2:
            assert said.startswith("error: "), said
            return
        for command in (["simulate", str(config)], ["track", str(config), str(log)]):
            code, said = outcome([*command, "--out", str(Path(name, command[0])), "-q"], capfd)
            assert code in (0, 2), f"{command[0]}: {said}"
            assert "Warning" not in said
