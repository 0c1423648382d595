"""Kernels compiled beforehand, and by a second process while a run begins."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from stereophd.cli.app import run
from stereophd.commands import compile
from stereophd.core.multi import build as compiling
from stereophd.errors import InputError
from stereophd.pipeline.workers import compile_ahead


def test_compile_prepares_every_filter(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    prepared: list[str] = []
    monkeypatch.setattr(compile, "prepare", prepared.append)
    assert run(["compile", "--json"]) == 0
    assert prepared == json.loads(capsys.readouterr().out)["filters"] == ["phd", "pmb"]


def test_two_processes_compile_each_filter_from_both_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared: list[tuple[str, bool]] = []
    monkeypatch.setattr(compile, "prepare", lambda kind, last_first: prepared.append((kind, last_first)))
    monkeypatch.setattr(compile, "on_processes", lambda function, tasks, jobs: map(function, tasks))
    assert compile.compile_kernels(2)["filters"] == ["phd", "pmb"]
    assert prepared == [("phd", False), ("phd", True), ("pmb", False), ("pmb", True)]


def test_compile_needs_a_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(compile, "place_to_keep", lambda: None)
    assert run(["compile"]) == 2
    assert "NUMBA_CACHE_DIR" in capsys.readouterr().err


class _Second:
    """In the place of a second process."""

    def __init__(self, nicer: int) -> None:
        self.is_begun = self.is_ended = False
        _SECOND.append(self)

    def start(self, work: Any) -> None:
        self.is_begun = True

    def stop(self) -> None:
        self.is_ended = True


_SECOND: list[_Second] = []


@pytest.mark.parametrize(
    ("kind", "kept", "cores", "begun"),
    [("pmb", False, 2, True), ("phd", False, 2, True), ("pmb", True, 2, False), ("pmb", False, 1, False)]
    + [("single", False, 2, False)],
)
def test_a_second_process_compiles_where_nothing_is_kept(
    monkeypatch: pytest.MonkeyPatch, kind: str, kept: bool, cores: int, begun: bool
) -> None:
    _SECOND.clear()
    monkeypatch.setattr(compile_ahead, "Aside", _Second)
    monkeypatch.setattr(compile_ahead, "is_kept", lambda kernel: kept)
    monkeypatch.setattr(compile_ahead, "processes", lambda jobs: cores)
    with compile_ahead.compiling_ahead(kind) as running:
        (second,) = _SECOND
        assert running is second.is_begun is begun
        assert not second.is_ended
    assert second.is_ended


def test_what_the_second_process_compiles(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """One process a filter and folder: the lock refuses another."""
    prepared: list[tuple[str, bool]] = []
    monkeypatch.setattr(compile_ahead, "place_to_keep", lambda: tmp_path)
    monkeypatch.setattr(compiling, "prepare", lambda kind, last_first: prepared.append((kind, last_first)))
    compile_ahead.compile_from_the_end("pmb")
    assert prepared == [("pmb", True)]
    with pytest.raises(InputError, match="another run"):
        compile_ahead.compile_from_the_end("pmb")


def test_what_both_processes_compile_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    turned: list[bool] = []
    monkeypatch.setattr(compiling, "prepare_turns", lambda: turned.append(True))
    compiling.prepare("pmb", last_first=True)
    kernel = compiling.last_kernel("pmb")
    before = sum(kernel.stats.cache_misses.values())
    compiling.prepare("pmb")
    assert sum(kernel.stats.cache_misses.values()) == before
    assert len(kernel.overloads) == 1
    # either compiles the test for knocked cameras, too
    assert len(turned) == 2
