"""What becomes of outputs, processes and exit codes when a run is killed, interrupted, run twice or out of room.

    python benchmarks/faults.py [--times 20] [--seed 1] [--only WORD]

Each case is tried some times at random moments of a small run, in a fork of a process that has loaded everything (of
the start `tests/cli/test_interrupt.py` has the signals), and is held if: no file lies in its final place unless
all do; the next run removes what is left over and gives the bytes of an undisturbed run; the exit code is the one that
is documented; no traceback is printed; no process is left alive. Exit code 1 if a case was not held. Needs psutil and a
Unix system.

`benchmarks/kills.py` kills runs in the middle of their work, many times, and resumes them, and
`benchmarks/failing_calls.py` lets each call fail that writes.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil
from small_runs import SmallRun, is_as_before, small_runs

from stereophd.cli import early
from stereophd.cli.app import main as main_of_command_line
from stereophd.cli.app import run as load

PREFIX = ".stereophd-partial-"
GIVE_UP_S = 300
HANDLED = (signal.SIGINT, signal.SIGTERM)


class Forked:
    """A run of the command line in a fork, in a session of its own."""

    def __init__(self, words: list[str], limit: Callable[[], None] | None = None) -> None:
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed by ended)
        # As in the console script, a signal that comes before the command line handles it ends the process at once.
        signal.pthread_sigmask(signal.SIG_BLOCK, HANDLED)
        self.pid, self.returncode = os.fork(), 0
        if self.pid == 0:
            code: object = 3
            try:
                early.handle()
                signal.pthread_sigmask(signal.SIG_UNBLOCK, HANDLED)
                os.setsid()
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                os.dup2(self._said.fileno(), 2)
                if limit is not None:
                    limit()
                sys.argv[1:] = words
                main_of_command_line()
            except SystemExit as end:
                code = end.code
            except BaseException:
                traceback.print_exc()
            finally:
                with contextlib.suppress(OSError, AttributeError):  # no room for the message
                    sys.stderr.flush()
                os._exit(code if isinstance(code, int) else 0)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, HANDLED)

    def is_running(self) -> bool:
        """Whether the run has not ended; it is a zombie then until `ended`."""
        return psutil.Process(self.pid).status() != psutil.STATUS_ZOMBIE

    def send_signal(self, number: int) -> None:
        """Send a signal to the run; nothing happens if it has ended."""
        os.kill(self.pid, number)

    def ended(self) -> str:
        """Wait for the end, set `returncode`, and return the messages."""
        give_up = time.monotonic() + GIVE_UP_S
        while self.is_running():
            if time.monotonic() > give_up:
                raise TimeoutError(f"no end within {GIVE_UP_S} s")
            time.sleep(0.002)
        self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        with self._said as said:
            said.seek(0)
            return said.read()


def finished(words: list[str]) -> tuple[int, str]:
    """Run the command line to its end; return exit code and messages."""
    process = Forked(words)
    said = process.ended()
    return process.returncode, said


def fresh(place: Path) -> Path:
    """Return the place of an output, without what a run left there."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    return place


def files(folder: Path) -> dict[str, bytes]:
    """Return the contents of a folder, without what does not repeat (times)."""
    found = sorted(path for path in folder.rglob("*") if path.is_file()) if folder.exists() else []
    return {str(p.relative_to(folder)): p.read_bytes() for p in found if p.name != "timing.json"}


def alive(group: Sequence[psutil.Process]) -> int:
    """Return how many processes are left after some seconds."""
    _, left = psutil.wait_procs(group, 5)
    return sum(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in left)


def final(found: dict[str, bytes]) -> dict[str, bytes]:
    """Return the files in their final places."""
    return {
        name: text
        for name, text in found.items()
        if not any(part.startswith((PREFIX, "partial-")) for part in Path(name).parts)
    }


