"""`init` does not compare cameras of which one alone has detections, or that move."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.pipeline.checks.log.sample import CameraSample
from stereophd.pipeline.initial import draft as drafts
from stereophd.pipeline.initial.template import Draft
from tests.scenes import build_camera


def _sample(camera: Camera, frames: int) -> CameraSample:
    times = np.arange(frames) / 10.0
    return CameraSample(camera, times, np.arange(frames), np.arange(frames + 1), np.full((frames, 2), 100.0))


@pytest.mark.parametrize(("frames", "speed", "is_doubted"), [(0, 0.0, False), (20, 0.0, True), (20, 1.0, False)])
def test_only_cameras_that_see_and_stand_still_contradict_each_other(
    frames: int, speed: float, is_doubted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras that look away from each other share no view: a doubt only where `calibrate` can find them."""
    monkeypatch.setattr(drafts, "_rough", lambda *_: None)
    away = Pose(rotation_from_vector(np.array([0.0, 3.0, 0.0])), np.zeros(3), np.array([speed, 0.0, 0.0]))
    cameras = [build_camera("a"), build_camera("b", pose=away)]
    samples = [_sample(camera, count) for camera, count in zip(cameras, (20, frames), strict=True)]
    _, why = drafts._with_tracks(Draft("m", {}, {}), samples, {}, "log.parquet")
    assert (why is not None) == is_doubted
