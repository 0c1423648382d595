"""Kill -9 in the middle of the work, again and again: what is left, and what the next run makes of it.

    python benchmarks/kills.py [--kills 50] [--seed 1] [--only WORD] [--group]

Each case is a small run of a command, made in a fork of a process that has loaded everything, so that the moments fall
into the work and not into the start. It is killed at a random moment, up to three times in a row, with `--resume` in
between where the command has it, and then runs to its end. `--group` kills its workers with it. Checkpoints are made
several times a second. A case passes if

- after a kill no file lies in its final place, or all do, with the bytes of an undisturbed run;
- no process and no shared memory of the killed run is left after 5 s;
- after the last run the files are those of an undisturbed run, and nothing else is left in the folder or beside it.

Prints a table with the number of kills. Exit code 1 if a case was not held. Needs psutil and a Unix system.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psutil
from faults import PREFIX, alive, files
from small_runs import CALIBRATION, EXPERIMENT, QUICKSTART, SmallRun, small_runs

# Most kills in a row before a run may come to its end.
MOST_KILLS = 3

# Seconds between two states that are kept; a whole run of `track` takes some tenths of a second.
OFTEN_S = 0.02

# Rows of a group of a table, and bytes of a part: few, so that runs of seconds have several.
ROW_GROUP_ROWS = 200
PART_BYTES = 20_000

# Where the shared memory of worker processes lies.
SHARED_MEMORY = Path("/dev/shm")

# Does the work into a folder; the second argument: after a kill.
Work = Callable[[Path, bool], object]


@dataclass(frozen=True)
class Case:
    """A run that is killed.

    Attributes
    ----------
    work : callable
    keeps : tuple of str
        Beginnings of the names, in the folder or beside it, that an unfinished run may leave for the next one.
    in_parts : bool
        Whether files come into their places one after the other, as those of several logs.
    alone : callable, optional
        The same work in one process: what it loads, the forks have.
    """

    work: Work
    keeps: tuple[str, ...] = (PREFIX, "partial-")
    in_parts: bool = False
    alone: Work | None = None


def forked(
    work: Callable[[], object], kill_after_s: float | None, kill: Callable[[int, int], None] = os.kill
) -> tuple[bool, str]:
    """Do work in a fork, killed after a while; return whether it came to its end, and what was left running.

    The fork has an output of its own, and leaves by `os._exit`: nothing of this process is tidied up twice.
    """
    pid = os.fork()
    if pid == 0:
        os.setpgid(0, 0)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    end = None if kill_after_s is None else time.monotonic() + kill_after_s
    group: list[psutil.Process] = []
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            break
        if end is not None and time.monotonic() >= end:
            group = psutil.Process(pid).children(recursive=True)
            kill(pid, signal.SIGKILL)
            end = None
        time.sleep(0.002)
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, -signal.SIGKILL):
        raise RuntimeError(f"exit code {code}")
    if code == 0:
        return True, ""
    if alive(group):
        return False, "processes left alive"
    if any(re.search(rf"(?<!\d){pid}(?!\d)", path.name) for path in SHARED_MEMORY.glob("*")):
        return False, "shared memory left behind"
    return False, ""


def check_killed(case: Case, expected: dict[str, bytes], out: Path) -> str:
    """Return what is wrong with the folder of a killed run."""
    found = {
        name: text
        for name, text in files(out).items()
        if not any(part.startswith(case.keeps) for part in Path(name).parts)
    }
    for name, text in found.items():
        if text != expected.get(name):
            return f"{name} is there and is not that of a whole run"
    if found and found != expected and not case.in_parts:
        return "a part of the files is there"
    return ""


def killed_and_resumed(
    case: Case, expected: dict[str, bytes], length_s: float, out: Path, kill: Callable[[int, int], None]
) -> tuple[int, int, str]:
    """Kill work at random moments and resume it.

    Returns
    -------
    tuple (int, int, str)
        Number of kills, of those that left a checkpoint, and what was wrong.
    """
    kept = 0
    shutil.rmtree(out.parent, ignore_errors=True)
    out.parent.mkdir(parents=True)
    for kills in range(MOST_KILLS + 1):
        moment = None if kills == MOST_KILLS else random.uniform(0.0, length_s)
        ended, wrong = forked(lambda: case.work(out, kills > 0), moment, kill)  # noqa: B023
        if ended:
            break
        wrong = wrong or check_killed(case, expected, out)
        kept += any(out.glob("**/*.saved"))
        if wrong:
            return kills + 1, kept, wrong
    if files(out) != expected:
        return kills, kept, "the resumed run gives other files"
    # the lock file of the folder stays beside nothing: it lies in the folder, and is removed with the run
    left = sorted(path.name for path in out.parent.iterdir() if path != out)
    return kills, kept, f"left behind: {', '.join(left)}" if left else ""


def _of_words(small: SmallRun) -> Case:
    """Return the run of a command line; its output, file or folder, lies in the folder that is looked at."""

    def work(out: Path, again: bool) -> None:
        from stereophd.cli.app import run

        out.mkdir(parents=True, exist_ok=True)
        if code := run(small.next_run(out) if again else small.command(out)):
            raise RuntimeError(f"exit code {code}")

    return Case(work)


def cases(folder: Path) -> dict[str, Case]:
    """Return the runs, on small scenes."""
    from stereophd.commands.batches import track_logs
    from stereophd.commands.calibrate import calibrate
    from stereophd.commands.experiment import experiment
    from stereophd.commands.simulate import simulate
    from stereophd.commands.track import track
    from stereophd.config.loading import load_config
    from stereophd.io.outputs import saved
    from stereophd.io.tables import writing as table_writing
    from stereophd.pipeline.runs import unfinished

    table_writing.ROW_GROUP_ROWS = ROW_GROUP_ROWS
    unfinished.KEEP_EVERY_S, unfinished.MOST_SHARE = OFTEN_S, 1e9
    saved.PART_BYTES = PART_BYTES
    loaded = load_config(QUICKSTART, ["simulate.duration_s=5"])
    simulate(loaded, folder / "scenes", runs=3)
    logs = sorted((folder / "scenes").glob("*/detections.parquet"))
    smooth = load_config(QUICKSTART, ["report.smooth={}", "report.associations=true"])
    three = load_config(QUICKSTART, ["report.associations=true"])
    cut = {"pieces_s": 2.0, "overlap_s": 0.5}
    scene = [
        "simulate.duration_s=20", "calibration.annealed.starts=2",
        *(f"cameras.{name}.detector.clutter_per_frame=3" for name in ("left", "right")),
    ]  # fmt: skip
    simulate(load_config(CALIBRATION, scene), folder / "calibration")
    unknown = load_config(CALIBRATION, scene, cameras_path=folder / "calibration" / "guess.yaml")
    film = folder / "calibration" / "detections.parquet"
    figure = load_config(EXPERIMENT, ["experiment.runs=20"])
    many = load_config(QUICKSTART, ["simulate.duration_s=10"])
    others = ("evaluate", "evaluate-cameras", "import", "export csv", "export colmap", "report", "init")
    return {
        "track": Case(lambda out, again: track(loaded, logs[0], out, resume=again)),
        "track --associations": Case(lambda out, again: track(three, logs[0], out, resume=again)),
        "track --smooth --associations": Case(lambda out, again: track(smooth, logs[0], out, resume=again)),
        "track --pieces": Case(lambda out, again: track(loaded, logs[0], out, resume=again, **cut)),
        "track --pieces --jobs 2": Case(
            lambda out, again: track(loaded, logs[0], out, resume=again, jobs=2, **cut),
            alone=lambda out, again: track(loaded, logs[0], out, **cut),
        ),
        "track of three logs": Case(lambda out, again: track_logs(loaded, logs, out, resume=again), in_parts=True),
        "calibrate": Case(lambda out, again: calibrate(unknown, film, out, resume=again, jobs=1, plots=False)),
        "calibrate --jobs 2": Case(
            lambda out, again: calibrate(unknown, film, out, resume=again, jobs=2, plots=False),
            alone=lambda out, again: calibrate(unknown, film, out, jobs=1, plots=False),
        ),
        "experiment --jobs 2": Case(
            lambda out, again: experiment(figure, out, jobs=2, resume=again),
            alone=lambda out, again: experiment(figure, out),
        ),
        "simulate --runs 4": Case(lambda out, again: simulate(many, out, runs=4, force=again)),
        "simulate --runs 4 --jobs 2": Case(
            lambda out, again: simulate(many, out, runs=4, jobs=2, force=again),
            alone=lambda out, again: simulate(many, out, runs=4),
        ),
        **{title: _of_words(run) for title, run in small_runs(folder / "small").items() if title in others},
    }


def main() -> int:
    """Try all cases; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    parser.add_argument("--group", action="store_true")
    options = parser.parse_args()
    random.seed(options.seed)
    faults = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        title = "| case | kills | of them with a checkpoint | runs with them | held | whole run, s |"
        print(f"{title}\n|---|---|---|---|---|---|", flush=True)
        for title, case in cases(folder / "inputs").items():
            if options.only not in title:
                continue
            whole = folder / title / "whole"
            (case.alone or case.work)(folder / title / "warm", False)
            start = time.monotonic()
            forked(lambda: case.work(whole, False), None)  # noqa: B023
            length_s = time.monotonic() - start
            expected = files(whole)
            tried = held = killed = kept = 0
            while killed < options.kills:
                kill = os.killpg if options.group else os.kill
                kills, resumed, wrong = killed_and_resumed(case, expected, length_s, folder / "runs" / "out", kill)
                tried, held, killed, kept = tried + 1, held + (not wrong), killed + kills, kept + resumed
                print(f"  {title}: {killed} kills: {wrong or 'held'}", file=sys.stderr, flush=True)
            faults += tried - held
            print(f"| `{title}` | {killed} | {kept} | {tried} | {held} | {length_s:.1f} |", flush=True)
    return int(faults > 0)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
