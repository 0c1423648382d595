"""Parameters in messages become the options of the command line, and each of these exists."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from stereophd.cli.app import command_line
from stereophd.cli.flags import FLAGS, with_flags

PACKAGE = Path(__file__).parents[2] / "stereophd"


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("use `force=True` to replace it", "use --force to replace it"),
        ("`from_s`: expected a time not after `to_s`", "--from: expected a time not after --to"),
        ("`ospa2_window`: expected 1", "--ospa2-window: expected 1"),
        ("`overrides` a.b=1: unknown key", "--set a.b=1: unknown key"),
        ("expected a section `simulate`", "expected a section `simulate`"),
    ],
)
def test_parameters_become_options(message: str, expected: str) -> None:
    assert with_flags(message) == expected


def messages(tree: ast.Module) -> Iterator[str]:
    """Yield the texts of all errors and of all messages of the log."""
    for node in ast.walk(tree):
        is_message = isinstance(node, ast.Call) and ast.unparse(node.func).startswith("LOGGER.")
        if is_message or isinstance(node, ast.Raise):
            for part in ast.walk(node):
                if isinstance(part, ast.Constant) and isinstance(part.value, str):
                    yield part.value


def test_every_option_exists() -> None:
    commands = command_line().commands.values()
    known = {option for command in commands for parameter in command.params for option in parameter.opts}
    assert set(FLAGS.values()) <= known


def test_every_switch_that_a_message_names_has_an_option() -> None:
    """What a message asks to set (`name=True`) the command line can set, too."""
    named: set[str] = set()
    for path in PACKAGE.rglob("*.py"):
        if "cli" not in path.relative_to(PACKAGE).parts:
            for text in messages(ast.parse(path.read_text())):
                named |= set(re.findall(r"`([a-z0-9_]+)=True`", text))
    assert {"force", "resume"} <= named
    assert named <= set(FLAGS)
