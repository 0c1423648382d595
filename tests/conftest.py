"""Fixtures of all tests: global state is what it was before each of them, so that they hold in any order."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import psutil
import pytest

from stereophd.__main__ import OBJECTS_BEFORE_SEARCH
from stereophd.cli import terminal
from stereophd.core.numerics.compilation.kernel_cache import note_compilation

# What is imported and collected is no garbage: a tenth of the time of all tests went into searching it again and again.
gc.set_threshold(OBJECTS_BEFORE_SEARCH)

# No test is timed: the first call of a kernel compiles it, and machines are busy. A slow test prints no progress.
terminal.PACE_S = 1e6
hypothesis.settings.register_profile("stereophd", deadline=None)
hypothesis.settings.load_profile("stereophd")

# No test cuts the power: nothing is gained by waiting for the disk.
os.fsync = lambda descriptor: None

# Bytecode of tests and of what they start is kept, beside which kernels lie already: it took 4 s of every worker.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A shell starts what runs in the background with SIGINT ignored, and nohup with SIGHUP; both would be inherited by
# the processes that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
with contextlib.suppress(AttributeError):  # not on Windows
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

HANDLED_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGXFSZ") if hasattr(signal, name)
)


# The process that compiles the kernels of the filters, which each of several workers would compile by itself.
LONGEST_COMPILATION_S = 300.0
COMPILING = pytest.StashKey["subprocess.Popen[bytes]"]()
# Tests that need no kernel of a filter: they run meanwhile, about as long as the process compiles.
LIGHT = (
    *(f"tests/core/{room}/" for room in ("geometry", "metrics", "numerics", "simulation")),
    *(f"tests/core/calibration/{room}/" for room in ("adjustment", "discovery", "unknowns")),
    *("tests/config/", "tests/io/", "tests/test_documents.py", "tests/test_house.py"),
)


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels of the filters while the workers collect, and do what needs none of them.

    One process does so: two that compile from both ends are hardly faster, and take half as much processor time again.
    """
    several = config.getoption("numprocesses", None) and not config.getoption("collectonly")
    if several and not hasattr(config, "workerinput"):
        compiling = subprocess.Popen([sys.executable, "-m", "stereophd", "compile", "-q"])
        config.stash[COMPILING] = compiling
        threading.Thread(target=compiling.wait, daemon=True).start()  # that it ended shows to the workers


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Tell a worker which process compiles."""
    if compiling := node.config.stash.get(COMPILING, None):
        node.workerinput["compiling"] = compiling.pid


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin both halves of the tests, which two workers take, with files of tests that need no kernels of filters."""
    if "compiling" in getattr(config, "workerinput", {}):
        light = [item for item in items if item.nodeid.startswith(LIGHT)]
        others = [item for item in items if not item.nodeid.startswith(LIGHT)]
        # whole files: each worker makes the fixtures of a module anew
        files = {path: number for number, path in enumerate(dict.fromkeys(item.path for item in light))}
        first, second = ([item for item in light if files[item.path] % 2 == half] for half in (0, 1))
        middle = len(others) // 2
        items[:] = [*first, *others[:middle], *second, *others[middle:]]


def pytest_collection_finish() -> None:
    """Leave what lives as long as the tests out of every search for garbage."""
    gc.freeze()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Wait with the first of the other tests until the kernels are there."""
    if not item.nodeid.startswith(LIGHT):
        compiling = getattr(item.config, "workerinput", {}).pop("compiling", None)
        with contextlib.suppress(psutil.Error):
            if compiling is not None:
                psutil.Process(compiling).wait(LONGEST_COMPILATION_S)


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
    note_compilation()  # on a machine without kept kernels the line of it would come in any test
    yield
    logger.handlers, logger.propagate = handlers, propagate
    logger.setLevel(level)
    for number, handler in signals.items():
        signal.signal(number, handler)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    np.seterr(**errors)


def leave_out_checks(patch: pytest.MonkeyPatch) -> None:
    """Let `track` in this process not check its log first, which takes longer than a short run."""
    patch.setattr("stereophd.commands.track.check_log", lambda *_, **__: ())


@pytest.fixture
def without_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """`track` does not check its log."""
    leave_out_checks(monkeypatch)


def leave_out_rendering(patch: pytest.MonkeyPatch) -> None:
    """Let plots be drawn, but their files be empty: to arrange and render them takes longer than a short run."""
    if find_spec("matplotlib") is not None:
        patch.setattr("stereophd.report.style._lay_out", lambda figure: None)
        patch.setattr("matplotlib.figure.Figure.savefig", lambda figure, path, **options: Path(path).touch())
