"""As many cases of `test_commands_and_formats` as there is time for, in forks of a process that has loaded everything.

    python -m tests.fuzz.campaign [--minutes 60] [--cases 200000] [--seed 1] [--keep FOLDER]

Each fork tries a batch of cases that hypothesis draws from one seed. A fork that dies, or says nothing for a minute, is
a case that is not held, and so is any case whose result is wrong. Prints each of them as it is found, in a form that
`cases.tried` takes, and at the end a table: cases, exit codes, mean time, by use. Exit code 1 if a case was not held.
Needs a Unix system.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import resource
import select
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings

from .cases import Case, cases, tried
from .valid_files import USES, write_all

# Cases of a fork; longest silence, s; memory that a case may take, bytes.
BATCH, SILENCE_S, MEMORY = 250, 90.0, 6_000_000_000


def batch(folder: Path, number: int, pipe: int) -> None:
    """Try the cases of a seed; a line of JSON for each, before and after it."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))

    @seed(number)
    @settings(
        max_examples=BATCH,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=cases(folder))
    def attempt(case: Case) -> None:
        os.write(pipe, json.dumps(["begun", case.use, repr(case)]).encode() + b"\n")
        start = time.monotonic()
        result = tried(case, folder)
        text = result.wrong or ("ended" if result.ended else "")
        line = ["done", case.use, result.code, round(time.monotonic() - start, 4), bool(result.wrong), text]
        os.write(pipe, json.dumps(line).encode() + b"\n")

    attempt()


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
        wrong.append(f"{last}: no end within {SILENCE_S:g} s, kernels and libraries included")
    elif status and time.monotonic() <= until:
        wrong.append(f"{last}: the process ended with {status} (seed {number})")
    return wrong


def main() -> int:
    """Try as many cases as there is time for; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--cases", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
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
        while time.monotonic() < until and sum(row["cases"] for row in table.values()) < options.cases:
            for case in watched(folder, number, table, until):
                print(f"not held: {case}", flush=True)
                wrong.append(case)
            number += 1
            if number % 20 == 0:
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
