"""Compiling the kernels of a filter before its first event, from the beginning of a step or from its end.

Two processes that share the folder of kept kernels compile from the two ends, so that one finds what the other made.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numba
import numpy as np

from stereophd.core.disparity.events import Event, make_rig
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.exact_association import association_marginals
from stereophd.core.multi.filter_settings import filters
from stereophd.core.multi.filter_settings.phd import PhdSettings
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.mixture import empty_mixture
from stereophd.core.multi.phd_update import reduce_intensity
from stereophd.core.multi.pmb import PmbFilter
from stereophd.core.multi.pmb_reduce import reduce_tracks
from stereophd.core.multi.settings import BirthPrior
from stereophd.core.numerics.samples import draw_sample_sets

# The kernel that ends a filter's update: what is kept of it tells whether the filter has been compiled.
LAST_KERNELS: Mapping[str, Any] = {"pmb": reduce_tracks, "phd": reduce_intensity}

_SAMPLES = 64


def small_filter(kind: str) -> DisparityFilter:
    """Return a filter of a kind, with one camera: its kernels are those of any filter of this kind."""
    detector = Detector((1.0, 1.0), 0.9, 1.0)
    camera = Camera("camera", 640, 480, 500.0, 500.0, 320.0, 240.0, Pose(np.eye(3), np.zeros(3)), Lens(), detector)
    motion = ConstantVelocity(1.0)
    sets = draw_sample_sets("qmc", _SAMPLES, motion.sample_rows, np.random.SeedSequence(0))
    settings = cast("type[PhdSettings | PmbSettings]", filters()[kind])
    birth = BirthPrior(depth_range=(1.0, 10.0), velocity_std=1.0)
    return settings(birth=birth).build(make_rig((camera,), 1.0, "horizontal"), motion, sets)


def prepare(kind: str) -> None:
    """Compile the kernels of a filter, in the order in which an event needs them."""
    multi_filter = small_filter(kind)
    state = multi_filter.init()
    for time_s in (0.0, 1.0):
        event = Event(time_s, 0, np.full((1, 2), 100.0), np.eye(2)[None], np.ones(1))
        state, _, _ = multi_filter.step(state, event)
    _prepare_tests(multi_filter)


def prepare_last_first(kind: str) -> None:
    """Compile the same kernels, those that an event needs last first."""
    multi_filter = small_filter(kind)
    integers = np.empty(0, dtype=np.int64)
    if kind == "pmb":
        _compile(association_marginals, integers, integers, np.empty(0), 0, 0)
    _compile(LAST_KERNELS[kind], empty_mixture(multi_filter.state_size), multi_filter.reduction)
    multi_filter.extract(multi_filter.init())
    _prepare_tests(multi_filter)
    prepare(kind)


def _prepare_tests(multi_filter: DisparityFilter) -> None:
    """Compile what a filter needs only from when it reports several objects."""
    if isinstance(multi_filter, PmbFilter):
        multi_filter.crosswise_test.compile()


def _compile(kernel: Any, *arguments: Any) -> None:
    """Compile a kernel for other kernels that call it with such arguments."""
    kernel.compile(tuple(map(numba.typeof, arguments)))
