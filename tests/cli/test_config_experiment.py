"""`config check` of experiments."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereophd.cli.app import run

SWEEP = Path(__file__).resolve().parents[2] / "configs" / "baseline_sweep.yaml"


def test_settings_of_methods_and_cases_are_checked_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["config", "check", str(SWEEP)]) == 0
    text = SWEEP.read_text()
    for right, wrong in (
        ("filter.estimator: {kind: inv", "filter.estimatr: {kind: inv"),
        ("cameras.right.pose", "cameras.rigth.pose"),
    ):
        assert right in text
        path = tmp_path / "wrong.yaml"
        path.write_text(text.replace(right, wrong))
        assert run(["config", "check", str(path)]) == 2
        assert wrong.split(".")[1].split(":")[0] in capsys.readouterr().err
