"""What becomes of outputs, processes and exit codes when a run is killed, interrupted, run twice or out of room.

    python benchmarks/faults.py [--times 20] [--seed 1] [--only WORD]

Each case is tried some times at random moments of a small run, and is held if: no file lies in its final place unless
all do; the next run removes what is left over and gives the bytes of an undisturbed run; the exit code is the one that
is documented; no traceback is printed; no process is left alive. Exit code 1 if a case was not held. Needs psutil and a
Unix system.

`benchmarks/kills.py` kills runs in the middle of their work, many times, and resumes them.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CONFIG = CONFIGS / "quickstart.yaml"
EXPERIMENT = CONFIGS / "paper" / "figure4.yaml"
PREFIX = ".stereophd-partial-"
GIVE_UP_S = 300


@dataclass(frozen=True)
class Command:
    """A command and the files that it leaves."""

    words: tuple[str, ...]
    resumes: bool = False

    def start(self, out: Path, *more: str, limit: Callable[[], None] | None = None) -> subprocess.Popen[str]:
        """Start it with an output folder."""
        words = [sys.executable, "-m", "stereophd", *self.words, "--out", str(out), "-q", *more]
        return subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=limit, start_new_session=True
        )

    def run(self, out: Path, *more: str) -> tuple[int, str]:
        """Run it to its end; return exit code and messages."""
        process = self.start(out, *more)
        _, said = process.communicate(timeout=GIVE_UP_S)
        return process.returncode, said

    def resuming(self, out: Path) -> list[str]:
        """Return the option with which it continues what an unfinished run has kept, if it has."""
        return ["--resume"] if self.resumes and any(out.glob("partial-*")) else []


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
    return {name: text for name, text in found.items() if not name.startswith((PREFIX, "partial-"))}


def disturb(command: Command, whole: dict[str, bytes], length: float, out: Path, numbers: Sequence[int]) -> str:
    """Send signals at a random moment of a run, then run again; return what was wrong, or nothing."""
    shutil.rmtree(out, ignore_errors=True)
    process = command.start(out)
    time.sleep(random.uniform(0.0, length))
    group = [psutil.Process(process.pid)] if process.poll() is None else []
    group += group[0].children(recursive=True) if group else []
    for number in numbers:
        process.send_signal(number)
        time.sleep(random.choice([0.0, 0.003, 0.05]))
    _, said = process.communicate(timeout=GIVE_UP_S)
    wrong = []
    code = process.returncode if process.returncode >= 0 else 128 - process.returncode
    if code not in (0, *(128 + number for number in numbers)):
        wrong.append(f"exit code {code}")
    if "stereophd/" in said and "Traceback" in said:
        wrong.append("traceback")
    if alive(group):
        wrong.append("processes left alive")
    found = final(files(out))
    if found and found != final(whole):
        wrong.append("partial output")
    code, said = command.run(out, *(["--force"] if found else command.resuming(out)))
    if code != 0:
        wrong.append(f"the next run ends with {code}: {said[-200:]}")
    elif files(out) != whole:
        wrong.append("the next run gives other bytes")
    if [path for path in out.parent.iterdir() if path.name.startswith(PREFIX)]:
        wrong.append("temporary files left behind")
    return ", ".join(wrong)


def no_room(command: Command, whole: dict[str, bytes], out: Path) -> str:
    """Let writing fail beyond a random size of a file, over an earlier run; return what was wrong."""
    shutil.rmtree(out, ignore_errors=True)
    command.run(out)
    most = random.randrange(1, 2 * max(map(len, whole.values())))
    process = command.start(out, "--force", limit=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)))
    _, said = process.communicate(timeout=GIVE_UP_S)
    if process.returncode not in (0, 2):
        return f"exit code {process.returncode}: {said[-200:]}"
    if final(files(out)) != final(whole):
        return "the earlier run is damaged"
    # an experiment keeps its finished runs, which the next one takes up
    code, said = command.run(out, "--force", *command.resuming(out))
    if code != 0:
        return f"the next run ends with {code}: {said[-200:]}"
    return "" if files(out) == whole else "the next run gives other bytes"


def twice(command: Command, whole: dict[str, bytes], out: Path) -> str:
    """Start two runs into one folder; return what was wrong."""
    shutil.rmtree(out, ignore_errors=True)
    both = [command.start(out, "--force") for _ in range(2)]
    codes = []
    for process in both:
        process.communicate(timeout=GIVE_UP_S)
        codes.append(process.returncode)
    wrong = [] if sorted(codes) == [0, 2] else [f"exit codes {codes}"]
    if files(out) != whole:
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
        scene = folder / "scene"
        simulate = Command(("simulate", str(CONFIG)))
        code, said = simulate.run(scene)
        assert code == 0, said
        commands = {
            "simulate": simulate,
            "simulate --runs 4 --jobs 2": Command((*simulate.words, "--runs", "4", "--jobs", "2")),
            "track": Command(("track", str(CONFIG), str(scene / "detections.parquet"))),
            "experiment --jobs 2": Command(
                ("experiment", str(EXPERIMENT), "--jobs", "2", "--set", "experiment.runs=20"), resumes=True
            ),
        }
        print("| case | tried | held |\n|---|---|---|", flush=True)
        for title, command in commands.items():
            if options.only.split(":")[0] not in title:
                continue
            command.run(folder / "warm")
            start = time.monotonic()
            code, said = command.run(folder / title / "whole")
            length = time.monotonic() - start
            assert code == 0, said
            whole, out = files(folder / title / "whole"), folder / title / "out"
            cases: dict[str, Callable[[], str]] = {}
            for case, numbers in {
                "kill -9": [signal.SIGKILL],
                "Ctrl-C": [signal.SIGINT],
                "Ctrl-C twice": [signal.SIGINT, signal.SIGINT],
                "SIGTERM, then Ctrl-C": [signal.SIGTERM, signal.SIGINT],
            }.items():
                cases[f"{case} at random moments"] = lambda n=numbers: disturb(command, whole, length, out, n)  # type: ignore[misc]  # noqa: B023
            cases["no room on the disk, over an earlier run"] = lambda: no_room(command, whole, out)  # noqa: B023
            cases["two runs into one folder at once"] = lambda: twice(command, whole, out)  # noqa: B023
            for case, attempt in cases.items():
                if options.only not in f"{title}: {case}":
                    continue
                not_held += attempts(f"`{title}`: {case}", attempt, options.times)
    return int(not_held > 0)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
