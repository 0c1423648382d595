"""Processor time that the checkpoints of `track` cost, on the paper's scene of six objects.

    python benchmarks/checkpoint_cost.py [--duration 1000] [--pairs 5] [--every 60] [--filters pmb phd]
                                         [--set KEY=VALUE]

A pair is two runs of one log in one process, with and without checkpoints. They take turns of 50 events, each in a
thread of its own whose processor time counts, so that both meet the same machine: runs one after the other differ by
several per cent for other reasons. Prints, of each filter, processor time per event, the number of checkpoints of a
run, and the share of the time that they take: the mean over the pairs with its 95 % interval, and what was counted
where row groups and states are written, which leaves out the noise of all other work. Ends with 1 if the mean is above
1 %. `--every` is the time between two checkpoints, s, as of a run that has the machine to itself.

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
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pyarrow.parquet as pq
from scipy.stats import t as student

from stereophd.commands import track as command
from stereophd.commands.simulate import simulate
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.runs import unfinished
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.tracking import unfinished as tracking

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
    # Half of the time is the other run's.
    unfinished.KEEP_EVERY_S = 2.0 * options.every
    unfinished.MOST_SHARE /= 2.0
    missed = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        changes = [*SCENE, f"simulate.duration_s={options.duration:g}"]
        simulate(load_config(PAPER_CONFIG, changes), folder / "scene")
        simulate(load_config(PAPER_CONFIG, [*changes, "simulate.duration_s=20"]), folder / "short")
        log = folder / "scene" / "detections.parquet"
        print("| filter | us/event | checkpoints a run | share of the pairs | counted |\n|---|---|---|---|---|")
        for kind in options.filters:
            loaded = load_config(PAPER_CONFIG, [*changes, f"filter.kind={kind}", *options.set])
            # loads and compiles
            command.track(loaded, folder / "short" / "detections.parquet", folder / "out", force=True)
            missed |= measured(kind, loaded, log, folder / "out", options.pairs) > MOST_SHARE
    return int(missed)


def measured(kind: str, loaded: LoadedConfig, log: Path, out: Path, pairs: int) -> float:
    """Measure one filter, print its row, and return the mean share of its pairs."""
    events = pq.read_table(log, columns=["camera", "frame"]).group_by(["camera", "frame"]).aggregate([]).num_rows
    found = []
    for number in range(pairs):
        found.append(Pair(loaded, log, out).run(number % 2 == 0))
        one = found[-1]
        print(f"  {kind}: {one.seconds[False]:.1f} s without, {one.share:+.2%}, inside {one.inside:.3%}", flush=True)
    mean = statistics.mean(one.share for one in found)
    spread = statistics.stdev(one.share for one in found) if pairs > 1 else math.nan
    half = student.ppf(0.975, pairs - 1) * spread / math.sqrt(pairs)
    each_us = statistics.mean(one.seconds[False] for one in found) / events * 1e6
    states = statistics.mean(one.states for one in found)
    inside = statistics.mean(one.inside for one in found)
    print(f"| {kind} | {each_us:.0f} | {states:g} | {mean:+.2%} +- {half:.2%} | {inside:.3%} |", flush=True)
    return mean


def _kept(*arguments: Any) -> tracking.UnfinishedTracking | None:
    """Keep nothing of the run without checkpoints: Arrow alone writes its tables."""
    return tracking.UnfinishedTracking(*arguments) if threading.current_thread().name == str(True) else None


class Pair:
    """Two runs that take turns.

    Parameters
    ----------
    loaded, log
        What both track.
    out : Path
        Their folders begin so.
    """

    def __init__(self, loaded: LoadedConfig, log: Path, out: Path) -> None:
        self._loaded, self._log, self._out = loaded, log, out
        self._turns = {True: threading.Semaphore(0), False: threading.Semaphore(0)}
        #: Processor time, s, with and without checkpoints.
        self.seconds: dict[bool, float] = {}
        #: Number of states, and the processor time to write row groups and states, s.
        self.states, self.written_s = 0, {True: 0.0, False: 0.0}

    @property
    def share(self) -> float:
        """Processor time that checkpoints add, as a share of the time without."""
        return self.seconds[True] / self.seconds[False] - 1.0

    @property
    def inside(self) -> float:
        """Time to write row groups and states less that of row groups without checkpoints, as such a share."""
        return (self.written_s[True] - self.written_s[False]) / self.seconds[False]

    def run(self, first: bool) -> Pair:
        """Run both; `first` says whether the one with checkpoints begins."""
        threads = [threading.Thread(target=self._track, args=(kept,)) for kept in (True, False)]
        with ExitStack() as stack:
            stack.enter_context(patch.object(command, "UnfinishedTracking", _kept))
            stack.enter_context(patch.object(UnfinishedRun, "save", self._timed(UnfinishedRun.save, state=True)))
            stack.enter_context(patch.object(tracking, "keep_record", self._timed(tracking.keep_record)))
            stack.enter_context(patch.object(TableWriter, "_flush", self._timed(TableWriter._flush)))
            for thread in threads:
                thread.start()
            self._turns[first].release()
            for thread in threads:
                thread.join()
        return self

    def _track(self, kept: bool) -> None:
        threading.current_thread().name = str(kept)
        self._turns[kept].acquire()
        start = time.thread_time()
        out = self._out.with_name(f"{self._out.name} {kept}")
        command.track(self._loaded, self._log, out, force=True, progress=lambda *_: self._pass_on(kept))
        self.seconds[kept] = time.thread_time() - start
        self._turns[not kept].release()

    def _pass_on(self, kept: bool) -> None:
        """Let the other run go on, and wait for the next turn, unless the other is done."""
        if (not kept) not in self.seconds:
            self._turns[not kept].release()
            self._turns[kept].acquire()

    def _timed(self, work: Callable[..., None], state: bool = False) -> Callable[..., None]:
        def timed(*arguments: Any) -> None:
            start = time.thread_time()
            work(*arguments)
            kept = threading.current_thread().name == str(True)
            self.written_s[kept] += time.thread_time() - start
            self.states += state

        return timed


if __name__ == "__main__":
    raise SystemExit(main())
