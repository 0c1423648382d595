"""What all fuzz tests share: their budget, changes to a configuration, and commands that must end."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Iterator, Sequence
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings

from stereophd.cli.app import run
from stereophd.cli.interrupts import outside_kernels

from .schema_values import Path as Keys

# Changes that are tried; set by `make fuzz` for hours.
EXAMPLES = int(os.environ.get("STEREOPHD_FUZZ_EXAMPLES", "8"))

# Processor time of a command, s, after which it counts as one that does not end; the first ones compile.
LONGEST_S = 120.0


def budget(examples: int = EXAMPLES) -> settings:
    """Return the settings of a test of this many examples; few of them are the same ones each time."""
    return settings(
        max_examples=examples,
        derandomize=EXAMPLES <= 100,
        database=None,
        phases=[Phase.explicit, Phase.generate],  # to shrink a case takes longer than to find it
        suppress_health_check=list(HealthCheck),
    )


def changed(base: dict[str, Any], changes: Sequence[tuple[Keys, Any]]) -> dict[str, Any]:
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


def outcome(command: list[str], capfd: pytest.CaptureFixture[str], patience_s: float | None = None) -> tuple[int, str]:
    """Run a command in this process; return its exit code, and what it says on stderr.

    One that does not end is ended, with exit code 3; with `NoEnd` where the test states its patience.
    """
    capfd.readouterr()
    try:
        with bounded(patience_s or LONGEST_S):
            code = run(command)
    except NoEnd as error:
        if patience_s is not None:
            raise
        return 3, f"{capfd.readouterr().err}{error}"
    return code, capfd.readouterr().err


class NoEnd(BaseException):
    """A command has not ended; no error of a run, which `experiment` would try again."""


@contextlib.contextmanager
def bounded(longest_s: float) -> Iterator[None]:
    """Raise `NoEnd` within what takes more processor time than this (on Unix)."""
    if not hasattr(signal, "SIGPROF"):
        yield
        return

    def end() -> None:
        raise NoEnd(f"no end after {longest_s:g} s of processor time")

    before = signal.signal(signal.SIGPROF, lambda _number, frame: outside_kernels(frame, end))
    signal.setitimer(signal.ITIMER_PROF, longest_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
