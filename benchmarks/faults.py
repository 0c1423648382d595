"""What becomes of outputs, processes and exit codes when a run is killed, interrupted, run twice or out of room.

    python benchmarks/faults.py [--times 20] [--seed 1] [--only WORD]

Each case is tried some times at random moments of a small run, and is held if: no file lies in its final place unless
all do; the next run removes what is left over and gives the bytes of an undisturbed run; the exit code is the one that
is documented; no traceback is printed; no process is left alive. Exit code 1 if a case was not held. Needs psutil and a
Unix system.

The cases of `track` with checkpoints, in pieces and of several logs are killed in forks of a process that has loaded
everything, so that the moments fall into the work and not into the start; checkpoints are made every 50 ms there. Each
is killed again and again, `--resume` in between, until it ends, or three times.
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
CALIBRATION = CONFIGS / "paper" / "calibration.yaml"
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
    resumed = ["--resume"] if command.resumes and any(out.glob("partial-*")) else []
    code, said = command.run(out, *(["--force"] if found else resumed))
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
    return "" if files(out) == whole else "the earlier run is damaged"


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


def forked(work: Callable[[], object], kill_after_s: float | None) -> bool:
    """Do work in a fork, killed after a while; return whether it came to its end.

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
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            if code not in (0, -signal.SIGKILL):
                raise RuntimeError(f"exit code {code}")
            return code == 0
        if end is not None and time.monotonic() >= end:
            os.kill(pid, signal.SIGKILL)
            end = None
        time.sleep(0.002)


def killed_and_resumed(work: Callable[[Path, bool], object], whole: Path, length: float, out: Path) -> str:
    """Kill work at random moments and resume it; return what was wrong."""
    shutil.rmtree(out, ignore_errors=True)
    expected, resume = files(whole), False
    for attempt in range(4):
        moment = None if attempt == 3 else random.uniform(0.0, length)
        if forked(lambda: work(out, resume), moment):  # noqa: B023
            break
        resume = True
        for name, text in files(out).items():
            if not any(part.startswith((PREFIX, "partial-")) for part in Path(name).parts) and text != expected[name]:
                return f"{name} is there and is not that of a whole run"
    if files(out) != expected:
        return "the resumed run gives other files"
    if [path for path in out.parent.iterdir() if path.name.startswith(PREFIX)]:
        return "temporary files left behind"
    return ""


def attempts(case: str, attempt: Callable[[], str], times: int) -> int:
    """Try a case some times, print its row of the table, and on stderr what became of each; how many were not held."""
    not_held = 0
    for number in range(1, times + 1):
        wrong = attempt()
        not_held += bool(wrong)
        print(f"  {case}: {number} of {times}: {wrong or 'held'}", file=sys.stderr, flush=True)
    print(f"| {case} | {times} | {times - not_held} |", flush=True)
    return not_held


def resumable_cases(folder: Path) -> dict[str, Callable[[Path, bool], object]]:
    """Return the ways to track that can be resumed, on small scenes."""
    from stereophd.commands.calibrate_logs import calibrate_logs
    from stereophd.commands.simulate import simulate
    from stereophd.commands.track import track
    from stereophd.commands.track_logs import track_logs
    from stereophd.config.loading import load_config
    from stereophd.pipeline.tracking import checkpoint

    checkpoint.KEEP_EVERY_S, checkpoint.MOST_SHARE = 0.05, 1e9
    loaded = load_config(CONFIG, ["simulate.duration_s=4"])
    simulate(loaded, folder / "scenes", runs=3)
    logs = sorted((folder / "scenes").glob("*/detections.parquet"))
    smooth = load_config(CONFIG, ["report.smooth={}", "report.associations=true"])
    cut = {"pieces_s": 1.5, "overlap_s": 0.5}
    scene = [
        "simulate.duration_s=20", "calibration.annealed.starts=2",
        *(f"cameras.{name}.detector.clutter_per_frame=3" for name in ("left", "right")),
    ]  # fmt: skip
    simulate(load_config(CALIBRATION, scene), folder / "calibration")
    unknown = load_config(CALIBRATION, scene, cameras_path=folder / "calibration" / "guess.yaml")
    film = [folder / "calibration" / "detections.parquet"]
    return {
        "track": lambda out, resume: track(loaded, logs[0], out, resume=resume),
        "track --smooth --associations": lambda out, resume: track(smooth, logs[0], out, resume=resume),
        "track --pieces": lambda out, resume: track(loaded, logs[0], out, resume=resume, **cut),
        "track --pieces --smooth": lambda out, resume: track(smooth, logs[0], out, resume=resume, **cut),
        "track of three logs": lambda out, resume: track_logs(loaded, logs, out, resume=resume),
        "calibrate": lambda out, resume: calibrate_logs(unknown, film, out, resume=resume, plots=False),
    }


def try_resumable(options: argparse.Namespace, folder: Path) -> int:
    """Try the cases that can be resumed; return how many attempts were not held."""
    not_held = 0
    for title, work in resumable_cases(folder).items():
        if options.only not in f"{title}: kill -9 and resume":
            continue
        whole, out = folder / title / "whole", folder / title / "out"
        work(folder / title / "warm", False)
        start = time.monotonic()
        forked(lambda: work(whole, False), None)  # noqa: B023
        length = time.monotonic() - start
        case = f"`{title}`: kill -9 at random moments, then `--resume`"
        not_held += attempts(case, lambda: killed_and_resumed(work, whole, length, out), options.times)  # noqa: B023
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
        not_held += try_resumable(options, folder / "resumable")
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
