"""No damaged file, in any format, and no odd option ends any command with an internal error, or not at all.

Nor does it lose or change anything: inputs stay as they are, an earlier output stays where the new run fails, nothing
is left half written. `python -m tests.fuzz.campaign` tries as many cases as there is time for; the suite tries a few.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereophd.cli.app import app
from stereophd.io.interchange.registry import find, names

from .cases import Case, cases, command_of, tried
from .commands import EXAMPLES, budget
from .damage import Harm
from .valid_files import USES, write_all

# Commands that make their own inputs, compile, or wait for a network.
WITHOUT_FILES = {"demo", "compile", "watch"}


# One of each kind that the campaign found, as it prints them.
FOUND = Path(__file__).with_name("found.cases")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("h5py")
    return write_all(tmp_path_factory.mktemp("valid"))


def test_every_command_and_every_format_is_tried() -> None:
    tried_words = {command_of(use.words)[0] for use in USES.values()}
    assert {one.name for one in app.registered_commands} - tried_words <= WITHOUT_FILES
    read = {name for name in names() if find(name).read is not None}
    assert read == {use.words.split()[1] for use in USES.values() if use.words.startswith("import")}


@pytest.mark.parametrize("use", USES)
def test_the_files_are_valid(folder: Path, use: str) -> None:
    """So that what a change does is tried, and not what was wrong before."""
    result = tried(Case(use, 0.0, (), (), False), folder)
    assert result.code == 0, result
    assert not result.wrong


@pytest.mark.parametrize("text", FOUND.read_text(encoding="utf-8").splitlines())
def test_cases_that_were_found(folder: Path, text: str) -> None:
    result = tried(eval(text, {"Case": Case, "Harm": Harm}), folder)
    assert not result.wrong, result.wrong


@budget(10 * EXAMPLES)
@given(data=st.data())
def test_damaged_files_and_odd_options(folder: Path, data: st.DataObject) -> None:
    case = data.draw(cases(folder))
    result = tried(case, folder)
    assert not result.wrong, result.wrong
