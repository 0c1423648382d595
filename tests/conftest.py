"""Fixtures of all tests: global state is what it was before each of them, so that they hold in any order."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import hypothesis
import numpy as np
import pytest

# No test is timed: the first call of a kernel compiles it, and machines are busy.
hypothesis.settings.register_profile("stereophd", deadline=None)
hypothesis.settings.load_profile("stereophd")

# A shell starts what runs in the background with SIGINT ignored, and nohup with SIGHUP; both would be inherited by
# the processes that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
with contextlib.suppress(AttributeError):  # not on Windows
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

HANDLED_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGXFSZ") if hasattr(signal, name)
)


# The process that compiles the kernels of the filters before several workers start.
LONGEST_COMPILATION_S = 300.0
COMPILING = pytest.StashKey["subprocess.Popen[bytes]"]()


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels of the filters while the workers collect: each of them would compile them by itself.

    One process does so: two that compile from both ends are hardly faster, and take half as much processor time again.
    """
    several = config.getoption("numprocesses", None) and not config.getoption("collectonly")
    if several and not hasattr(config, "workerinput"):
        config.stash[COMPILING] = subprocess.Popen([sys.executable, "-m", "stereophd.cli.app", "compile", "-q"])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Tests begin when the kernels are there."""
    if compiling := node.config.stash.get(COMPILING, None):
        compiling.wait(LONGEST_COMPILATION_S)


def pytest_unconfigure(config: pytest.Config) -> None:
    """A run that ends before its tests began leaves no process behind."""
    if compiling := config.stash.get(COMPILING, None):
        compiling.kill()
        compiling.wait()


@pytest.fixture(autouse=True)
def global_state() -> Iterator[None]:
    """Restore what a command changes for its process: the logger, signals, the environment, the current folder."""
    logger = logging.getLogger("stereophd")
    handlers, level, propagate = logger.handlers, logger.level, logger.propagate
    signals = {number: signal.getsignal(number) for number in HANDLED_SIGNALS}
    environment, folder, errors = dict(os.environ), os.getcwd(), np.geterr()
    yield
    logger.handlers, logger.propagate = handlers, propagate
    logger.setLevel(level)
    for number, handler in signals.items():
        signal.signal(number, handler)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    np.seterr(**errors)


@pytest.fixture
def without_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """`track` in this process does not check its log first, which takes longer than a short run."""
    monkeypatch.setattr("stereophd.commands.track.check_log", lambda *_, **__: ())
