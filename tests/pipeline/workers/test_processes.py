"""Processes of a parallel run end with the one that started them, however it ends."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import psutil
import pytest

from stereophd.core.calibration.time_limit import ENDLESS, within
from stereophd.pipeline.workers.places import on_processes
from stereophd.pipeline.workers.worker_process import WorkersLostError

GIVE_UP_S = 20

SHARED_MEMORY = Path("/dev/shm")

PROGRAM = """
import sys, time
from pathlib import Path
sys.path.insert(0, {folder!r})
from slow import slow
from stereophd.pipeline.workers.places import on_processes
if __name__ == "__main__":
    list(on_processes(slow, [({folder!r}, k) for k in range(4)], 2))
"""

SLOW = """
import os, time
from pathlib import Path
def slow(task):
    folder, number = task
    Path(folder, f"running-{number}").write_text(str(os.getpid()))
    time.sleep(600)
"""


def _square(number: int) -> int:
    return number * number


def _told(number: int) -> int:
    ENDLESS.begin(f"call {number}")
    within("step 2")
    return number


def test_what_workers_do_is_told_meanwhile() -> None:
    """Starts of a calibration ran for minutes on workers without a word."""
    said: list[str] = []
    assert list(on_processes(_told, range(2), 2, tell=said.append)) == [0, 1]
    assert sorted(said) == ["call 0", "call 0: step 2", "call 1", "call 1: step 2"]
    assert list(on_processes(_told, range(2), 2)) == [0, 1]


def _shared_memory(pid: int) -> list[str]:
    """Return the names in shared memory that hold the number of a process."""
    return [path.name for path in SHARED_MEMORY.iterdir() if re.search(rf"(?<!\d){pid}(?!\d)", path.name)]


def _size_and_shared_memory(task: tuple[np.ndarray, int]) -> tuple[int, list[str]]:
    array, parent = task
    return array.size, _shared_memory(parent)


@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason="looks for shared memory in /dev/shm")
def test_workers_use_no_shared_memory() -> None:
    """What is never made cannot be left behind, at whatever moment a process is killed."""
    large = np.zeros(400_000)
    assert list(on_processes(_size_and_shared_memory, [(large, os.getpid())] * 3, 2)) == [(large.size, [])] * 3


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("jobs", [1, 2])
def test_results_of_all_calls(jobs: int, ordered: bool) -> None:
    found = list(on_processes(_square, range(5), jobs, ordered))
    assert (found if ordered else sorted(found)) == [0, 1, 4, 9, 16]


class UnsendableError(Exception):
    """Its pickle cannot be read: it is made with one argument less."""

    def __init__(self, one: int, other: int) -> None:
        super().__init__(one)


def children() -> set[int]:
    """Processes that this one has started, those of other tests too."""
    return {process.pid for process in psutil.Process().children()}


def _odd(number: int) -> int:
    print("a call prints this")
    if number == 3:
        raise ValueError(f"{number} is refused")
    if number == 4:
        raise UnsendableError(1, 2)
    if number == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize(
    ("number", "error", "message"),
    [
        (3, ValueError, "3 is refused"),
        (4, RuntimeError, "UnsendableError"),
        (5, WorkersLostError, "exit code -9"),
    ],
)
def test_a_call_that_fails_ends_all(number: int, error: type[Exception], message: str) -> None:
    before = children()
    with pytest.raises(error, match=message):
        list(on_processes(_odd, [0, 1, number, *range(10, 1000)], 2))
    assert children() <= before


def _wait(number: int) -> int:
    ENDLESS.begin(f"call {number}")
    time.sleep(0.1)
    return number


@pytest.mark.parametrize("ordered", [True, False])
def test_a_closed_iterator_begins_nothing_more(ordered: bool) -> None:
    before = children()
    begun: list[str] = []
    calls = range(GIVE_UP_S * 10)
    with closing(on_processes(_wait, calls, 2, ordered, begun.append)) as results:
        assert next(results) in (0, 1)
    assert children() <= before
    assert 1 <= len(begun) < len(calls)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_parent_leaves_nothing_alive(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    (tmp_path / "program.py").write_text(PROGRAM.format(folder=str(tmp_path)))
    process = subprocess.Popen([sys.executable, str(tmp_path / "program.py")])
    try:
        end = time.monotonic() + GIVE_UP_S
        running = [tmp_path / "running-0", tmp_path / "running-1"]
        while not all(path.exists() and path.read_text() for path in running):
            assert time.monotonic() < end, "the workers did not begin"
            assert process.poll() is None
            time.sleep(0.05)
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 2
        process.send_signal(number)
        process.wait(GIVE_UP_S)
        _, alive = psutil.wait_procs(children, GIVE_UP_S)
        assert not [child for child in alive if child.status() != psutil.STATUS_ZOMBIE]
        assert not _shared_memory(process.pid)
    finally:
        process.kill()
        process.wait()
