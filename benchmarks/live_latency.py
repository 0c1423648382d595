"""Latency of `stereophd track CONFIG -`: from the moment a frame is sent to the moment its row can be read.

    python benchmarks/live_latency.py
    python benchmarks/live_latency.py --scene fifty --minutes 10 --plot latency.png
    python benchmarks/live_latency.py --speed 20 --minutes 60

Two scenes in a room of 8 x 8 x 2.5 m, whose objects come and go: six objects before two cameras of 50 Hz, and fifty
before eight of 100 Hz; the cameras are not synchronised, 5 false detections a frame. A process of its own sends each
frame at its time, by its own clock, whether or not the tracker is ready (the pipes hold a second of frames); this
process stamps each row as it reads it. Both clocks are the monotonic one of the machine. Beside the latencies it states
the processor time of the tracker for each frame, which other programs on the machine change little, and its resident
memory at the beginning, in the middle and at the end (Linux). The tracker's own summary, with percentiles of the
processor time of a frame, goes to standard error.

The control is a third process, which does nothing but sleep for a millisecond again and again: where it wakes late, the
machine has halted, and not the tracker. Below the table are its halts, and the spells in which frames took long, at
their times of the run. Percentiles come with all frames, and without those from a halt of the control until a row came
within the target of the median again.
"""

from __future__ import annotations

import argparse
import array
import json
import math
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from many_objects import room

from stereophd.commands.simulate import check_simulation
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.arrays import Array, Booleans
from stereophd.core.numerics.random_streams import RUN_FRAMES, RUN_OBJECTS
from stereophd.core.simulation.detections import simulate_frames
from stereophd.io.streams.messages import Message
from stereophd.pipeline.simulation import build_scene

SCENES = {"six": (6, 2, 50.0), "fifty": (50, 8, 100.0)}  # objects, cameras, Hz
LIFETIME_S, CLUTTER = 20.0, 5.0
PERCENTILES = (50.0, 90.0, 99.0, 99.9, 100.0)
TARGETS_MS = {50.0: 2.0, 99.9: 10.0}
MEMORY_ROWS = 20
# What Linux lets a pipe hold, bytes: some second of frames.
PIPE_BYTES = 1 << 20
# Sleep of the control, s, and what it must be late by to have been halted; longest halts and spells that are shown.
NAP_S, HALT_S, SHOWN = 1e-3, 5e-3, 8


def scene(objects: int, cameras: int, rate_hz: float, duration_s: float) -> dict[str, Any]:
    """Return the configuration of a scene."""
    config = room(objects, 1, cameras)
    for number, camera in enumerate(config["cameras"].values()):
        camera["detector"]["clutter_per_frame"] = CLUTTER
        camera |= {"frame_rate_hz": rate_hz * (1.0 + 1e-4 * number), "phase_s": number / (cameras * rate_hz)}
    config["simulate"] |= {"duration_s": duration_s, "frame_rate_hz": rate_hz}
    config["simulate"]["objects"] |= {"births_per_s": objects / LIFETIME_S, "mean_lifetime_s": LIFETIME_S}
    return config


def write_frames(loaded: LoadedConfig, path: Path) -> int:
    """Write the frames of a scene: the time and the message, a line each; return their number."""
    check_simulation(loaded)
    drawn = build_scene(loaded.config, loaded.build_cameras(), RUN_OBJECTS.seed(loaded.config.seed, 0))
    count = 0
    with open(path, "w", encoding="utf-8") as stream:
        for frame in simulate_frames(drawn, RUN_FRAMES.seed(loaded.config.seed, 0)):
            camera = drawn.cameras[frame.camera].name
            message = Message(camera, frame.frame, round(frame.log_time_s, 9), np.round(frame.pixels, 3))
            stream.write(f"{frame.log_time_s!r}\t{message.to_line()}\n")
            count += 1
    return count


def send(frames: Path, stamps: Path, speed: float) -> None:
    """Send every frame to standard output at its time; keep when it was due, and when it was sent."""
    due, sent = array.array("d"), array.array("d")
    with open(frames, "rb") as stream:
        began_s = time.monotonic()
        for line in stream:
            time_s, _, message = line.partition(b"\t")
            due.append(began_s + float(time_s) / speed)
            time.sleep(max(due[-1] - time.monotonic(), 0.0))
            sent.append(time.monotonic())
            sys.stdout.buffer.write(message)
            sys.stdout.buffer.flush()
    with open(stamps, "wb") as target:
        due.tofile(target)
        sent.tofile(target)


