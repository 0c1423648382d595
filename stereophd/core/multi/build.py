"""From settings to the filter: the module of their word (``multi/WORD/filter.py``) has it as ``FILTER``.

Of a plug-in it is the module ``filter`` inside the package that holds the settings. Settings are read without compiled
code, so that they do not know their filters. The kernels of a filter are compiled before its first event, by two
processes from the two ends of a step: one finds what the other made.
"""

from functools import cache
from importlib import import_module
from typing import Any

import numba
import numpy as np

from stereophd.core.disparity.events import Event, Rig, make_rig
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.filter_settings import filters
from stereophd.core.multi.filter_settings.common import BirthPrior, FilterSettings
from stereophd.core.numerics.random_streams import COMPILED_SAMPLES_SEED
from stereophd.core.numerics.samples import SampleSets, draw_sample_sets
from stereophd.core.two_views.turns import prepare_turns
from stereophd.plugins import module_names

SETTINGS = "stereophd.core.multi.filter_settings"


def make_filter(
    settings: FilterSettings, rig: Rig, motion: Motion, sets: SampleSets, threads: int = 1
) -> DisparityFilter:
    """Return the filter that the `kind` of the settings names.

    `sets` hold the samples that carry Gaussians between disparity spaces. The threads share this work; the estimates do
    not depend on their number.
    """
    home = module_names(SETTINGS)[settings.kind]
    home = home.replace(SETTINGS, "stereophd.core.multi", 1) if home.startswith(f"{SETTINGS}.") else home
    module: Any = import_module(f"{home}.filter")
    built: DisparityFilter = module.FILTER(rig, motion, sets, settings, threads)
    return built


_SAMPLES = 64


def small_filter(kind: str) -> DisparityFilter:
    """Return a filter of a kind, with one camera: its kernels are those of any filter of this kind."""
    detector = Detector(np.ones(2), 0.9, 1.0)
    camera = Camera("camera", 640, 480, 500.0, 500.0, 320.0, 240.0, Pose(np.eye(3), np.zeros(3)), Lens(), detector)
    motion = ConstantVelocity(1.0)
    sets = draw_sample_sets("qmc", _SAMPLES, motion.sample_rows, np.random.SeedSequence(COMPILED_SAMPLES_SEED))
    birth = BirthPrior(depth_range=(1.0, 10.0), velocity_std=1.0)
    settings: Any = filters()[kind]
    return make_filter(settings(birth=birth), make_rig((camera,), 1.0, "horizontal"), motion, sets)


@cache
def last_kernel(kind: str) -> Any:
    """Return the kernel that ends a filter's update: what is kept of it tells whether the filter has been compiled.

    None for the words that name no filter for many objects.
    """
    return small_filter(kind).last_kernels[-1][0] if kind in filters() else None


def prepare(kind: str, last_first: bool = False) -> None:
    """Compile the kernels of a filter, and of the test for knocked cameras.

    They are compiled in the order in which events need them, or first those that an event needs last, without the one
    that calls them all.
    """
    multi_filter = small_filter(kind)
    state = multi_filter.init()
    if last_first:
        for kernel, arguments in multi_filter.last_kernels:
            # the form for other kernels that call it with such arguments
            kernel.compile(tuple(map(numba.typeof, arguments)))
    else:
        for time_s in (0.0, 1.0):
            event = Event(time_s, 0, np.full((1, 2), 100.0), np.eye(2)[None], np.ones(1))
            state, _, _ = multi_filter.step(state, event)
    # for what is reported between events, or after a swap of two tracks
    multi_filter.extract(state)
    prepare_turns()
    multi_filter.compile_tests()
