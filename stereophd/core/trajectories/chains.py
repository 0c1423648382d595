"""A track as a chain of states and the detections that it has: filtered both ways, smoothed, and its likelihood.

The measurements are linearised about the states that are known already, so that a pass is a linear Kalman filter in the
world. It begins with a wide prior, forwards or backwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import projective
from stereophd.core.motion.base import Motion, Transition
from stereophd.core.trajectories.smoothing import Trajectory, smooth

# Standard deviations of the prior: of the position in distances from the camera, of the velocity in the track's speeds.
WIDE, FAST = 10.0, 3.0
# Passes after which a smoothed track no longer moves: the detections are nearly linear.
PASSES = 2
# Probabilities and rates below this count as this.
LEAST = 1e-9


@dataclass(frozen=True)
class WholeRun:
    """The events of a run, the cameras, and how objects move."""

    events: tuple[Event | None, ...]
    cameras: tuple[Camera, ...]
    motion: Motion
    _steps: dict[float, Transition] = field(default_factory=dict)

    def time(self, event: int) -> float:
        """Return the time of an event with detections, s."""
        return self.event(event).time_s

    def event(self, event: int) -> Event:
        """Return an event that is no prediction."""
        found = self.events[event]
        assert found is not None
        return found

    def step(self, interval_s: float) -> Transition:
        """Return the transition over an interval of any sign, s: intervals recur in all tracks."""
        found = self._steps.get(interval_s)
        if found is None:
            found = self._steps[interval_s] = self.motion.transition(interval_s)
        return found

    def camera(self, event: int) -> Camera:
        """Return the camera of an event, at its time."""
        found = self.event(event)
        return self.cameras[found.camera].at(found.time_s)

    def pixels(self, event: int, states: Array, detection: int | None = None) -> tuple[Array, Array]:
        """Pixels (n, 2) of states (n, 6) when a detection of an event was made, and their derivatives (n, 2, 6).

        Without a detection: when all of them were made on average. Pixels are those of `Event`.
        """
        delay_s, travelled = self._reading(event, detection)
        positions = states[:, :3] + delay_s * states[:, 3:] - travelled
        points, jacobians = projective(self.camera(event).projection_matrix, positions)
        return points, np.concatenate([jacobians, delay_s * jacobians], axis=2)

    def in_view(self, event: int, states: Array) -> Booleans:
        """Whether states (n, 6) are in view of an event's camera."""
        return np.asarray(self.camera(event).in_view(states[:, :3]), dtype=np.bool_)

    def _reading(self, event: int, detection: int | None) -> tuple[float, Array]:
        """Time after the frame at which a detection was read, s, and how far its camera had travelled (3,)."""
        found = self.event(event)
        if found.delays is None or not len(found.delays):
            return 0.0, np.zeros(3)
        row = slice(None) if detection is None else slice(detection, detection + 1)
        travelled = np.zeros(3) if found.travels is None else found.travels[row].mean(axis=0)
        return float(found.delays[row].mean()), travelled