def nap() -> None:
    """Sleep until standard input ends; print the begin and the length of each sleep that was too long by a halt."""
    woke_s = time.monotonic()
    while not select.select([sys.stdin], [], [], NAP_S)[0]:
        slept_s, woke_s = woke_s, time.monotonic()
        if woke_s - slept_s > NAP_S + HALT_S:
            print(f"{slept_s!r} {woke_s - slept_s!r}", flush=True)


def measure(name: str, minutes: float, speed: float, options: Sequence[str]) -> dict[str, Any]:
    """Track a scene as it is sent; return the latencies (ms) and what the tracker used."""
    with tempfile.TemporaryDirectory() as folder:
        config, frames, stamps = (Path(folder) / each for each in ("scene.yaml", "frames.txt", "stamps"))
        config.write_text(json.dumps(scene(*SCENES[name], 60.0 * minutes)), encoding="utf-8")
        count = write_frames(load_config(config), frames)
        itself = [sys.executable, __file__]
        tracking = [sys.executable, "-m", "stereophd", "track", str(config), "-", *options]
        piped = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "pipesize": PIPE_BYTES}
        # a tracker that is ready before the first frame
        tracker: Any = subprocess.Popen(tracking, stderr=subprocess.PIPE, **piped)
        while b'"ready"' not in (line := tracker.stderr.readline()):
            if not line:
                raise SystemExit(f"{name}: the tracker ended before it was ready")
        control: Any = subprocess.Popen([*itself, "--nap"], **piped)
        words = [*itself, "--send", str(frames), str(stamps), "--speed", str(speed)]
        source = subprocess.Popen(words, stdout=tracker.stdin)
        tracker.stdin.close()
        begun_s, stolen_s = _cpu_s(tracker.pid), _stolen_s()
        arrived, memory, cpu_s = array.array("d"), [], begun_s
        for _ in tracker.stdout:
            arrived.append(time.monotonic())
            if len(arrived) % max(count // MEMORY_ROWS, 1) == 0:
                memory.append(_resident_mb(tracker.pid))
                cpu_s = _cpu_s(tracker.pid)
        source.wait()
        stolen_s = _stolen_s() - stolen_s
        halts = np.array(control.communicate()[0].split(), dtype=float).reshape(-1, 2)
        print(tracker.stderr.read().decode().splitlines()[-1], file=sys.stderr, flush=True)
        tracker.wait()
        due, sent = np.fromfile(stamps).reshape(2, -1)
    if not len(sent) == len(arrived) == count:
        raise SystemExit(f"{name}: expected a row for each of {count} frames, found {len(arrived)}")
    return {
        "sent_s": sent - due[0],
        "latency_ms": 1e3 * (np.asarray(arrived) - sent),
        "late_ms": 1e3 * (sent - due),
        "halts": halts - (due[0], 0.0),
        "stolen_s": stolen_s,
        "cpu_ms_per_frame": 1e3 * (cpu_s - begun_s) / count,
        "resident_mb": memory,
    }


def spells(measured: dict[str, Any], longer_ms: float) -> list[tuple[float, float, float]]:
    """Return begin (s), length (s) and largest latency (ms) of the spells in which frames took longer than this."""
    slow = np.concatenate([[False], measured["latency_ms"] > longer_ms, [False]])
    edges = np.flatnonzero(slow[1:] != slow[:-1]).reshape(-1, 2)
    times, values = measured["sent_s"], measured["latency_ms"]
    return [(float(times[i]), float(times[j - 1] - times[i]), float(values[i:j].max())) for i, j in edges.tolist()]


def outside_halts(measured: dict[str, Any]) -> Booleans:
    """Return which frames were not sent from a halt of the control until a row came within the median's target."""
    times, kept = measured["sent_s"], np.ones(len(measured["sent_s"]), dtype=bool)
    quick = measured["latency_ms"] <= TARGETS_MS[50.0]
    for begin_s, length_s in measured["halts"].tolist():
        # a frame may wait already when the halt begins
        first = int(np.searchsorted(times, begin_s - 1e-3 * TARGETS_MS[99.9]))
        after = int(np.searchsorted(times, begin_s + length_s))
        again = np.flatnonzero(quick[after:])
        kept[first : after + int(again[0]) if len(again) else None] = False
    return kept


def _longest(intervals: Sequence[Sequence[float]]) -> str:
    """Return the longest of intervals (their begin, s, comes first, and their size, ms, last), in order of time."""
    chosen = sorted(sorted(intervals, key=lambda each: -each[-1])[:SHOWN])
    return ", ".join(f"{each[0]:.2f} s: {each[-1]:.0f} ms" for each in chosen) or "none"


def _cpu_s(pid: int) -> float:
    """Processor time of a process, user and system, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


def _stolen_s() -> float:
    """Processor time that the host of a virtual machine gave to others, s."""
    return int(Path("/proc/stat").read_text().split()[8]) / 100.0


def _resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 1e6


def plot(latencies: dict[str, Array], path: Path) -> None:
    """Draw the histograms."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=(6.0, 3.4), layout="constrained")
    edges = np.geomspace(0.1, max(100.0, *(values.max() for values in latencies.values())), 120)
    for name, values in latencies.items():
        panel.hist(values, bins=edges, histtype="step", label=f"{name}: {len(values)} frames")
    panel.set(xscale="log", yscale="log", xlabel="from a frame to its row, ms", ylabel="frames")
    panel.axvline(TARGETS_MS[99.9], color="tab:red", linewidth=0.8)
    panel.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 0 if the targets are met, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--minutes", type=float, default=1.0, help="of the scene (default 1)")
    parser.add_argument("--speed", type=float, default=1.0, help="times as fast as the cameras (default 1)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="write the histograms (needs matplotlib)")
    parser.add_argument("--send", type=Path, nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--nap", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--track", nargs=argparse.REMAINDER, default=[], help="further options of `track`")
    options = parser.parse_args(arguments)
    if options.send or options.nap:
        if options.send:
            send(*options.send, options.speed)
        else:
            nap()
        return 0
    met, latencies = True, {}
    print("| scene | frames | " + " | ".join(f"p{p:g}, ms" for p in PERCENTILES) + " | CPU ms a frame | resident, MB |")
    print("|---|---|" + "---|" * (len(PERCENTILES) + 2))
    for name in options.scene:
        found = measure(name, options.minutes, options.speed, options.track)
        latencies[name] = values = found["latency_ms"]
        memory = found["resident_mb"]
        middle, most = memory[len(memory) // 2], max(memory)
        cost = f"{found['cpu_ms_per_frame']:.2f} | {memory[0]:.0f}, {middle:.0f}, {memory[-1]:.0f} (most {most:.0f})"
        for label, kept in ((name, np.ones(len(values), dtype=bool)), (f"{name}, no halts", outside_halts(found))):
            percentiles = np.percentile(values[kept], PERCENTILES).tolist() if kept.any() else [math.nan] * 5
            cells = " | ".join(f"{value:.2f}" for value in percentiles)
            print(f"| {label} | {kept.sum()} | {cells} | {cost} |", flush=True)
            if label == name:
                met = met and all(percentiles[PERCENTILES.index(p)] <= most for p, most in TARGETS_MS.items())
        halts, slow = found["halts"] * (1.0, 1e3), spells(found, TARGETS_MS[99.9])
        print(
            f"\n{name}: the control was halted {len(halts)} times, for {halts[:, 1].sum() / 1e3:.2f} s in all "
            f"({_longest(halts.tolist())}); the host took {found['stolen_s']:.1f} s; the sender was late by "
            f"{np.percentile(found['late_ms'], 99.9):.1f} ms for 99.9 % and {found['late_ms'].max():.1f} ms at most.\n"
            f"{name}: {len(slow)} spells beyond {TARGETS_MS[99.9]:g} ms, {sum(each[1] for each in slow):.2f} s in all "
            f"({_longest(slow)}).\n",
            flush=True,
        )
    if options.plot is not None:
        plot(latencies, options.plot)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
