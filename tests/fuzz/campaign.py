"""As many cases of `test_commands_and_formats` as there is time for, in forks of a process that has loaded everything.

    python -m tests.fuzz.campaign [--minutes 60] [--cases 200000] [--seed 1] [--keep FOLDER]

Each fork tries a batch of cases that hypothesis draws from one seed, each on its own: the search of `given`, which
repeats parts of what it has seen, took a third of the time, and most of its cases were near-copies. A fork that dies,
takes more processor time for a case than the limit, or says nothing for minutes, is a case that is not held, and so is
any case whose result is wrong. Prints each of them as it is found, in a form that `cases.tried` takes, keeps one file
for each kind of mistake, and at the end prints a table: cases, exit codes, mean processor time, by use. Exit code 1 if
a case was not held. Needs a Unix system.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import hashlib
import json
import os
import re
import resource
import select
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from random import Random

from hypothesis.control import BuildContext
from hypothesis.internal.conjecture.data import ConjectureData

from stereophd.cli import terminal

from .cases import Case, cases, tried
from .valid_files import USES, write_all

# Cases of a fork; processor time of a case, kernels and libraries included, s; longest silence, s (the machine may be
# busy); memory that a case may take, bytes.
BATCH, LONGEST_S, SILENCE_S, MEMORY = 250, 60, 600.0, 6_000_000_000


def batch(folder: Path, number: int, pipe: int) -> None:
    """Try the cases of a seed; a line of JSON for each, before and after it."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    terminal.prepare_memory()  # once: it takes as long as the rest of a case
    terminal.prepare_memory = lambda: None
    strategy = cases(folder)
    for k in range(BATCH):
        data = ConjectureData(random=Random(f"{number} {k}"))
        with BuildContext(data, wrapped_test=batch):
            case = data.draw(strategy)
        os.write(pipe, json.dumps(["begun", case.use, repr(case)]).encode() + b"\n")
        start = time.process_time()
        resource.setrlimit(resource.RLIMIT_CPU, (int(start) + LONGEST_S, resource.RLIM_INFINITY))
        result = tried(case, folder)
        text = result.wrong or ("ended" if result.ended else "")
        line = ["done", case.use, result.code, round(time.process_time() - start, 4), bool(result.wrong), text]
        os.write(pipe, json.dumps(line).encode() + b"\n")


def watched(folder: Path, number: int, table: dict[str, Counter[str]], until: float) -> list[str]:
    """Run a batch in a fork; count its cases, and return those that are not held."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        code = 1
        try:
            batch(folder, number, writing)
            code = 0
        finally:
            os._exit(code)
    os.close(writing)
    wrong, rest, last = [], b"", ""
    while True:
        ready = select.select([reading], [], [], SILENCE_S)[0]
        data = os.read(reading, 1 << 16) if ready else b""
        if not data or time.monotonic() > until:
            break
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            kind, use, *found = json.loads(line)
            if kind == "begun":
                last = found[0]
                continue
            code, taken_s, is_wrong, text = found
            count = table[use]
            count.update({"cases": 1, str(code): 1, "ms": round(1000 * taken_s)})
            if is_wrong:
                wrong.append(f"{last}: {text}")
            elif text:
                print(f"  ended after a while: {last}", file=sys.stderr, flush=True)
            last = ""
    os.close(reading)
    if time.monotonic() > until or not ready:
        os.kill(pid, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if not ready:
        wrong.append(f"{last}: nothing said within {SILENCE_S:g} s")
    elif status and time.monotonic() <= until:
        wrong.append(f"{last}: the process ended with {status} (seed {number})")
    return wrong


def keep(folder: Path, case: str) -> None:
    """Print a case that is not held, and keep it in the file of its kind of mistake."""
    print(f"not held: {case}", flush=True)
    said = re.sub(r"[\d.+-]+", "0", case.partition("again=")[2].strip().splitlines()[-1])
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{hashlib.sha256(said.encode()).hexdigest()[:12]}.txt").open("a", encoding="utf-8") as file:
        file.write(f"{case}\n\n")


def main() -> int:
    """Try as many cases as there is time for; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--cases", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-cases"))
    options = parser.parse_args()
    until = time.monotonic() + 60.0 * options.minutes
    table: dict[str, Counter[str]] = defaultdict(Counter)
    wrong: list[str] = []
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as name:
        folder = write_all(Path(name, "valid"))
        for use in USES:  # what the cases load and compile, the forks have
            tried(Case(use, 0.0, (), (), False), folder)
        gc.freeze()
        number = options.seed
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with contextlib.suppress(KeyboardInterrupt):  # an end from outside: the table of what ran
            while time.monotonic() < until and sum(row["cases"] for row in table.values()) < options.cases:
                for case in watched(folder, number, table, until):
                    wrong.append(case)
                    keep(options.keep, case)
                number += 1
                if number % 4 == 0:
                    print(f"  {sum(row['cases'] for row in table.values())} cases", file=sys.stderr, flush=True)
    print("| use | cases | exit 0 | exit 2 | other | ms a case |\n|---|---|---|---|---|---|")
    table["all"] = sum(table.values(), Counter())
    for use, row in sorted(table.items()):
        other = row["cases"] - row["0"] - row["2"]
        print(
            f"| {use} | {row['cases']} | {row['0']} | {row['2']} | {other} | {row['ms'] / max(row['cases'], 1):.0f} |"
        )
    print(f"{len(wrong)} not held; seeds {options.seed} to {number - 1}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
