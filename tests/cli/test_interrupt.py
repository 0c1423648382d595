"""Interrupting a run leaves no partial file, and exits with 128 + the signal."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import stereophd.commands.simulate
from stereophd.cli import interrupts
from stereophd.cli.app import run
from stereophd.io.logs.reading import Frame, LogReader

from .conftest import start, write_log

GIVE_UP_S = 120


def test_ctrl_c_in_the_middle_of_a_log(
    config: Path,
    log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    frames = LogReader.__iter__
    seen = []

    def interrupted(self: LogReader) -> Iterator[Frame]:
        for frame in frames(self):
            # the checks read the log first; what counts is a run that has begun to write
            if list(tmp_path.rglob("tracks.parquet")):
                seen.append(frame)
            if len(seen) == 6:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr(LogReader, "__iter__", interrupted)
    assert run(["track", str(config), str(log), "--out", str(tmp_path / "out")]) == 130
    assert len(seen) == 6
    assert not (tmp_path / "out").exists()
    assert capsys.readouterr().err == "interrupted; no output is left half written\n"


def test_ctrl_c_keeps_the_earlier_run(config: Path, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["track", str(config), str(log), "--out", str(tmp_path / "out"), "-q", "--force"]
    assert run(words) == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}

    def interrupted(self: LogReader) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(LogReader, "__iter__", interrupted)
    assert run(words) == 130
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


@pytest.fixture
def installed() -> Iterator[None]:
    """The handlers of the console script, in this process."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before, hook = [signal.getsignal(number) for number in numbers], sys.unraisablehook
    interrupts.install()
    yield
    # Once more, for it forgets the signal that the test sent.
    interrupts.install()
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    sys.unraisablehook = hook


@pytest.mark.usefixtures("installed")
def test_a_second_signal_does_not_disturb_what_the_first_began() -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGTERM)
    assert interrupts.exit_code() == 130


@pytest.mark.usefixtures("installed")
def test_a_signal_in_a_destructor_is_raised_again(capsys: pytest.CaptureFixture[str]) -> None:
    class Library:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    def lose() -> None:
        library = Library()
        del library
        time.sleep(10)

    with pytest.raises(SystemExit) as caught:
        lose()
    assert caught.value.code == 143
    assert capsys.readouterr().err == ""


