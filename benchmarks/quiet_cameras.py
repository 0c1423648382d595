"""False alarms of the test for knocked cameras, over hours of simulated recordings whose cameras stay where they are.

    python benchmarks/quiet_cameras.py [--hours 24] [--seed 9600] [--piece 900]

Four kinds of scenes in turn, three cameras of 5 Hz that are not synchronised: as in the configuration, with clutter and
missed detections, with motion thrice as hard as the filter knows, and six objects that come and go. Every recording
lasts `--piece` seconds; after an alarm the test begins anew. Ends with 1 if there is an alarm.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import common  # noqa: F401  # one thread

from stereophd.config.loading import load_config
from stereophd.core.disparity.events import make_event
from stereophd.core.numerics.random_streams import RUN_FRAMES, RUN_OBJECTS
from stereophd.core.simulation.detections import simulate_frames
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.simulation import build_scene
from stereophd.pipeline.tracking.knocked import Knock, KnockTest
from stereophd.pipeline.tracking.loop import ReportTimes, RunState, work_event

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "quickstart.yaml"
CAMERAS = "left", "right", "middle"
RATES = (
    *(f"cameras.{name}.frame_rate_hz=5" for name in CAMERAS),
    "cameras.right.phase_s=0.067",
    "cameras.middle.phase_s=0.133",
)
KINDS = {
    "as configured": (),
    "clutter and misses": tuple(
        f"cameras.{name}.detector.{value}" for name in CAMERAS for value in ("clutter_per_frame=5", "p_detect=0.9")
    ),
    "motion thrice as hard": ("simulate.acceleration_std=0.3",),
    "objects that come and go": (
        "simulate.objects.count=6",
        "simulate.objects.births_per_s=0.1",
        "simulate.objects.mean_lifetime_s=60",
    ),
}


def alarms_of(changes: tuple[str, ...], seed: int, duration_s: float) -> list[Knock]:
    """Return the alarms of one recording."""
    loaded = load_config(CONFIG, [f"simulate.duration_s={duration_s}", *RATES, *changes])
    cameras = loaded.build_cameras()
    scene = build_scene(loaded.config, cameras, RUN_OBJECTS.seed(seed, 0))
    estimator = build_filter(loaded.config, cameras, loaded.path, 1)
    run, alarms = RunState(estimator.init()), []
    for frame in simulate_frames(scene, RUN_FRAMES.seed(seed, 0)):
        event = make_event(cameras[frame.camera], frame.camera, frame.log_time_s, frame.pixels, frame=frame.frame)
        for record in work_event(estimator, run, event, ReportTimes()):
            if record.knock is not None:
                alarms.append(record.knock)
                run.knocks = KnockTest()
    return alarms


def main() -> None:
    """Run all recordings."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=9600)
    parser.add_argument("--piece", type=float, default=900.0, help="duration of a recording, s")
    given = parser.parse_args()
    total, kinds = 0, list(KINDS)
    for number in range(round(given.hours * 3600.0 / given.piece)):
        kind, seed, begin_s = kinds[number % len(kinds)], given.seed + number, time.process_time()
        alarms = alarms_of(KINDS[kind], seed, given.piece)
        total += len(alarms)
        row = {
            "kind": kind,
            "seed": seed,
            "hours": round((number + 1) * given.piece / 3600.0, 2),
            "alarms": [[a.camera, round(a.time_s, 1), round(a.turn_deg, 2), *a.others] for a in alarms],
            "cpu_s": round(time.process_time() - begin_s, 1),
        }
        print(json.dumps(row), flush=True)
    print(f"{total} alarms")
    raise SystemExit(bool(total))


if __name__ == "__main__":
    main()
