"""Detections that an object made before its track begins, found from where the smoothed track was then.

A filter that sees an object for the first time does not know its depth and velocity: a missed detection right
after, and the next detection looks as much like another object's first. The smoothed track does know them, and
predicts back where the object was, with state x and covariance P, to each earlier event. With the pixel h(x), its
Jacobian J, S = J P J^T + R, and the density c of what else detection z may be, the object being there makes the
detections of the event more probable by the factor

    L = 1 - p_D + p_D sum_z N(z; h(x), S) / c(z),    c(z) = clutter + sum_o p_D N(z; h(x_o), S_o) / (1 - p_D)

over the other tracks o, of which one that does not have the detection has missed one.

The odds that its first detection was at event m, rather than where the track begins, are the product of the factors of
the events from m on, the factor of m without the miss (births are equally probable at all events). The track reaches
back to the events at which the object was more probable there than not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import projective
from stereophd.core.motion.base import Motion
from stereophd.core.trajectories.smoothing import Trajectory, extend_back

# Squared Mahalanobis distance (99 % of a chi-square with 2 degrees of freedom) of a detection that may be the first.
GATE = 9.21
# An earlier first detection that is less probable than this, next to the track's own, is not looked for.
LEAST_RATIO = 1e-6
# An object that is more probable than this was there, and a detection more probably its own than not counts as its.
PROBABLE = 0.5

# The terms of an event without information.
NOTHING: tuple[Array, float] = (np.zeros(0), 1.0)


@dataclass(frozen=True)
class Extended:
    """A track continued back."""

    trajectory: Trajectory
    # Numbers of the events, among those added, with a detection that is probably the object's.
    detected: tuple[int, ...] = ()
    # For each of these events, the probability of each of its detections to be the object's.
    shares: tuple[Array, ...] = ()


def reach_back(
    trajectory: Trajectory,
    others: Sequence[Trajectory],
    events: Sequence[Event | None],
    times: Array,
    cameras: Sequence[Camera],
    motion: Motion,
    max_gap_s: float,
) -> Extended:
    """Continue a smoothed trajectory back to the first detection that its object probably made.

    Parameters
    ----------
    trajectory : Trajectory
    others : sequence of Trajectory
        All other tracks, smoothed.
    events : sequence of Event or None
        Every record of the run; None: a prediction, which has no detections.
    times : array
        Their times, s.
    cameras : sequence of Camera
    motion : Motion
    max_gap_s : float
        Longest time to look back, s.
    """
    first = int(trajectory.events[0])
    # in logarithms: of the factor of all events so far, and of the weight of each event as the first
    factor, weights = 0.0, [0.0]
    found: list[tuple[int, Array]] = []
    for number in range(first - 1, -1, -1):
        if trajectory.times[0] - times[number] > max_gap_s or factor < max(weights) + np.log(LEAST_RATIO):
            break
        event = events[number]
        by, missed = NOTHING if event is None else _factors(trajectory, others, number, event, cameras, motion)
        detected = float(by.sum())
        if detected > missed:
            found.append((number, by / (detected + missed)))
        weights.append(factor + np.log(detected) if detected > 0.0 else -np.inf)
        factor += np.log(detected + missed) if detected + missed > 0.0 else -np.inf
    shares = np.exp(np.array(weights) - max(weights))
    # probability that the first detection was at an event or before it, back from the track's own
    there = np.cumsum(shares[::-1])[::-1] / shares.sum()
    back = int(np.count_nonzero(there[1:] > PROBABLE))
    if back == 0:
        return Extended(trajectory)
    earlier = np.arange(first - back, first)
    extended = extend_back(trajectory, earlier, times[earlier], motion, trajectory.existence[0] * there[back:0:-1])
    found = [one for one in found if one[0] >= first - back]
    return Extended(extended, tuple(number for number, _ in found), tuple(shares for _, shares in found))


def _factors(
    trajectory: Trajectory,
    others: Sequence[Trajectory],
    number: int,
    event: Event,
    cameras: Sequence[Camera],
    motion: Motion,
) -> tuple[Array, float]:
    """Return the terms of L for an event: of each detection, and missed."""
    camera = cameras[event.camera].at(event.time_s)
    transition = motion.transition(float(event.time_s - trajectory.times[0]))
    state, covariance = transition.predict(trajectory.states[0], trajectory.covariances[0])
    p_detect, densities = _detections(camera, event, state, covariance)
    if p_detect == 0.0:
        return NOTHING
    background = np.full(len(event.points), camera.detector.clutter_per_frame / (camera.width * camera.height))
    for other in others:
        k = int(np.searchsorted(other.events, number))
        if k < len(other.events) and other.events[k] == number:
            probability, density = _detections(camera, event, other.states[k], other.covariances[k])
            # were the detection not the other track's, that would have missed
            background += probability / max(1.0 - probability, LEAST_RATIO) * density
    likely = densities > 0.0
    # Without clutter a detection near the track is almost surely the object's.
    others_density = np.maximum(background[likely], LEAST_RATIO * densities[likely])
    terms = np.zeros(len(densities))
    terms[likely] = p_detect * densities[likely] / others_density
    return terms, 1.0 - p_detect


def _detections(camera: Camera, event: Event, state: Array, covariance: Array) -> tuple[float, Array]:
    """Return the probability that an object is detected, and its density (per pixel of the image) at each detection.

    The density is zero outside of the gate.
    """
    if not camera.in_view(state[None, :3])[0]:
        return 0.0, np.zeros(len(event.points))
    delays = np.zeros(len(event.points)) if event.delays is None else event.delays
    positions = state[:3] + delays[:, None] * state[3:]
    if event.travels is not None:
        positions = positions - event.travels
    points, jacobians = projective(camera.projection_matrix, positions)
    spread = jacobians @ covariance[:3, :3] @ np.swapaxes(jacobians, 1, 2) + event.covariances
    errors = event.points - points
    distances = np.einsum("mi,mi->m", errors, np.linalg.solve(spread, errors[:, :, None])[:, :, 0])
    densities = np.exp(-0.5 * distances) / (2.0 * np.pi * np.sqrt(np.linalg.det(spread))) * event.areas
    return camera.detector.p_detect, np.where(distances <= GATE, densities, 0.0)
