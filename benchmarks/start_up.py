"""Time that the command line takes outside the filter: `--help`, and a second `stereophd track`.

A run of `stereophd track` is timed as its user sees it, from the start of the process to its end, once
the compiled kernels are in numba's cache and the modules in Python's. The time of the filter is that of
a repeated run within one process, everything loaded; the difference is spent outside the filter: imports,
loading kernels, drawing samples, reading and writing. `-X importtime` says which packages it goes to.

    python benchmarks/start_up.py [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

DEFAULT_CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "multi_object.yaml"
COMMAND = [sys.executable, "-m", "stereophd"]
TARGET_HELP_S = 0.3
TARGET_OUTSIDE_S = 1.5
# Packages that take less than this are not listed.
LISTED_MS = 10.0

# Runs the command several times in one process and prints the time spent in the filter's steps by each.
IN_PROCESS = """
import sys, time
from stereophd.cli.app import run
from stereophd.core.multi.base import DisparityFilter
step, spent = DisparityFilter.step, [0.0]
def timed(*arguments):
    start = time.perf_counter()
    result = step(*arguments)
    spent[0] += time.perf_counter() - start
    return result
DisparityFilter.step = timed
for _ in range(int(sys.argv[1])):
    spent[0] = 0.0
    code = run(sys.argv[2:])
    if code:
        sys.exit(code)
    print(spent[0])
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 0 if the targets are met, else 1."""
    options = _parse(arguments)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package has its bytecode beside it
    help_s = min(_timed([*COMMAND, "--help"])[0] for _ in range(options.repetitions))
    with tempfile.TemporaryDirectory() as folder:
        log = options.log
        if log is None:
            simulated = Path(folder) / "simulated"
            _timed([*COMMAND, "simulate", str(options.config), "--out", str(simulated), "-q"])
            log = simulated / "detections.parquet"
        words = ["track", str(options.config), str(log), "--out", str(Path(folder) / "tracked"), "--force", "-q"]
        if options.cameras is not None:
            words += ["--cameras", str(options.cameras)]
        first_s, _ = _timed([*COMMAND, *words])  # may have to compile
        seconds = [_timed([*COMMAND, *words]) for _ in range(options.repetitions)]
        second_s, second_cpu_s = (min(column) for column in zip(*seconds, strict=True))
        filter_s = _filter_seconds(words, options.repetitions)
        imports = _imports(words)
    report = {
        "help_s": help_s,
        "first_track_s": first_s,
        "second_track_s": second_s,
        "second_track_cpu_s": second_cpu_s,
        "filter_s": filter_s,
        "outside_filter_s": second_s - filter_s,
        "imports_ms": imports,
        "repetitions": options.repetitions,
        "targets": {"help_s": TARGET_HELP_S, "outside_filter_s": TARGET_OUTSIDE_S},
    }
    print(json.dumps(report, indent=2) if options.json else _table(report))
    return 0 if help_s < TARGET_HELP_S and report["outside_filter_s"] < TARGET_OUTSIDE_S else 1


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=DEFAULT_CONFIG, help="with a filter section")
    parser.add_argument("--log", type=Path, help="detection log; default: simulate the config's scene")
    parser.add_argument("--cameras", type=Path, help="cameras.yaml in place of the config's cameras")
    parser.add_argument("--repetitions", type=int, default=5, help="the best counts (default 5)")
    parser.add_argument("--json", action="store_true", help="one JSON document in place of the table")
    return parser.parse_args(arguments)


def _timed(command: list[str]) -> tuple[float, float]:
    """Run a command to its end and return the seconds that it took, and its processor time (s)."""
    before, start = os.times(), time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    wall_s, after = time.perf_counter() - start, os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return wall_s, spent


def _filter_seconds(words: list[str], repetitions: int) -> float:
    """Best time (s) in the filter's steps over a log, when everything is loaded."""
    command = [sys.executable, "-c", IN_PROCESS, str(repetitions + 1), *words]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return min(float(line) for line in output.split()[1:])


def _imports(words: list[str]) -> dict[str, float]:
    """Time (ms) that the modules of each top-level package (and part of scipy) take themselves."""
    command = [sys.executable, "-X", "importtime", *COMMAND[1:], *words]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stderr
    own: dict[str, float] = {}
    for microseconds, name in re.findall(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)", text):
        parts = name.split(".")
        package = ".".join(parts[: 2 if parts[0] == "scipy" else 1])
        own[package] = own.get(package, 0.0) + int(microseconds) / 1e3
    return dict(sorted(own.items(), key=lambda item: -item[1]))


def _table(report: dict[str, Any]) -> str:
    lines = [
        f"stereophd --help        {report['help_s']:.3f} s (target below {TARGET_HELP_S:g})",
        f"first track             {report['first_track_s']:.2f} s",
        f"second track            {report['second_track_s']:.2f} s, processor {report['second_track_cpu_s']:.2f} s, "
        f"best of {report['repetitions']}",
        f"  in the filter         {report['filter_s']:.2f} s",
        f"  outside               {report['outside_filter_s']:.2f} s (target below {TARGET_OUTSIDE_S:g})",
        "imports of the second track, modules' own time under -X importtime (which slows them a little):",
    ]
    lines += [f"  {name:22}{ms:6.0f} ms" for name, ms in report["imports_ms"].items() if ms >= LISTED_MS]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