@dataclass(frozen=True)
class Chain:
    """A track and its detections."""

    trajectory: Trajectory  # What its measurements are linearised about
    detections: dict[int, int]  # Event -> detection, by their numbers
    run: WholeRun

    @cached_property
    def ahead(self) -> tuple[Array, Array, float]:
        """States (n, 6) and covariances (n, 6, 6) filtered forwards over all events, and the log-likelihood."""
        return self._filtered(0, len(self.trajectory.events), backwards=False)

    @cached_property
    def behind(self) -> tuple[Array, Array, float]:
        """States (n, 6) and covariances (n, 6, 6) filtered backwards over all events, and the log-likelihood."""
        return self._filtered(0, len(self.trajectory.events), backwards=True)

    def around(self, first_event: int, last_event: int, reach: int) -> tuple[int, int]:
        """Places in the trajectory (last one excluded) of events and of so many to either side."""
        first, last = np.searchsorted(self.trajectory.events, [first_event, last_event + 1])
        return max(int(first) - reach, 0), min(int(last) + reach, len(self.trajectory.events))

    def smoothed(self, first: int = 0, last: int | None = None) -> Chain:
        """Smooth from the detections at the places from first to last (excluded); elsewhere the track stays."""
        last = len(self.trajectory.events) if last is None else last
        chain = self
        for _ in range(PASSES):
            states, covariances, _ = chain._filtered(first, last, backwards=False)
            whole = chain.trajectory
            part = Trajectory(
                whole.track_id, whole.events[first:last], whole.times[first:last], states, covariances,
                whole.existence[first:last],
            )  # fmt: skip
            part = smooth(part, self.run.motion)
            states, covariances = whole.states.copy(), whole.covariances.copy()
            states[first:last], covariances[first:last] = part.states, part.covariances
            chain = replace(chain, trajectory=replace(whole, states=states, covariances=covariances))
        return chain

    def log_likelihood(self, first: int, last: int) -> float:
        """Log-likelihood of detections, misses and clutter at the places from first to last (excluded).

        What no track has is clutter; terms that do not depend on the detections of this track are left out.
        """
        total = self._filtered(first, last, backwards=False)[2]
        for place in range(first, last):
            event = int(self.trajectory.events[place])
            found = self.run.events[event]
            if found is None:
                continue
            camera = self.run.cameras[found.camera]
            p_detect, detection = camera.detector.p_detect, self.detections.get(event)
            if detection is not None:
                clutter = max(camera.detector.clutter_per_frame, LEAST) / (camera.width * camera.height)
                total += float(np.log(max(p_detect, LEAST)) + np.log(found.areas[detection]) - np.log(clutter))
            elif self.run.in_view(event, self.trajectory.states[place : place + 1])[0]:
                total += float(np.log(max(1.0 - p_detect, LEAST)))
        return total

    def without_window(self, width: float) -> tuple[Array, Array]:
        """States (n, 6), covariances (n, 6, 6) at all events, from the detections more than `width` s before or after.

        With a width of zero, from all detections but those of the event itself and of others at the same time.
        """
        count, times = len(self.trajectory.events), self.trajectory.times
        left = np.searchsorted(times, times - width, side="left") - 1
        right = np.searchsorted(times, times + width, side="right")
        states, covariances = np.empty((count, 6)), np.empty((count, 6, 6))
        for place in range(count):
            found = []
            for (means, spreads, _), near in ((self.ahead, int(left[place])), (self.behind, int(right[place]))):
                if 0 <= near < count:
                    step = self.run.step(float(times[place] - times[near]))
                    found.append(step.predict(means[near], spreads[near]))
            mean, covariance = found[0] if found else self._prior(place)
            if len(found) == 2:
                other, spread = found[1]
                gain = np.linalg.solve(covariance + spread, covariance).T
                mean, covariance = mean + gain @ (other - mean), covariance - gain @ covariance
            states[place], covariances[place] = mean, (covariance + covariance.T) / 2.0
        return states, covariances

    def _prior(self, place: int) -> tuple[Array, Array]:
        """Return a wide prior at a place of the trajectory: about the position there, at rest."""
        trajectory = self.trajectory
        far = max(float(np.linalg.norm(trajectory.states[place, :3] - c.pose.center)) for c in self.run.cameras)
        speeds = np.sqrt((trajectory.states[:, 3:] ** 2).mean(axis=1))
        stds = np.sqrt(np.trace(trajectory.covariances[:, 3:, 3:], axis1=1, axis2=2) / 3.0)
        # the median: at its beginning a track may seem faster than it ever is
        fast = float(np.median(speeds) + np.median(stds)) + LEAST * far
        mean = trajectory.states[place].copy()
        mean[3:] = 0.0
        return mean, np.diag(np.repeat([WIDE * far, FAST * fast], 3) ** 2)

    def _filtered(self, first: int, last: int, backwards: bool) -> tuple[Array, Array, float]:
        """Filtered states and covariances at the places from first to last, and the log-likelihood."""
        count, times = last - first, self.trajectory.times
        states, covariances, total = np.empty((count, 6)), np.empty((count, 6, 6)), 0.0
        places = range(last - 1, first - 1, -1) if backwards else range(first, last)
        before = places[0]
        mean, covariance = self._prior(before)
        for place in places:
            if place != before:
                mean, covariance = self.run.step(float(times[place] - times[before])).predict(mean, covariance)
            before = place
            measured = self._measured(place)
            if measured is not None:
                mean, covariance, density = _updated(mean, covariance, measured)
                total += density
            states[place - first], covariances[place - first] = mean, covariance
        return states, covariances, total

    def _measured(self, place: int) -> tuple[Array, Array, Array] | None:
        """Linearised measurement at a place: pixel (2,), derivative (2, 6), noise (2, 2); None without a detection."""
        event = int(self.trajectory.events[place])
        detection = self.detections.get(event)
        if detection is None:
            return None
        found, state = self.run.event(event), self.trajectory.states[place]
        points, jacobians = self.run.pixels(event, state[None], detection)
        if not (np.isfinite(points).all() and np.isfinite(jacobians).all()):
            return None
        return found.points[detection] - points[0] + jacobians[0] @ state, jacobians[0], found.covariances[detection]


def _updated(mean: Array, covariance: Array, measured: tuple[Array, Array, Array]) -> tuple[Array, Array, float]:
    """Kalman update; also the log-density of the measurement."""
    pixel, jacobian, noise = measured
    across = covariance @ jacobian.T
    spread = jacobian @ across + noise
    inverse = np.linalg.inv(spread)
    gain = across @ inverse
    error = pixel - jacobian @ mean
    determinant = float(spread[0, 0] * spread[1, 1] - spread[0, 1] * spread[1, 0])
    density = -0.5 * float(error @ inverse @ error) - 0.5 * float(np.log(determinant)) - float(np.log(2.0 * np.pi))
    keep = -gain @ jacobian
    keep[np.diag_indices(len(mean))] += 1.0
    # Joseph's form: symmetric and positive whatever the prior
    return mean + gain @ error, keep @ covariance @ keep.T + gain @ noise @ gain.T, density
