"""Solve the pose of a camera that was knocked during a live run, from the frames since, while the run goes on.

`calibrate` does it, in a process of its own: the pose of the one camera is free, under a prior about the old one, and
all others are known. Its status decides: what the data do not determine is tried again with more of them.
"""

import tempfile
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from stereophd.config.loading import LoadedConfig, variant
from stereophd.core.calibration.unknowns.observability import DETERMINED
from stereophd.errors import InputError
from stereophd.io.streams.messages import Message
from stereophd.pipeline.live.recording import write_log
from stereophd.pipeline.tracking.knocked import Knock
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.workers.aside import Aside

# Times after a knock at which its frames are tried, s; frames of the last span are kept.
TRIES_S, SPAN_S = (5.0, 10.0, 20.0, 40.0, 60.0), 60.0
# Standard deviations of the prior about the old pose: of the rotation, beside the turn that was noticed, and of the
# centre, as a part of the distance of the tracks.
ROTATION_STD_DEG, CENTER_STD = 2.0, 0.05


class Recalibration:
    """The search for the pose of a knocked camera; `record` is the one that shows the knock."""

    def __init__(self, loaded: LoadedConfig, knock: Knock, record: Record) -> None:
        self.knock = knock
        self._loaded = loaded
        center = loaded.cameras[knock.camera].build(knock.camera).at(record.time_s).pose.center
        positions = record.estimates.states[:, :3]
        distance = float(np.median(np.linalg.norm(positions - center, axis=1))) if len(positions) else 1.0
        self._prior = {"center_std": CENTER_STD * distance, "rotation_std_deg": ROTATION_STD_DEG + knock.turn_deg}
        self._frames: deque[Message] = deque()
        self._tries = [knock.time_s + after_s for after_s in TRIES_S]
        self.aside = Aside(nicer=0)  # on a busy machine too: the run waits for this camera

    def keep(self, message: Message) -> None:
        """Keep a frame that came after the knock was noticed."""
        self._frames.append(message)
        while self._frames[0].time_s < message.time_s - SPAN_S:
            self._frames.popleft()

    def step(self, time_s: float) -> dict[str, Any] | None:
        """Begin a try when its time has come; return what one found, ``status`` and, if it is determined, ``pose``."""
        if not self.aside.is_busy and self._tries and time_s >= self._tries[0]:
            self._tries = [later for later in self._tries if later > time_s]
            lines = [message.to_line() + "\n" for message in self._frames]
            task = self._loaded, self.knock.camera, self._prior, lines
            self.aside.start(lambda worker: worker.call(solve_camera, task))
        outcome = self.aside.take()
        return {"status": f"failed: {outcome}"} if isinstance(outcome, Exception) else outcome

    @property
    def is_over(self) -> bool:
        """Whether all tries have failed."""
        return not self.aside.is_busy and not self._tries


def solve_camera(task: tuple[LoadedConfig, str, dict[str, float], list[str]]) -> dict[str, Any]:
    """Calibrate one camera under a prior from lines of frames.

    Returns the status, and the pose where the frames determine it.
    """
    from stereophd.commands.calibrate import CAMERAS_FILE, calibrate

    known, camera, prior, lines = task
    reference = next(name for name in known.cameras if name != camera)
    section = {"method": "annealed", "model": "as_stated", "reference": reference, "priors": {camera: prior}}
    loaded = variant(known, [("live.recalibrate", {"calibration": section})])
    with tempfile.TemporaryDirectory() as folder:
        recording, log, out = (Path(folder) / name for name in ("frames.jsonl", "detections.parquet", "out"))
        recording.write_text("".join(lines), encoding="utf-8")
        try:
            write_log(loaded, recording, log)
            report = calibrate(loaded, log, out, plots=False)
        except InputError as error:
            return {"status": str(error)}
        if report["status"] != DETERMINED:
            return {"status": report["status"]}
        pose = yaml.safe_load((out / CAMERAS_FILE).read_text(encoding="utf-8"))["cameras"][camera]["pose"]
        return {"status": report["status"], "pose": {name: pose[name] for name in ("center", "rotation_matrix")}}


def with_pose(loaded: LoadedConfig, camera: str, pose: dict[str, Any], from_s: float | None) -> LoadedConfig:
    """Return a configuration in which a camera has this pose from a time on; None: at all times."""
    cameras = {name: dict(values) for name, values in loaded.resolved["cameras"].items()}
    if from_s is None:
        cameras[camera] |= {"pose": pose, "poses": []}
    else:
        earlier = [each for each in cameras[camera]["poses"] if each["from_s"] < from_s]
        cameras[camera]["poses"] = [*earlier, {"from_s": from_s, **pose}]
    return variant(loaded, [("live.recalibrate", {"cameras": cameras})])
