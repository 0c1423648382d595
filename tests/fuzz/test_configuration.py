"""No configuration ends a command with an internal error, with a warning of a library, or not at all.

A few changes are made to a small configuration that works, each a value for a key of the JSON schema. `make fuzz` tries
many; the suite tries a few, the same ones each time.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stereophd.cli.app import run
from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config

from .schema_values import leaves, near_bounds

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SCHEMA = json.loads((CONFIGS / "schema.json").read_text(encoding="utf-8"))
KEYS = sorted({path: node for path, node in leaves(SCHEMA) if path}.items(), key=lambda item: item[0])

# Changes that are tried; set by `make fuzz` for hours.
EXAMPLES = int(os.environ.get("STEREOPHD_FUZZ_EXAMPLES", "8"))
BUDGET = settings(
    max_examples=EXAMPLES,
    derandomize=EXAMPLES <= 100,
    database=None,
    suppress_health_check=list(HealthCheck),
)

# Processor time of a command, s, after which it counts as one that does not end; the first ones compile.
LONGEST_S = 120.0

# A scene that takes a moment.
SMALL = {"simulate": {"duration_s": 3.0}, "moments": {"samples": 64}}

CHANGES = st.lists(
    st.sampled_from(KEYS).flatmap(lambda item: st.tuples(st.just(item[0]), near_bounds(item[1]))),
    min_size=1,
    max_size=3,
)


@pytest.fixture(scope="module")
def base() -> dict[str, Any]:
    """A configuration that works."""
    document: dict[str, Any] = yaml.safe_load((CONFIGS / "quickstart.yaml").read_text(encoding="utf-8"))
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


def changed(base: dict[str, Any], changes: list[tuple[tuple[str, ...], Any]]) -> dict[str, Any]:
    """Return the document with some values replaced."""
    document: dict[str, Any] = json.loads(json.dumps(base))
    for path, value in changes:
        place = document
        for part in path[:-1]:
            if not isinstance(place.get(part), dict):
                place[part] = {}
            place = place[part]
        place[path[-1]] = value
    return document


def outcome(command: list[str], capfd: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Run a command in this process; return its exit code, and what it says on stderr.

    One that does not end is ended by an error, which becomes exit code 3.
    """
    capfd.readouterr()
    with bounded(LONGEST_S):
        code = run(command)
    return code, capfd.readouterr().err


@contextlib.contextmanager
def bounded(longest_s: float) -> Iterator[None]:
    """Raise an error within what takes more processor time than this (on Unix)."""
    if not hasattr(signal, "SIGPROF"):
        yield
        return

    def end(_number: int, _frame: object) -> None:
        raise RuntimeError(f"no end after {longest_s:g} s of processor time")

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, longest_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def test_what_does_not_end_is_found(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound on processor time ends a command, and its exit code is one that the other tests refuse."""

    def endless(*_: object) -> None:
        while True:
            pass

    monkeypatch.setattr("stereophd.commands.info.info", endless)
    monkeypatch.setattr(sys.modules[__name__], "LONGEST_S", 0.2)
    code, said = outcome(["info", "."], capfd)
    assert code == 3
    assert "no end after 0.2 s" in said


@BUDGET
@given(changes=CHANGES)
def test_a_configuration_is_usable_or_an_input_error(
    base: dict[str, Any], log: Path, capfd: pytest.CaptureFixture[str], changes: list[tuple[tuple[str, ...], Any]]
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