def disturb(case: SmallRun, whole: dict[str, bytes], length: float, place: Path, numbers: Sequence[int]) -> str:
    """Send signals at a random moment of a run, then run again; return what was wrong, or nothing."""
    process = Forked(case.command(fresh(place)))
    time.sleep(random.uniform(0.0, length))
    group = [psutil.Process(process.pid)] if process.is_running() else []
    group += group[0].children(recursive=True) if group else []
    for number in numbers:
        process.send_signal(number)
        time.sleep(random.choice([0.0, 0.003, 0.05]))
    said = process.ended()
    wrong = []
    code = process.returncode if process.returncode >= 0 else 128 - process.returncode
    if code not in (0, *(128 + number for number in numbers)):
        wrong.append(f"exit code {code}")
    if "stereophd/" in said and "Traceback" in said:
        wrong.append("traceback")
    if alive(group):
        wrong.append("processes left alive")
    found = final(files(place))
    if not (is_as_before(found, {}, final(whole), True) if case.in_parts else found in ({}, final(whole))):
        wrong.append("partial output")
    code, said = finished(case.next_run(place))
    if code != 0:
        wrong.append(f"the next run ends with {code}: {said[-200:]}")
    elif files(place) != whole:
        wrong.append("the next run gives other files")
    return ", ".join(wrong)


def no_room(case: SmallRun, whole: dict[str, bytes], place: Path) -> str:
    """Let writing fail beyond a random size of a file, over an earlier run; return what was wrong."""
    finished(case.command(fresh(place)))
    most = random.randrange(1, 2 * max(map(len, whole.values())))
    process = Forked(case.command(place, "--force"), lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)))
    said = process.ended()
    if process.returncode not in (0, 2):
        return f"exit code {process.returncode}: {said[-200:]}"
    if not is_as_before(final(files(place)), final(whole), final(whole), case.in_parts):
        return "the earlier run is damaged"
    code, said = finished(case.next_run(place, over=True))  # an experiment keeps its finished runs: it takes them up
    if code != 0:
        return f"the next run ends with {code}: {said[-200:]}"
    return "" if files(place) == whole else "the next run gives other files"


def twice(case: SmallRun, whole: dict[str, bytes], place: Path) -> str:
    """Start two runs of one output; return what was wrong."""
    fresh(place)
    both = [Forked(case.command(place)) for _ in range(2)]
    codes = []
    for process in both:
        process.ended()
        codes.append(process.returncode)
    wrong = [] if sorted(codes) == [0, 2] else [f"exit codes {codes}"]
    if files(place) != whole:
        wrong.append("other files than those of one run")
    return ", ".join(wrong)


def attempts(case: str, attempt: Callable[[], str], times: int) -> int:
    """Try a case some times, print its row of the table, and on stderr what became of each; how many were not held."""
    not_held = 0
    for number in range(1, times + 1):
        wrong = attempt()
        not_held += bool(wrong)
        print(f"  {case}: {number} of {times}: {wrong or 'held'}", file=sys.stderr, flush=True)
    print(f"| {case} | {times} | {times - not_held} |", flush=True)
    return not_held


def main() -> int:
    """Try all cases; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    random.seed(options.seed)
    not_held = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print("| case | tried | held |\n|---|---|---|", flush=True)
        for title, case in small_runs(folder / "inputs").items():
            if options.only.split(":")[0] not in title:
                continue
            place = folder / "place"
            load(case.command(fresh(place)))
            start_s = time.monotonic()
            code, said = finished(case.command(fresh(place)))
            length = time.monotonic() - start_s
            assert code == 0, said
            whole = files(place)
            cases: dict[str, Callable[[], str]] = {}
            for disturbance, numbers in {
                "kill -9": [signal.SIGKILL],
                "Ctrl-C": [signal.SIGINT],
                "Ctrl-C twice": [signal.SIGINT, signal.SIGINT],
                "SIGTERM, then Ctrl-C": [signal.SIGTERM, signal.SIGINT],
            }.items():
                cases[f"{disturbance} at random moments"] = lambda n=numbers: disturb(case, whole, length, place, n)  # type: ignore[misc]  # noqa: B023
            cases["no room on the disk, over an earlier run"] = lambda: no_room(case, whole, place)  # noqa: B023
            cases["two runs into one folder at once"] = lambda: twice(case, whole, place)  # noqa: B023
            for disturbance, attempt in cases.items():
                if options.only not in f"{title}: {disturbance}":
                    continue
                not_held += attempts(f"`{title}`: {disturbance}", attempt, options.times)
    return int(not_held > 0)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