def test_a_signal_while_the_command_line_is_imported() -> None:
    program = "import os, signal; from stereophd.cli import early; early.handle(); os.kill(os.getpid(), signal.SIGINT)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_got_lost_counts_at_the_next_step(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    steps = []

    def lose(*_: Any, progress: Any, **__: Any) -> None:
        # As in a callback from compiled code, where Python prints and drops exceptions.
        with contextlib.suppress(BaseException):
            signal.raise_signal(number)
        steps.append("after the signal")
        progress(1, 2)
        steps.append("never")

    monkeypatch.setattr(stereophd.commands.simulate, "simulate", lose)
    assert run(["simulate", str(config), "--out", str(tmp_path / "out")]) == 128 + number
    assert steps == ["after the signal"]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_compiled_code_made_into_another_error(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    def disguise(*_: Any, **__: Any) -> None:
        try:
            signal.raise_signal(number)
        except BaseException as error:
            raise SystemError("returned a result with an exception set") from error

    monkeypatch.setattr(stereophd.commands.simulate, "simulate", disguise)
    assert run(["simulate", str(config), "--out", str(tmp_path / "out")]) == 128 + number


def test_a_signal_to_the_process(config: Path, tmp_path: Path) -> None:
    """That one of SIGINT and SIGHUP is handled as this one is what the tests in this process show."""
    # Far more frames than are tracked before the signal comes.
    log = write_log(tmp_path / "long.parquet", frames=10_000, detections=10)
    out = tmp_path / "out"
    process = start("track", config, log, "--out", out)
    try:
        end = time.monotonic() + GIVE_UP_S
        while not list(out.rglob("tracks.parquet")) and process.poll() is None:
            assert time.monotonic() < end, "track did not begin to write"
            time.sleep(0.02)
        assert process.poll() is None, process.communicate()
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=GIVE_UP_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 128 + signal.SIGTERM, err
    assert not out.exists()
    assert err.endswith("interrupted; no output is left half written\n")
    assert "Traceback" not in err


KERNEL = """
import signal, time
from typing import NamedTuple
import numba
from stereophd.cli import interrupts

class Pair(NamedTuple):
    sum: float
    count: int

@numba.njit
def kernel(count):
    total = 0.0
    for k in range(count):
        total += total % (k + 1.5) + 1.0
    return Pair(total, count)

def longer_than(seconds):
    count = 1000
    while True:
        start = time.process_time()
        kernel(count)
        if time.process_time() - start > seconds:
            return count
        count *= 2

def stop():
    raise KeyboardInterrupt

kernel(1)  # compiles
count = longer_than(0.2)
signal.signal(signal.SIGPROF, lambda number, frame: interrupts.outside_kernels(frame, stop))
signal.setitimer(signal.ITIMER_PROF, 0.05)
try:
    kernel(count)
    print("not raised")
except KeyboardInterrupt:
    print("raised")
"""


@pytest.mark.skipif(not hasattr(signal, "SIGPROF"), reason="this system has no timer of processor time")
def test_a_signal_while_a_kernel_makes_a_named_tuple() -> None:
    """Raised there, the exception would end the process by a segmentation fault."""
    done = subprocess.run([sys.executable, "-c", KERNEL], capture_output=True, text=True, timeout=GIVE_UP_S)
    assert (done.returncode, done.stdout, done.stderr) == (0, "raised\n", "")


COMPILER = """
import signal
import numba
from llvmlite.binding import executionengine
from stereophd.cli import interrupts

interrupts.install()
read = executionengine.string_at

def interrupted(*words):
    data = read(*words)
    if b"kernel" in data:
        signal.raise_signal(signal.SIGINT)
    return data

executionengine.string_at = interrupted

@numba.njit(cache=True)
def kernel(count):
    return count + 1

try:
    kernel(1)
    print("not raised")
except KeyboardInterrupt:
    print("raised")
"""


def test_ctrl_c_while_the_compiler_hands_over_a_kernel(tmp_path: Path) -> None:
    """Raised there, the exception would be lost, and the compiler would fail for want of what it compiled."""
    script = tmp_path / "script.py"  # kernels of a file are cached
    script.write_text(COMPILER)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=GIVE_UP_S)
    assert (done.returncode, done.stdout, done.stderr) == (0, "raised\n", "")


def test_a_system_without_posix_calls_runs_commands(config: Path, tmp_path: Path) -> None:
    """Signals, locks, exchanged folders and users that other systems lack have fallbacks."""
    script = """
import ctypes, os, signal, sys
import _signal
for name in ("SIGHUP", "SIGALRM", "SIGPIPE", "SIGQUIT", "setitimer", "ITIMER_REAL"):
    for module in (signal, _signal):
        if hasattr(module, name):
            delattr(module, name)
for name in ("getuid", "geteuid", "pread", "sched_getaffinity", "fork"):
    delattr(os, name)
sys.modules.update(dict.fromkeys(("fcntl", "resource", "pwd", "grp")))
import numpy, pyarrow  # they may use what is removed below
class Library(ctypes.CDLL):
    def __init__(self, name, *words, **more):
        if name is None:
            raise TypeError("no library of the system")
        super().__init__(name, *words, **more)
ctypes.CDLL = Library
from stereophd.__main__ import main
config = sys.argv[1]
for words in (
    ["simulate", config, "--out", "scene"],
    ["info", "scene"],
    ["simulate", config, "--force", "--out", "scene"],
):
    sys.argv = ["stereophd", *words]
    try:
        main()
    except SystemExit as end:
        print(words[0], "ended with", end.code)
"""
    words = [sys.executable, "-c", script, str(config)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ends = [line for line in done.stdout.splitlines() if "ended with" in line]
    assert ends == ["simulate ended with 0", "info ended with 0", "simulate ended with 0"], done.stderr
    assert (tmp_path / "scene" / "detections.parquet").exists()
