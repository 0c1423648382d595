"""Every kind of filter, found by its name, keeps the contract of a filter."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stereophd.core.disparity.events import make_event, make_rig
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.build import make_filter
from stereophd.core.multi.filter_settings import filters
from stereophd.core.multi.filter_settings.common import BirthPrior, Hysteresis
from stereophd.core.numerics.samples import draw_sample_sets
from tests.core.disparity.cases import make_camera

BIRTH = BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=3.0), velocity_std=1.5)
OBJECT = np.array([1.0, 2.0, 90.0])


def kinds() -> list[Any]:
    return [pytest.param(word, kind, id=word) for word, kind in filters().items()]


@pytest.mark.parametrize(("word", "kind"), kinds())
class TestEveryKind:
    def test_its_word_is_the_name_of_its_module(self, word: str, kind: Any) -> None:
        assert kind(birth=BIRTH).kind == word
        assert kind.__module__ == f"stereophd.core.multi.filter_settings.{word}"

    def test_declares_every_parameter(self, word: str, kind: Any) -> None:
        assert dataclasses.is_dataclass(kind)
        assert all(field.metadata["description"] for field in dataclasses.fields(kind))
        assert issubclass(type(kind(birth=BIRTH).extraction), Hysteresis)

    def test_finds_an_object_that_two_cameras_see(self, word: str, kind: Any) -> None:
        cameras = [make_camera((0.0, -0.26, 0.0), (-20.0, 0.0, 0.0)), make_camera((0.0, 0.26, 0.0), (20.0, 0.0, 0.0))]
        sets = draw_sample_sets("qmc", 64, 12, np.random.SeedSequence(7))
        built = make_filter(kind(birth=BIRTH), make_rig(cameras, 1.0, "horizontal"), ConstantVelocity([0.01] * 3), sets)
        assert isinstance(built, DisparityFilter)
        state, estimates = built.init(), None
        for k in range(8):
            camera = cameras[k % 2]
            pixels = camera.project(OBJECT[None])
            state, info, estimates = built.step(state, make_event(camera, k % 2, 0.5 * (k // 2), pixels))
            assert np.isfinite(info.log_likelihood)
        assert estimates is not None
        assert len(estimates.states) == 1
        np.testing.assert_allclose(estimates.states[0, :3], OBJECT, atol=3.0)

    @pytest.mark.parametrize("burst_at", [0, 5])
    def test_a_burst_of_clutter_gives_no_births(self, word: str, kind: Any, burst_at: int) -> None:
        """Hundreds of false detections in one frame, the first one too: the object is as without them."""
        prior = replace(BIRTH, per_s=0.2, max_per_frame=100)
        cameras = [make_camera((0.0, -0.26, 0.0), (-20.0, 0.0, 0.0)), make_camera((0.0, 0.26, 0.0), (20.0, 0.0, 0.0))]
        sets = draw_sample_sets("qmc", 64, 12, np.random.SeedSequence(7))
        built = make_filter(kind(birth=prior), make_rig(cameras, 1.0, "horizontal"), ConstantVelocity([0.01] * 3), sets)
        clutter = np.random.default_rng(3).uniform((0.0, 0.0), (799.0, 599.0), (500, 2))
        state, estimates = built.init(), None
        for k in range(12):
            camera = cameras[k % 2]
            pixels = camera.project(OBJECT[None])
            if k == burst_at:
                pixels = np.concatenate([pixels, clutter])
            state, info, estimates = built.step(state, make_event(camera, k % 2, 0.5 * (k // 2), pixels))
            assert np.isfinite(info.log_likelihood)
            assert (info.burst > 0) == (k == burst_at)
            assert info.n_components < 50
            assert info.cardinality_mean < 2.0
        assert estimates is not None
        assert len(estimates.states) == 1
        np.testing.assert_allclose(estimates.states[0, :3], OBJECT, atol=3.0)

    def test_what_the_cap_leaves_out_is_counted(self, word: str, kind: Any) -> None:
        cameras = [make_camera()]
        sets = draw_sample_sets("qmc", 64, 12, np.random.SeedSequence(7))
        rig, motion = make_rig(cameras, 1.0, "horizontal"), ConstantVelocity([0.01] * 3)
        built = make_filter(kind(birth=BIRTH, max_components=10), rig, motion, sets)
        pixels = np.stack(np.meshgrid(np.arange(50, 800, 100.0), [100.0, 300.0, 500.0]), axis=-1).reshape(-1, 2)
        _, info, _ = built.step(built.init(), make_event(cameras[0], 0, 0.0, pixels))
        assert (info.n_components, info.left_out) == (10, len(pixels) - 10)
