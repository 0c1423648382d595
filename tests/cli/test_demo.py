"""`stereophd demo`: the quickstart from inside the package, and the commands that its last lines print."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from stereophd.commands.demo import config_text

CONFIGS = Path(__file__).parents[2] / "configs"


def test_the_demo_and_what_it_prints_run(
    call: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the folder of an earlier demonstration, as `make demo` runs, which may be of another version."""
    short = re.sub(r"duration_s: [\d.]+", "duration_s: 2.0", config_text())
    monkeypatch.setattr("stereophd.commands.demo.config_text", lambda: short)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my demo").mkdir()
    (tmp_path / "my demo" / "config.yaml").write_text(config_text().replace("seed: 1", "seed: 2"))
    (tmp_path / "my demo" / "report.html").write_text("earlier")
    outcome = call("demo", "my demo", "--force")
    assert outcome.code == 0, outcome.err
    assert re.match(r"\d tracks; median error ", outcome.out)
    assert (tmp_path / "my demo" / "report.html").stat().st_size > 1e6
    commands = [shlex.split(line) for line in outcome.out.splitlines() if line.startswith("  stereophd ")]
    assert [words[1] for words in commands] == ["init", "track"]
    for words in commands:
        following = call(*words[1:])
        assert following.code == 0, following.err
    assert (tmp_path / "my demo" / "study" / "tracks" / "tracks.parquet").exists()


@pytest.mark.parametrize("name", ["config.yaml", "report.html"])
def test_files_that_are_not_of_a_demo_are_never_replaced(call: Callable[..., Any], tmp_path: Path, name: str) -> None:
    """Not even by force, as in `make demo`."""
    (tmp_path / name).write_text("mine")
    for words in ([], ["--force"]):
        outcome = call("demo", str(tmp_path), *words)
        assert outcome.code == 2
        assert f"{name}: expected no file, or that of a demonstration, found another; choose a new" in outcome.err
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "mine")]


def test_a_demo_is_replaced_only_by_force(call: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(config_text())
    outcome = call("demo", str(tmp_path))
    assert outcome.code == 2
    assert "config.yaml: the file exists; use --force to replace it" in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


def test_the_demo_has_the_configuration_of_the_quickstart() -> None:
    assert yaml.safe_load(config_text()) == yaml.safe_load((CONFIGS / "quickstart.yaml").read_text())
    assert "yaml-language-server" not in config_text()
