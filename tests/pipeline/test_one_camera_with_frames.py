"""`init` does not compare cameras of which one alone has frames."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.geometry.camera import Camera
from stereophd.pipeline.checks.log.sample import CameraSample
from stereophd.pipeline.initial import draft as drafts
from stereophd.pipeline.initial.template import Draft
from tests.scenes import build_camera


def _sample(camera: Camera, frames: int) -> CameraSample:
    times = np.arange(frames) / 10.0
    return CameraSample(camera, times, np.arange(frames), np.zeros(frames + 1, dtype=int), np.empty((0, 2)))


@pytest.mark.parametrize(("frames", "is_doubted"), [(0, False), (20, True)])
def test_a_camera_without_frames_cannot_contradict_another(
    frames: int, is_doubted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras that look away from each other share no view, which is a doubt only where both have frames."""
    monkeypatch.setattr(drafts, "_rough", lambda *_: None)
    cameras = [build_camera(name, [0.0, 0.0, 0.0], [0.0, turn, 0.0]) for name, turn in (("a", 0.0), ("b", 3.0))]
    samples = [_sample(camera, count) for camera, count in zip(cameras, (20, frames), strict=True)]
    _, why = drafts._with_tracks(Draft("m", {}, {}), samples, {}, "log.parquet")
    assert (why is not None) == is_doubted
