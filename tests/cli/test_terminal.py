"""Progress on a stderr that is no terminal: a line now and then, none where nothing is asked."""

from __future__ import annotations

import pytest

from stereophd.cli import terminal
from stereophd.cli.options import Session
from stereophd.core.calibration.time_limit import ENDLESS


@pytest.mark.parametrize(("pace", "quiet", "lines"), [(0.0, False, 2), (1e9, False, 0), (0.0, True, 0)])
def test_stages_are_lines_at_a_modest_pace(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pace: float, quiet: bool, lines: int
) -> None:
    monkeypatch.setattr(terminal, "PACE_S", pace)
    with terminal.progress_bar(Session(quiet=quiet), "calibrate") as progress:
        assert ENDLESS.begin("start 1 of at most 8")
        progress(1, 8)
        assert ENDLESS.begin("start 2 of at most 8")
    ENDLESS.begin("after the run")
    shown = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[1] for line in shown] == ["start 1 of at most 8", "start 2 of at most 8"][:lines]
