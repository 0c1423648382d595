"""A calibration problem that the tests share: two cameras, the right one unknown, three objects."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.pose import CENTER, ROTATION
from stereophd.core.disparity.events import Event, make_event, make_rig
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.multi.filter_settings.phd import PhdSettings
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.multi.pmb.filter import PmbFilter
from tests.core.disparity.cases import make_camera
from tests.core.disparity.moves import sample_sets
from tests.core.multi.scenes import BIRTHS, with_births

PRIOR_STD = (5.0, 5.0, 5.0, 0.02, 0.13, 0.02)


def make_parameters(angle: float = 0.26) -> ParameterSet:
    """Pose of the right of two cameras at -20 and 20, turned inward."""
    left = replace(make_camera((0.0, -angle, 0.0), (-20.0, 0.0, 0.0)), name="left")
    right = replace(make_camera((0.0, angle, 0.0), (20.0, 0.0, 0.0)), name="right")
    names = CENTER + ROTATION
    parameters = [Parameter(n, "right", 0.0, s) for n, s in zip(names, PRIOR_STD, strict=True)]
    return ParameterSet((left, right), tuple(parameters))


def make_template(
    cameras: tuple[Camera, ...],
    kind: str = "phd",
    motion: Motion | None = None,
    samples: int = 64,
    region: Array | None = None,
    **settings: object,
) -> PhdFilter | PmbFilter:
    """The filter of given cameras."""
    motion = ConstantVelocity([0.05] * 3, 12.0) if motion is None else motion
    sets = sample_sets("qmc", samples, motion, seed=7)
    rig = make_rig(cameras, 1.0, "horizontal", region)
    birth = BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=3.0), velocity_std=2.0)
    if kind == "pmb":
        return with_births(
            PmbFilter(rig, motion, sets, PmbSettings(survival_per_s=0.99, birth=birth, **settings)), BIRTHS
        )  # type: ignore[arg-type]
    return with_births(PhdFilter(rig, motion, sets, PhdSettings(survival_per_s=0.99, birth=birth, **settings)), BIRTHS)  # type: ignore[arg-type]


def make_events(cameras: tuple[Camera, ...], count: int, seed: int = 3, clutter: float = 3.0) -> list[Event]:
    """Three moving objects that cross the edges of the views, clutter and misses; cameras in turn."""
    rng = np.random.default_rng(seed)
    start = np.array([[5.0, 3.0, 100.0], [-30.0, -8.0, 140.0], [35.0, 6.0, 180.0]])
    velocity = np.array([[4.0, 0.0, 1.0], [0.0, 5.0, -0.5], [-1.0, 0.5, 0.0]])
    events = []
    for k in range(count):
        number, time_s = k % len(cameras), 0.5 * (k // len(cameras))
        camera = cameras[number]
        pixels = camera.project(start + velocity * time_s)
        pixels = pixels + 1.3 * rng.standard_normal(pixels.shape)
        seen = ((pixels > 0.0) & (pixels < [799.0, 599.0])).all(axis=1) & (rng.random(len(pixels)) < 0.95)
        false = rng.uniform([0.0, 0.0], [799.0, 599.0], (rng.poisson(clutter), 2))
        events.append(make_event(camera, number, time_s, np.concatenate([pixels[seen], false])))
    return events


def of_log(evidence: Any, values: Array) -> Array:
    """Evidence (k,) of the whole log at values (k, m)."""
    return np.asarray(evidence.after(values, [evidence.n_events])[0])


def to_bytes(value: object) -> bytes:
    """Every bit of nested dataclasses, tuples, arrays and numbers (pickles depend on what shares memory)."""
    if is_dataclass(value):
        return b"".join(to_bytes(getattr(value, field.name)) for field in fields(value))
    if isinstance(value, (tuple, list)):
        return b"".join(to_bytes(item) for item in value)
    if isinstance(value, (str, type(None))):
        return repr(value).encode()
    return np.asarray(value).tobytes()
