"""A camera that is knocked during a live run: when it is noticed, what is solved anew, and what becomes of the tracks.

    python benchmarks/knocked.py
    python benchmarks/knocked.py --turn 0.5 --seeds 0 1 2 3

The scene of `configs/quickstart.yaml` with six objects that stay, for one minute; one of the three cameras turns about
its vertical axis after 15 s. The frames are played `--speed` times as fast as they were made. Objects are compared with
the rows of the run (OSPA, order 2, cutoff 1 m) in the 10 s before the knock, in those after it, and in the last
10 s, beside a run whose cameras are left as they are.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from stereophd.commands.recalibrate import with_pose
from stereophd.commands.track_live import LiveOutputs, track_live
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.arrays import Array
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.numerics.random_streams import RUN_FRAMES, RUN_OBJECTS
from stereophd.core.simulation.detections import Scene, simulate_frames
from stereophd.io.streams.messages import Message
from stereophd.io.streams.rows import JsonLines
from stereophd.pipeline.simulation import build_scene

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "quickstart.yaml"
DURATION_S, KNOCK_S, CAMERA = 60.0, 15.0, "right"
CUTOFF = 1.0
COLUMNS = (
    "seed", "recalibrate", "noticed after", "camera", "in force after", "status", "rotation off", "centre off",
    "OSPA before", "after the knock", "at the end", "tracks before", "tracks at the end",
)  # fmt: skip
ALONE = ("simulate.objects.count=6", "simulate.objects.births_per_s=0", "simulate.objects.mean_lifetime_s=null")


def knocked_scene(loaded: LoadedConfig, turn_deg: float, seed: int) -> tuple[list[Message], Scene, Pose]:
    """Return the frames, the scene, and the pose of the camera after the knock."""
    cameras = loaded.build_cameras()
    scene = build_scene(loaded.config, cameras, RUN_OBJECTS.seed(seed, 0))
    before = next(camera for camera in cameras if camera.name == CAMERA).pose
    after = Pose(rotation_from_vector(np.deg2rad([0.0, turn_deg, 0.0])) @ before.rotation, before.center)
    moved = replace(scene, cameras=tuple(replace(c, pose=after) if c.name == CAMERA else c for c in cameras))
    frames = [f for f in simulate_frames(scene, RUN_FRAMES.seed(seed, 0)) if f.log_time_s < KNOCK_S]
    frames += [f for f in simulate_frames(moved, RUN_FRAMES.seed(seed, 0)) if f.log_time_s >= KNOCK_S]
    return [Message(cameras[f.camera].name, f.frame, f.log_time_s, f.pixels) for f in frames], scene, after


def played(messages: Sequence[Message], speed: float) -> Iterator[Message]:
    """Yield messages at their times."""
    began_s = time.monotonic()
    for message in messages:
        time.sleep(max(began_s + message.time_s / speed - time.monotonic(), 0.0))
        yield message


def run(loaded: LoadedConfig, messages: Sequence[Message], speed: float) -> tuple[list[Any], list[Any]]:
    """Return the rows and the events of a live run."""
    rows, events = io.BytesIO(), io.StringIO()
    track_live(loaded, played(messages, speed), "frames", LiveOutputs([JsonLines(rows, events)]))
    return ([json.loads(line) for line in text.getvalue().splitlines()] for text in (rows, events))  # type: ignore[return-value]


def ospa(rows: Sequence[Any], scene: Scene, from_s: float, until_s: float) -> tuple[float, int]:
    """Return the mean OSPA of rows, and the number of tracks among them."""
    truth = {
        round(float(t), 6): window.states[:, k, :3] for window in scene.windows() for k, t in enumerate(window.times_s)
    }
    scores, tracks = [], set()
    for row in (row for row in rows if from_s <= row["time_s"] < until_s):
        confirmed = [track for track in row["tracks"] if track["status"] == "confirmed"]
        tracks |= {track["track_id"] for track in confirmed}
        scores.append(
            _ospa(
                np.array([[t["x"], t["y"], t["z"]] for t in confirmed]).reshape(-1, 3), truth[round(row["time_s"], 6)]
            )
        )
    return float(np.mean(scores)), len(tracks)


def _ospa(found: Array, truth: Array) -> float:
    distances = np.minimum(np.linalg.norm(found[:, None] - truth[None], axis=2), CUTOFF) ** 2
    rows, columns = linear_sum_assignment(distances)
    most = max(len(found), len(truth))
    return float(np.sqrt((distances[rows, columns].sum() + CUTOFF**2 * (most - len(rows))) / most))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turn", type=float, default=2.0, help="degrees (default 2)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--speed", type=float, default=1.0)
    options = parser.parse_args(arguments)
    print(f"| {' | '.join(COLUMNS)} |")
    print("|---" * len(COLUMNS) + "|")
    for seed in options.seeds:
        for wanted in (True, False):
            sets = [f"simulate.duration_s={DURATION_S}", f"live.recalibrate={str(wanted).lower()}", *ALONE]
            loaded = load_config(CONFIG, sets)
            messages, scene, after = knocked_scene(loaded, options.turn, seed)
            rows, events = run(loaded, messages, options.speed)
            knock = next((event for event in events if event["event"] == "knocked"), None)
            solved = [event for event in events if event["event"] == "recalibrated"]
            found = next((event for event in solved if "pose" in event), None)
            cells = [str(seed), str(wanted).lower()]
            noticed_s = knock["time_s"] if knock is not None else KNOCK_S
            cells += [f"{noticed_s - KNOCK_S:.2f} s", knock["camera"]] if knock is not None else ["never", ""]
            if found is not None:
                pose = with_pose(loaded, CAMERA, found["pose"], None).cameras[CAMERA].build(CAMERA).pose
                angle = np.arccos(min((np.trace(pose.rotation @ after.rotation.T) - 1.0) / 2.0, 1.0))
                off = np.linalg.norm(pose.center - after.center)
                cells += [
                    f"{found['time_s'] - KNOCK_S:.1f} s",
                    found["status"],
                    f"{np.degrees(angle):.3f} deg",
                    f"{off:.3f} m",
                ]
            else:
                cells += ["never", ", ".join(event["status"] for event in solved), f"{options.turn:g} deg", ""]
            spans = ((KNOCK_S - 10.0, KNOCK_S), (noticed_s, noticed_s + 10.0), (DURATION_S - 10.0, DURATION_S))
            scored = [ospa(rows, scene, *span) for span in spans]
            cells += [f"{value:.3f} m" for value, _ in scored] + [str(scored[0][1]), str(scored[-1][1])]
            print("| " + " | ".join(cells) + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
