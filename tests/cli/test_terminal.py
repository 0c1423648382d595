"""Progress on a stderr that is no terminal: a line now and then, none where nothing is asked."""

from __future__ import annotations

import time

import pytest

from stereophd.cli import terminal
from stereophd.cli.options import Session
from stereophd.core.calibration.time_limit import ENDLESS, within
from stereophd.core.numerics.compilation.kernel_cache import note_compilation

GIVE_UP_S = 60.0


def _printed(capsys: pytest.CaptureFixture[str], count: int) -> list[str]:
    """The lines on stderr, once there are so many."""
    text, end = "", time.monotonic() + GIVE_UP_S
    while text.count("\n") < count and time.monotonic() < end:
        time.sleep(0.01)
        text += capsys.readouterr().err
    return text.splitlines()


def test_the_stage_is_a_line_now_and_then_also_while_it_reports_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal, "PACE_S", 0.05)
    with terminal.progress_bar(Session(), "calibrate") as progress:
        assert ENDLESS.begin("start 1 of at most 8")
        assert all("start 1 of at most 8" in line for line in _printed(capsys, 3))
        progress(1, 8)
        assert _printed(capsys, 3)[-1].endswith(" s: start 1 of at most 8, 12 % done")
        within("search for the optimum, step 7")
        assert _printed(capsys, 3)[-1].endswith(" s: start 1 of at most 8: search for the optimum, step 7")
        assert ENDLESS.begin("tracks are made with the cameras")
        assert _printed(capsys, 3)[-1].endswith(" s: tracks are made with the cameras")
    capsys.readouterr()
    ENDLESS.begin("after the run")
    time.sleep(0.2)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("pace", "quiet"), [(1e6, False), (0.01, True)])
def test_no_lines_of_a_short_run_or_where_none_are_wanted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pace: float, quiet: bool
) -> None:
    monkeypatch.setattr(terminal, "PACE_S", pace)
    with terminal.progress_bar(Session(quiet=quiet), "calibrate"):
        ENDLESS.begin("start 1 of at most 8")
        time.sleep(0.1)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("session", "shown"), [(Session(), "compiling kernels"), (Session(quiet=True), "")])
@pytest.mark.parametrize("with_bar", [True, False])
def test_that_kernels_are_compiled_is_said_at_once_and_once(
    capsys: pytest.CaptureFixture[str], session: Session, shown: str, with_bar: bool
) -> None:
    note_compilation.cache_clear()
    with terminal.progress_bar(session, "track") if with_bar else terminal.stages_shown(session):
        note_compilation()
        note_compilation()
        assert [line.split(":")[0] for line in capsys.readouterr().err.splitlines()] == ([shown] if shown else [])
