"""Filters over arrays in memory, without files: what ``import stereophd`` offers besides the commands."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stereophd.config.loading import make_config
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.base import DisparityFilter, FilterState
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.stream import EventStream
from stereophd.pipeline.tracking.loop import Record, run_estimator


@dataclass(frozen=True)
class ArrayFilter:
    """A filter for many objects that takes frames (`Frame`); `make_filter` makes one.

    Frames are those of all cameras in order of time, `Frame.camera` is the index among the filter's cameras. A frame
    without detections is information: pass every frame. The `estimator` is what runs, over events.
    """

    estimator: DisparityFilter

    def init(self) -> FilterState:
        """Return the state before the first frame: no objects."""
        return self.estimator.init()

    def step(self, state: FilterState, frame: Frame) -> tuple[FilterState, Info, Estimates]:
        """Return the state after a frame, diagnostics, and the estimated objects; the state given is not changed.

        `Estimates` holds the identities, states (k, 6), covariances (k, 6, 6) and existence of the objects, in the
        world frame, per second.
        """
        (event,) = EventStream(self.estimator.rig.cameras, [frame])
        return self.estimator.step(state, event)

    def run(self, frames: Iterable[Frame]) -> Iterator[Record]:
        """Yield a `Record` after every frame, in order of time (ties in that of the cameras): `Record.estimates`.

        The frames may come in any order. An object that is not confirmed is reported only after a second camera has
        detected it, except in the first frames.
        """
        ordered = sorted(frames, key=lambda frame: (frame.time_s, frame.camera))
        return run_estimator(self.estimator, EventStream(self.estimator.rig.cameras, ordered))


def make_filter(
    cameras: Sequence[Camera],
    kind: str = "pmb",
    *,
    motion: Mapping[str, Any] | None = None,
    moments: Mapping[str, Any] | None = None,
    disparity: Mapping[str, Any] | None = None,
    region: Mapping[str, Any] | None = None,
    seed: int = 0,
    threads: int = 1,
    **settings: Any,
) -> ArrayFilter:
    """Return a filter for many objects over frames in memory.

    Parameters
    ----------
    cameras : sequence of Camera
        Detections name them by their index.
    kind : str
        ``pmb``, ``phd``, or another kind of the section ``filter`` of a configuration.
    motion, moments, disparity, region : mapping, optional
        Sections of the same names of a configuration, such as ``motion={"acceleration_std": 0.3}``.
    seed : int
        Seed of the samples.
    threads : int
        Threads that carry samples between disparity spaces; results do not depend on it.
    **settings
        Keys of the section ``filter``, such as ``birth={"per_s": 0.05, ...}``.

    Returns
    -------
    ArrayFilter
        ``init()`` returns its state before the first frame, ``step(state, frame)`` the next state, diagnostics and
        estimates; ``run(frames)`` does both for a sequence of frames.

    Raises
    ------
    InputError
        A key does not exist, or its value is not valid.
    """
    sections = {"motion": motion, "moments": moments, "disparity": disparity, "region": region}
    values = {name: dict(section) for name, section in sections.items() if section is not None}
    loaded = make_config({**values, "seed": seed, "filter": {"kind": kind, **settings}}, "make_filter")
    return ArrayFilter(build_filter(loaded.config, tuple(cameras), loaded.path, threads))
