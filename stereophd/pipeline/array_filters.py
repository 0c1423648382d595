"""Filters over arrays in memory, without files: what ``import stereophd`` offers besides the commands."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from stereophd.config.loading import make_config
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.base import DisparityFilter
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.stream import EventStream
from stereophd.pipeline.tracking.loop import Record, run_estimator


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
) -> DisparityFilter:
    """Return a filter for many objects.

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
    DisparityFilter
        ``init()`` returns its state before the first event, ``step(state, event)`` the next state, diagnostics and
        estimates; `run_filter` does both for a sequence of frames.

    Raises
    ------
    InputError
        A key does not exist, or its value is not valid.
    """
    sections = {"motion": motion, "moments": moments, "disparity": disparity, "region": region}
    values = {name: dict(section) for name, section in sections.items() if section is not None}
    loaded = make_config({**values, "seed": seed, "filter": {"kind": kind, **settings}}, "make_filter")
    return build_filter(loaded.config, tuple(cameras), loaded.path, threads)


def run_filter(multi_filter: DisparityFilter, frames: Iterable[Frame]) -> Iterator[Record]:
    """Run a filter over frames in memory.

    Parameters
    ----------
    multi_filter : DisparityFilter
        From `make_filter`.
    frames : iterable of Frame
        Frames of all cameras, in any order; `Frame.camera` is the index among the filter's cameras. A frame
        without detections is information: pass every frame.

    Yields
    ------
    Record
        After every frame, in order of time, ties in the order of the cameras: `Record.estimates` holds the
        identities, states (k, 6), covariances (k, 6, 6) and existence of the objects.
    """
    ordered = sorted(frames, key=lambda frame: (frame.time_s, frame.camera))
    return run_estimator(multi_filter, EventStream(multi_filter.rig.cameras, ordered))
