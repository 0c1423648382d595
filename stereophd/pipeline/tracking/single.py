"""`track` for one object without clutter (``filter.kind: single``): one track, number 0."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from stereophd.config.model import Config
from stereophd.core.disparity.events import Event, Rig, make_rig
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.multi.association.attribution import Claims
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.numerics.random_streams import SINGLE_ESTIMATOR
from stereophd.core.single.base import AnyEstimator, SingleEstimate, SingleState
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.pipeline.stream import EventStream
from stereophd.wording import instant

# The object's identity in ``tracks.parquet``.
TRACK = np.zeros(1, dtype=np.int64)
NOTHING = Estimates(TRACK[:0], np.empty((0, 6)), np.empty((0, 6, 6)), np.empty(0), TRACK[:0])


def build_single(config: Config, motion: Motion, cameras: tuple[Camera, ...], path: Path | str) -> AnyEstimator:
    """Return the single-object estimator that a configuration, read from `path`, describes.

    Raises InputError if the configuration has no prior of the velocity of a moving object; or if its cameras are not
    rectified, and its estimator needs them to be.
    """
    assert isinstance(config.filter, SingleSettings)
    prior = config.filter.prior
    no_velocity = prior.velocity_std is None and prior.disparity_velocity_std_px_s is None
    if motion.moves and no_velocity:
        raise InputError(f"{path}: filter.prior: expected velocity_std, found none (motion.model is not static)")
    rig = make_rig(cameras, config.disparity.baseline, config.disparity.rectification)
    rng = np.random.default_rng(SINGLE_ESTIMATOR.seed(config.seed))
    from stereophd.core.single.build import build_estimator  # only here: filters for many objects need none of it

    try:
        return build_estimator(config.filter.estimator, config.moments, rig, motion, prior, rng)
    except ValueError as error:
        raise InputError(f"{path}: filter.estimator: {error}") from None


Kind = TypeVar("Kind", bound=SingleState)


@dataclass(frozen=True)
class SingleTrackerState(Generic[Kind]):
    """State of a `SingleTracker`: that of its estimator, and whether the object has been detected."""

    estimator: Kind
    known: bool = False

    @property
    def next_label(self) -> int:
        """First label that no object has."""
        return int(self.known)

    @property
    def labels(self) -> NDArray[np.int64]:
        """Label of the object, once it is known."""
        return TRACK[: int(self.known)]


@dataclass(frozen=True)
class SingleTracker:
    """A single-object estimator as `stereophd.pipeline.tracking.loop` runs it: one track, number 0."""

    estimator: AnyEstimator
    point: Literal["mean", "map"]  # The estimate that is reported

    @property
    def rig(self) -> Rig:
        """The cameras."""
        return self.estimator.rig

    def init(self) -> SingleTrackerState[Any]:
        """Return the state before the first event."""
        return SingleTrackerState(self.estimator.init())

    def step(self, state: SingleTrackerState[Any], event: Event) -> tuple[SingleTrackerState[Any], Info, Estimates]:
        """Return the state after an event, which has at most one detection, its diagnostics, and the object."""
        new, log_likelihood = self.estimator.step(state.estimator, event)
        estimate = self.estimator.estimate(new)
        known = estimate is not None
        detected = TRACK[: len(event.points)]
        claims = Claims(detected, detected, np.ones(len(detected)))
        full = Info(log_likelihood, float(known), int(known), detected, claims)
        return SingleTrackerState(new, known), full, _estimates(estimate, self.point)

    def forecast(self, state: SingleTrackerState[Any], info: Info, time_s: float) -> tuple[Info, Estimates]:
        """Predict the object to a time between two events."""
        estimate = self.estimator.estimate(self.estimator.at(state.estimator, time_s))
        return replace(info, log_likelihood=0.0), _estimates(estimate, self.point)


def at_most_one(stream: EventStream) -> Iterator[Event]:
    """Yield the events of a log of one object; raises InputError if a frame has several detections."""
    for event in stream:
        count = len(event.points) + event.not_invertible
        if count > 1:
            raise InputError(
                f"{stream.source}: frame {event.frame} of {stream.cameras[event.camera].name} at "
                f"{instant(event.time_s)} s: expected at most one detection (filter.kind is single), found {count}"
            )
        yield event


def _estimates(estimate: SingleEstimate | None, point: Literal["mean", "map"]) -> Estimates:
    """Reported object: none before its first detection, and while it is at or beyond infinity."""
    if estimate is None:
        return NOTHING
    state = estimate.mean if point == "mean" else estimate.map
    if not (np.isfinite(state).all() and np.isfinite(estimate.covariance).all()):
        return NOTHING
    return Estimates(TRACK, state[None], estimate.covariance[None], np.ones(1), TRACK)
