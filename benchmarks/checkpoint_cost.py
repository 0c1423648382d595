"""Processor time that the checkpoints of `track` cost, on the paper's scene of six objects.

    python benchmarks/checkpoint_cost.py [--duration 1000] [--pairs 5] [--every 60] [--filters pmb phd]
                                         [--set KEY=VALUE]

Tracks one log with and without checkpoints, in turn, in one process, on one thread. A pair is one run of each, and
which of the two comes first changes from pair to pair. Prints, of each filter, processor time per event, the number of
checkpoints of a run, and the share of the time that they take: the mean over the pairs with its 95 % interval, and what
was counted inside the calls that write them. Ends with 1 if the mean is above 1 %. `--every` is the wall time between
two checkpoints, s.

The paper's scene lasts 100 s with one frame a second. Here it has 30 frames a second and slower objects, so that they
stay in view for hours.
"""

from __future__ import annotations

# First: it sets the number of threads.
from common import PAPER_CONFIG

# isort: split
import argparse
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pyarrow.parquet as pq
from scipy.stats import t as student

from stereophd.commands import track as command
from stereophd.commands.simulate import simulate
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.pipeline.tracking import checkpoint
from stereophd.pipeline.tracking.checkpoint import RecordJournal
from stereophd.pipeline.tracking.table_journal import TableJournal

SCENE = ("simulate.frame_rate_hz=30", "simulate.objects.velocity_std=0.001", "simulate.objects.box.z=[80,200]")
MOST_SHARE = 0.01


def main() -> int:
    """Measure all filters; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=1000.0)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--every", type=float, default=60.0)
    parser.add_argument("--filters", nargs="+", default=["pmb", "phd"])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    checkpoint.KEEP_EVERY_S = options.every
    missed = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        changes = [*SCENE, f"simulate.duration_s={options.duration:g}"]
        simulate(load_config(PAPER_CONFIG, changes), folder / "scene")
        simulate(load_config(PAPER_CONFIG, [*changes, "simulate.duration_s=20"]), folder / "short")
        log = folder / "scene" / "detections.parquet"
        print("| filter | us/event | checkpoints a run | share of the pairs | counted inside |\n|---|---|---|---|---|")
        for kind in options.filters:
            loaded = load_config(PAPER_CONFIG, [*changes, f"filter.kind={kind}", *options.set])
            # loads and compiles
            command.track(loaded, folder / "short" / "detections.parquet", folder / "out", force=True)
            missed |= measured(kind, loaded, log, folder / "out", options.pairs) > MOST_SHARE
    return int(missed)


def measured(kind: str, loaded: LoadedConfig, log: Path, out: Path, pairs: int) -> float:
    """Measure one filter, print its row, and return the mean share of its pairs."""
    events = pq.read_table(log, columns=["camera", "frame"]).group_by(["camera", "frame"]).aggregate([]).num_rows
    shares, inside, plain_s, checkpoints = [], [], [], 0
    for number in range(pairs):
        seconds = {}
        for kept in (True, False) if number % 2 else (False, True):
            counted: dict[str, Any] = {"states": 0, "seconds": 0.0}
            with counting(counted) if kept else without_checkpoints():
                start = time.process_time()
                command.track(loaded, log, out, force=True)
                seconds[kept] = time.process_time() - start
            if kept:
                inside.append(counted["seconds"] / seconds[True])
                checkpoints += counted["states"]
        shares.append(seconds[True] / seconds[False] - 1.0)
        plain_s.append(seconds[False])
        print(f"  {kind}: {seconds[False]:.1f} s without, {shares[-1]:+.2%}, inside {inside[-1]:.3%}", flush=True)
    mean = statistics.mean(shares)
    half = student.ppf(0.975, pairs - 1) * statistics.stdev(shares) / math.sqrt(pairs) if pairs > 1 else math.nan
    print(
        f"| {kind} | {statistics.mean(plain_s) / events * 1e6:.0f} | {checkpoints / pairs:g} "
        f"| {mean:+.2%} +- {half:.2%} | {statistics.mean(inside):.3%} |",
        flush=True,
    )
    return mean


@contextmanager
def without_checkpoints() -> Iterator[None]:
    """Track as if the log were piped through: no journal, and the tables are written by Arrow alone."""
    with patch.object(command, "open_journal", lambda *_: None):
        yield


@contextmanager
def counting(counted: dict[str, Any]) -> Iterator[None]:
    """Count the states that are kept, and the processor time of all calls of a journal for a record."""
    with ExitStack() as stack:
        for kind in (RecordJournal, TableJournal):
            stack.enter_context(patch.object(kind, "add", _timed(kind.add, counted)))
            stack.enter_context(patch.object(kind, "_keep", _counted(kind._keep, counted)))
        yield


def _timed(work: Callable[..., None], counted: dict[str, Any]) -> Callable[..., None]:
    def timed(*arguments: Any) -> None:
        start = time.process_time()
        work(*arguments)
        counted["seconds"] += time.process_time() - start

    return timed


def _counted(work: Callable[..., None], counted: dict[str, Any]) -> Callable[..., None]:
    def one_more(*arguments: Any) -> None:
        counted["states"] += 1
        work(*arguments)

    return one_more


if __name__ == "__main__":
    raise SystemExit(main())
