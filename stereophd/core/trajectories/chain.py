"""A track as a chain of states and detections: filtered both ways, smoothed, and its likelihood.

Measurements are linearised about the states that are known already, so that a pass is a linear Kalman filter in the
world. It begins with a wide prior, forwards or backwards. Whatever proposes other detections for tracks, or other
tracks for detections, is decided by what the detections gain: `WholeRun.gains` for one event, `Chain.log_likelihood`,
with the motion integrated out, for many. A proposal is accepted if it explains them better by more than `LEAST_GAIN`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import projective
from stereophd.core.motion.base import Motion
from stereophd.core.trajectories.chain_kernels import Measured, Pass, Steps, filter_chain, smooth_chain
from stereophd.core.trajectories.smoothing import Trajectory

# Nats by which a proposal must explain the detections better.
LEAST_GAIN = 1.0
# Squared Mahalanobis distance (99.9 % of a chi-square with 2 degrees of freedom) up to which a detection may be taken.
GATE = 13.8
# Smallest probability of a detection, and of a miss: 0 would make every one certain.
LEAST_RATE = 1e-6
# Standard deviations of the prior: of the position in distances from the camera, of the velocity in the track's speeds.
# From a wider one rounding leaves well known tracks no covariance.
WIDE, FAST = 1.0, 3.0
# Passes of a smoother, each linear about the last one, until no position moves by more than this many of its standard
# deviations: two of most tracks, more where detections are few or the track was far off.
MOST_PASSES, SETTLED = 10, 0.1
# In the place of a detection where a track has none.
NONE = -1


@dataclass(frozen=True)
class WholeRun:
    """The events of a run as arrays, r records in order of time and d detections, and how objects move."""

    cameras: tuple[Camera, ...]
    motion: Motion
    times: Array  # (r,), s
    looks: Integers  # (r,), camera of each record, `NONE` of a prediction, which has no detections
    starts: Integers  # (r + 1,), first detection of each record
    rows: Integers  # (d,), row of each detection in the log
    points: Array  # (d, 2), as those of `Event`, with all that follows
    noises: Array  # (d, 2, 2)
    areas: Array  # (d,)
    delays: Array  # (d,), s; 0 without a rolling shutter
    travels: Array  # (d, 3)

    def event_of(self, detections: Integers) -> Integers:
        """Return the event (n,) of each detection."""
        return np.searchsorted(self.starts, detections, side="right") - 1

    @cached_property
    def projections(self) -> Array:
        """Projection matrix (r, 3, 4) of the camera of every record, at its time."""
        out = np.zeros((len(self.times), 3, 4))
        for number, camera in enumerate(self.cameras):
            own = np.flatnonzero(self.looks == number)
            if camera.pose.is_static:
                out[own] = camera.projection_matrix
                continue
            for event in own.tolist():
                out[event] = camera.at(float(self.times[event])).projection_matrix
        return out

    @cached_property
    def _log_odds(self) -> tuple[Array, Array]:
        """Of each camera: log(p_D / ((1 - p_D) c)) with the density c of clutter, px^-2, and log(1 - p_D)."""
        p_detect = np.array([camera.detector.p_detect for camera in self.cameras])
        missed = np.log(np.maximum(1.0 - p_detect, LEAST_RATE))
        clutter = [c.detector.expected_clutter / (c.width * c.height) for c in self.cameras]
        return np.log(np.maximum(p_detect, LEAST_RATE)) - missed - np.log(clutter), missed

    def project(self, events: Integers, states: Array, detections: Integers) -> tuple[Array, Array]:
        """Pixels (n, 2) of states (n, 6) when detections (n,) of events (n,) were made, and derivatives (n, 2, 6)."""
        delays = self.delays[detections]
        positions = states[:, :3] + delays[:, None] * states[:, 3:] - self.travels[detections]
        points, jacobians = projective(self.projections[events], positions)
        return points, np.concatenate([jacobians, delays[:, None, None] * jacobians], axis=2)

    def in_view(self, events: Integers, states: Array) -> Booleans:
        """Whether states (n, 6) are in view at events (n,) that are no predictions."""
        out = np.zeros(len(events), dtype=np.bool_)
        for number, camera in enumerate(self.cameras):
            own = np.flatnonzero(self.looks[events] == number)
            out[own] = camera.contains(camera.project_at(states[own, :3], self.times[events[own]]))
        return out

    def gains(self, event: int, states: Array, covariances: Array) -> Array:
        """Gain (t, m) of each detection of an event for objects in states (t, 6), (t, 6, 6), over being missed, nats.

        The logarithm of ``p_D N(z; h(x), S) / ((1 - p_D) c)``; minus infinity beyond the gate and out of view.
        """
        detections = np.arange(self.starts[event], self.starts[event + 1])
        count = len(detections)
        out = np.full((len(states), count), -np.inf)
        seen = np.flatnonzero(self.in_view(np.full(len(states), event), states)) if count else np.empty(0, np.int64)
        if not len(seen):
            return out
        who, what = np.repeat(seen, count), np.tile(detections, len(seen))
        points, jacobians = self.project(np.full(len(who), event), states[who], what)
        spread = jacobians @ covariances[who] @ np.swapaxes(jacobians, 1, 2) + self.noises[what]
        with np.errstate(invalid="ignore"):
            distances, log_determinants = squared_distances(self.points[what] - points, spread)
        densities = np.log(self.areas[what]) - np.log(2.0 * np.pi) - 0.5 * (distances + log_determinants)
        # of a track that follows nothing rounding may leave no covariance: it gains nothing
        near = (distances >= 0.0) & (distances <= GATE) & np.isfinite(densities)
        out[seen] = np.where(near, densities + self._log_odds[0][self.looks[event]], -np.inf).reshape(len(seen), count)
        return out

    def log_odds(self, events: Integers, detections: Integers, states: Array) -> float:
        """Log-likelihood of detections and misses of a track but for the densities of its pixels."""
        hits, misses = self._log_odds
        known = detections != NONE
        looks = self.looks[events]
        total = float((hits + misses)[looks[known]].sum() + np.log(self.areas[detections[known]]).sum())
        missing = np.flatnonzero(~known & (looks != NONE))
        seen = self.in_view(events[missing], states[missing])
        return total + float(misses[looks[missing[seen]]].sum())

    def steps(self, times: Array) -> Steps:
        """Return the motion between successive times (n,) in any order."""
        dt = np.diff(times, prepend=times[:1])
        flow, noise = self.motion.flow(dt), self.motion.noise(dt)
        keep = np.broadcast_to(flow.keep, dt.shape).astype(np.float64)
        return Steps(flow.reach, keep, flow.drift, *noise, self.motion.noise_std**2)


def make_run(events: Sequence[Event | None], times: Array, cameras: Sequence[Camera], motion: Motion) -> WholeRun:
    """Return the records of a run, None for a prediction, at their times (r,) as arrays."""
    known = [event for event in events if event is not None]
    counts = [0 if event is None else len(event.points) for event in events]

    def joined(parts: list[Array], *shape: int) -> Array:
        return np.concatenate([np.empty((0, *shape)), *parts])

    return WholeRun(
        tuple(cameras),
        motion,
        np.asarray(times, dtype=np.float64),
        np.array([NONE if event is None else event.camera for event in events], dtype=np.int64),
        np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64),
        np.concatenate([np.empty(0, dtype=np.int64), *map(_rows, known)]),
        joined([event.points for event in known], 2),
        joined([event.covariances for event in known], 2, 2),
        joined([event.areas for event in known]),
        joined([np.zeros(len(event.points)) if event.delays is None else event.delays for event in known]),
        joined([np.zeros((len(event.points), 3)) if event.travels is None else event.travels for event in known], 3),
    )


def _rows(event: Event) -> Integers:
    return np.arange(len(event.points)) if event.rows is None else event.rows


def squared_distances(errors: Array, covariances: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distances (n,) of errors (n, 2), and the logarithms of the determinants (n,)."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    determinants = a * c - b * b
    u, v = errors[:, 0], errors[:, 1]
    return (c * u * u - 2.0 * b * u * v + a * v * v) / determinants, np.log(determinants)


@dataclass(frozen=True)
class Chain:
    """A track and its detections."""

    trajectory: Trajectory  # what measurements are linearised about
    detections: Integers  # (k,), that of the run at each event, or `NONE`
    run: WholeRun
    speed: float  # usual speed of the track, for the prior

    @cached_property
    def ahead(self) -> tuple[Array, Array, float]:
        """States (k, 6) and covariances (k, 6, 6) filtered forwards, and the log-likelihood of the pixels."""
        forward, total = self._filtered(self._steps, self._measured, 0)
        return forward.states, forward.covariances, total

    @cached_property
    def behind(self) -> tuple[Array, Array]:
        """States (k, 6) and covariances (k, 6, 6) filtered backwards."""
        steps = self.run.steps(self.trajectory.times[::-1])
        measured = Measured._make(np.ascontiguousarray(each[::-1]) for each in self._measured)
        backward, _ = self._filtered(steps, measured, -1)
        return backward.states[::-1], backward.covariances[::-1]

    @property
    def n_detections(self) -> int:
        """Number of detections of the track."""
        return int(np.count_nonzero(self.detections != NONE))

    def around(self, first_event: int, last_event: int, reach: int) -> tuple[int, int]:
        """Places in the trajectory (last one excluded) of events and of so many to either side."""
        first, last = np.searchsorted(self.trajectory.events, [first_event, last_event + 1])
        return max(int(first) - reach, 0), min(int(last) + reach, len(self.trajectory.events))

    def part(self, first: int, last: int) -> Self:
        """Return the track at the places from first to last (excluded)."""
        return replace(
            self, trajectory=self.trajectory.take(slice(first, last)), detections=self.detections[first:last]
        )

    def with_part(self, part: Self, first: int) -> Self:
        """Return the track with the states of a part of it that begins at a place."""
        whole, places = self.trajectory, slice(first, first + len(part.detections))
        states, covariances = whole.states.copy(), whole.covariances.copy()
        states[places], covariances[places] = part.trajectory.states, part.trajectory.covariances
        return replace(self, trajectory=replace(whole, states=states, covariances=covariances))

    def smoothed(self) -> Self:
        """Return the track smoothed from its detections, unless the passes lead nowhere."""
        chain = self
        for _ in range(MOST_PASSES):
            before = chain.trajectory
            forward, _ = chain._filtered(chain._steps, chain._measured, 0)
            states, covariances = np.empty_like(forward.states), np.empty_like(forward.covariances)
            smooth_chain(chain._steps, chain._measured, forward, states, covariances)
            variances = np.diagonal(covariances, axis1=1, axis2=2)
            if not (variances > 0.0).all():
                break
            chain = replace(chain, trajectory=replace(before, states=states, covariances=covariances))
            if (np.abs(states - before.states)[:, :3] <= SETTLED * np.sqrt(variances[:, :3])).all():
                break
        return chain

    @cached_property
    def log_likelihood(self) -> float:
        """Log-likelihood of detections, misses and clutter; what no track has is clutter.

        Terms that do not depend on the detections of this track are left out.
        """
        track = self.trajectory
        return self.ahead[2] + self.run.log_odds(track.events, self.detections, track.states)

    def without_window(self, width: float) -> tuple[Array, Array]:
        """States (k, 6), covariances (k, 6, 6) at all events, from the detections more than `width` s before or after.

        With a width of zero, from all detections but those of the event itself and of others at the same time.
        """
        times = self.trajectory.times
        count = len(times)
        left = np.searchsorted(times, times - width, side="left") - 1
        right = np.searchsorted(times, times + width, side="right")
        before, after = left >= 0, right < count
        states, covariances = self._prior(np.arange(count))
        states[before], covariances[before] = self._carried(self.ahead[:2], left[before], np.flatnonzero(before))
        alone = after & ~before
        states[alone], covariances[alone] = self._carried(self.behind, right[alone], np.flatnonzero(alone))
        both = np.flatnonzero(before & after)
        others, spreads = self._carried(self.behind, right[both], both)
        spread_before = covariances[both]
        gains = np.swapaxes(np.linalg.solve(spread_before + spreads, spread_before), 1, 2)
        states[both] += np.einsum("nij,nj->ni", gains, others - states[both])
        covariances[both] -= gains @ spread_before
        return states, (covariances + np.swapaxes(covariances, 1, 2)) / 2.0

    def _carried(self, known: tuple[Array, Array], sources: Integers, places: Integers) -> tuple[Array, Array]:
        """Gaussians known at some places predicted to others."""
        times = self.trajectory.times
        step = self.run.motion.transition(times[places] - times[sources])
        return step.predict(known[0][sources], known[1][sources])

    @cached_property
    def _steps(self) -> Steps:
        return self.run.steps(self.trajectory.times)

    @cached_property
    def _measured(self) -> Measured:
        track, run = self.trajectory, self.run
        known = self.detections != NONE
        if not len(run.points):
            count = len(known)
            return Measured(known, np.zeros((count, 2)), np.zeros((count, 2, 6)), np.zeros((count, 2, 2)))
        at = np.where(known, self.detections, 0)
        points, jacobians = run.project(track.events, track.states, at)
        known = known & np.isfinite(points).all(axis=1) & np.isfinite(jacobians).all(axis=(1, 2))
        pixels = run.points[at] - points + np.einsum("nij,nj->ni", jacobians, track.states)
        return Measured(known, pixels, np.ascontiguousarray(jacobians), run.noises[at])

    def _prior(self, places: Integers) -> tuple[Array, Array]:
        """Wide priors (n, 6), (n, 6, 6) at places of the trajectory: about the position there, at rest."""
        means = self.trajectory.states[places].copy()
        means[:, 3:] = 0.0
        centers = np.array([camera.pose.center for camera in self.run.cameras])
        far = np.linalg.norm(means[:, None, :3] - centers, axis=2).max(axis=1)
        covariances = np.zeros((len(places), 6, 6))
        axes = np.arange(3)
        covariances[:, axes, axes] = (WIDE * far[:, None]) ** 2
        covariances[:, 3 + axes, 3 + axes] = (FAST * (self.speed + LEAST_RATE * far[:, None])) ** 2
        return means, covariances

    def _filtered(self, steps: Steps, measured: Measured, begin: int) -> tuple[Pass, float]:
        """Pass over the places, with a prior at the one where it begins, and the log-likelihood of the pixels."""
        count = len(steps.reach)
        out = Pass(np.empty((count, 6)), np.empty((count, 6, 6)), np.empty((count, 6)), np.empty((count, 6, 6)))
        means, covariances = self._prior(np.array([begin]))
        return out, filter_chain(steps, measured, means[0], covariances[0], out)


def make_chain(trajectory: Trajectory, detections: Integers, run: WholeRun) -> Chain:
    """Return a track with detections (k,), with its usual speed from its states."""
    speeds = np.sqrt((trajectory.states[:, 3:] ** 2).mean(axis=1))
    stds = np.sqrt(np.trace(trajectory.covariances[:, 3:, 3:], axis1=1, axis2=2) / 3.0)
    # the median: at its beginning a track may seem faster than it ever is
    return Chain(trajectory, detections, run, float(np.median(speeds) + np.median(stds)))
