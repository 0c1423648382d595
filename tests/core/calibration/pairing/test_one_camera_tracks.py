"""Tracks of the detections of one camera, which show no depths."""

from dataclasses import replace

import numpy as np

from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.pairing.track_pairs import one_camera_tracks
from stereophd.core.calibration.settings import AnnealedSettings
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.multi.pmb.filter import PmbFilter
from tests.core.calibration.problems import make_template
from tests.core.disparity.cases import make_camera


def test_an_object_that_one_camera_sees_for_long_has_one_track() -> None:
    # far from the mean of the prior in disparity: the depth drifts, and a track would end where it is infinite
    camera = make_camera((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    camera = replace(camera, detector=replace(camera.detector, sigma=np.array([0.4, 0.4])))
    template = make_template((camera,), "pmb", ConstantVelocity([2.5] * 3, 30.0))
    assert isinstance(template, PmbFilter)
    birth = BirthPrior(depth_range=(5.0, 200.0), velocity_std=5.0)
    template = replace(template, settings=replace(template.settings, birth=birth))
    rng, times = np.random.default_rng(1), np.arange(0.0, 20.0, 0.04)
    path = np.column_stack(
        [20.0 * np.sin(0.4 * times), 12.0 * np.sin(0.3 * times + 1.0), 80.0 + 25.0 * np.sin(0.5 * times)]
    )
    pixels = camera.project(path) + 0.4 * rng.standard_normal((len(times), 2))
    frames = [(0, time_s, pixel[None], None) for time_s, pixel in zip(times.tolist(), pixels, strict=True)]
    recording = Recording.of([camera], frames)
    [(_, detections)] = one_camera_tracks(template, Scans.of(recording, [camera]), AnnealedSettings())
    assert len(detections) > 0.97 * len(times)
