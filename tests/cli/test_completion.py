"""Completion of `--set`: keys, words and the names of the configuration on the line."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereophd.cli.completion import complete_set

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"


@pytest.fixture(autouse=True)
def line(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shell's line names the configuration."""
    monkeypatch.setenv("COMP_WORDS", f"stereophd track {CONFIG} log.parquet --set ")


@pytest.mark.parametrize(
    ("incomplete", "expected"),
    [
        ("mot", ["motion."]),
        ("see", ["seed="]),
        ("filter.extraction.c", ["filter.extraction.confirm="]),
        ("filter.birth.v", ["filter.birth.velocity_std="]),
        ("cameras.", ["cameras.left.", "cameras.right.", "cameras.middle."]),
        ("cameras.middle.distortion.", ["cameras.middle.distortion.model=", "cameras.middle.distortion.k1="]),
        ("filter.missed=", ["filter.missed=split", "filter.missed=keep"]),
        ("simulate.object_id=", ["simulate.object_id=true", "simulate.object_id=false"]),
        ("nothing.like", []),
        ("seed=3", []),
    ],
)
def test_what_may_follow(incomplete: str, expected: list[str]) -> None:
    assert complete_set(incomplete) == expected


def test_keys_of_another_kind_of_filter_are_not_offered() -> None:
    keys = complete_set("filter.")
    assert "filter.recycle_below=" in keys
    assert "filter.merge_rule=" not in keys


@pytest.mark.parametrize("text", ["", "stereophd track nothing.yaml --set ", "stereophd track /dev/null.yaml --set "])
def test_without_a_readable_configuration(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("COMP_WORDS", text)
    assert "filter.merge_rule=" in complete_set("filter.m")
    assert complete_set("cameras.") == []
