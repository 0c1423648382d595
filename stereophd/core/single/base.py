"""One object seen by several cameras, without clutter: the interface of all estimators.

An estimator is ``init / step / estimate`` over a frozen state: `SingleEstimator.step` returns the next state, given a
state and the event of one camera (at most one detection). `SingleEstimator.estimate` returns the estimate of the object
in the world. Nothing is kept outside the state: the same state and event give the same result, also in estimators that
draw random numbers.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event, Rig
from stereophd.core.disparity.prior import InitialPrior
from stereophd.core.motion.base import Motion
from stereophd.wording import instant


@dataclass(frozen=True)
class SingleState:
    """Fields of the states of all estimators."""

    time_s: float  # Time of the estimate of `SingleEstimator.estimate`: that of the last event, or later
    home_s: float  # Time of what is known of the object: that of the last detection
    n_events: int  # Events so far


State = TypeVar("State", bound=SingleState)


@dataclass(frozen=True)
class SingleEstimate:
    """Where the object is, in the world.

    All are NaN where the object is at or beyond infinity.
    """

    mean: Array  # (6,): Mean of (x, y, z, vx, vy, vz), length and length/s; the velocity of a static object is 0
    map: Array  # (6,): The state of greatest density in the space that the estimator works in, mapped to the world
    covariance: Array  # (6, 6): Covariance about the mean


@dataclass(frozen=True)
class SingleEstimator(ABC, Generic[State]):
    """An estimator of the state of one object."""

    rig: Rig
    motion: Motion
    prior: InitialPrior  # Depth and velocity of the object when it is first seen

    @property
    def state_size(self) -> int:
        """Size of the state: 6, or 3 for a static object."""
        return self.motion.state_size

    @abstractmethod
    def init(self) -> State:
        """Return the state before the first detection."""

    def step(self, state: State, event: Event) -> tuple[State, float]:
        """Return the state after an event, and its log-likelihood; without a detection the state stays where it is.

        That is the logarithm of the density of the detection given all earlier ones, over distorted pixels: of the
        first detection uniform over the image, of an event without one 0. Raises ValueError if the event has several
        detections, or its camera moves while a rolling shutter reads: points of such events refer to the pose of the
        frame.
        """
        count = len(event.points)
        if count > 1:
            raise ValueError(f"expected at most one detection an event, found {count} at {instant(event.time_s)} s")
        if count == 0:
            return self._unchanged(state, event), 0.0
        if event.travels is not None:
            raise ValueError("expected a camera at rest where a rolling shutter sees one object, found it moving")
        # a rolling shutter reads the row of the detection later than the first
        time_s = event.time_s + (0.0 if event.delays is None else float(event.delays[0]))
        return self._detected(state, event, self.rig.space(event.camera, time_s), time_s)

    def _unchanged(self, state: State, event: Event) -> State:
        """Return the state after an event that says nothing of the object."""
        return replace(state, time_s=event.time_s, n_events=state.n_events + 1)

    @abstractmethod
    def _detected(self, state: State, event: Event, space: Array, time_s: float) -> tuple[State, float]:
        """Return the state after a detection at a time, in the packed space (30,) of then, and its log-density."""

    @abstractmethod
    def estimate(self, state: State) -> SingleEstimate | None:
        """Return where the object is at the state's time; None before its first detection."""

    def at(self, state: State, time_s: float) -> State:
        """Return the state that `estimate` describes at a time after the last event."""
        return replace(state, time_s=time_s)

    def first_density(self, event: Event) -> float:
        """Logarithm of the density of a detection of which nothing was known: uniform over the image."""
        camera = self.rig.cameras[event.camera]
        return -float(np.log(camera.width * camera.height))


AnyEstimator = SingleEstimator[Any]
