"""Detections that an object made before its track begins, found from where the smoothed track was then.

A filter that sees an object for the first time does not know its depth and velocity: a missed detection right
after, and the next detection looks as much like another object's first. The smoothed track does know them, and
predicts back where the object was, with state x and covariance P, to each earlier event. The object being there makes
the detections of the event more probable by the factor

    L = 1 - p_D + p_D sum_z N(z; h(x), S) / c(z),    c(z) = clutter + sum_o p_D N(z; h(x_o), S_o) / (1 - p_D)

over the other tracks o, of which one that does not have the detection has missed one.

The odds that its first detection was at event m, rather than where the track begins, are the product of the factors of
the events from m on, the factor of m without the miss (births are equally probable at all events). The track reaches
back to the events at which the object was more probable there than not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.trajectories.chain import WholeRun
from stereophd.core.trajectories.smoothing import Trajectory, extend_back

# An earlier first detection that is less probable than this, next to the track's own, is not looked for.
LEAST_RATIO = 1e-6
# An object that is more probable than this was there, and a detection more probably its own than not counts as its.
PROBABLE = 0.5


@dataclass(frozen=True)
class Extended:
    """A track continued back."""

    trajectory: Trajectory
    # (n,): detections of the events added at which the object was probably detected, and whether each is its own
    detections: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    probabilities: Array = field(default_factory=lambda: np.empty(0))


def reach_back(trajectory: Trajectory, others: Sequence[Trajectory], run: WholeRun, max_gap_s: float) -> Extended:
    """Continue a smoothed trajectory back to the first detection that its object probably made.

    `others` are all other tracks, smoothed; `max_gap_s` is the longest time to look back.
    """
    first = int(trajectory.events[0])
    # in logarithms: of the factor of all events so far, and of the weight of each event as the first
    factor, weights = 0.0, [0.0]
    parts: list[tuple[int, Array]] = []
    for event in range(first - 1, -1, -1):
        if trajectory.times[0] - run.times[event] > max_gap_s or factor < max(weights) + np.log(LEAST_RATIO):
            break
        terms, missed = _factors(trajectory, others, event, run)
        detected = float(terms.sum())
        if detected > missed:
            parts.append((event, terms / (detected + missed)))
        weights.append(factor + np.log(detected) if detected > 0.0 else -np.inf)
        factor += np.log(detected + missed) if detected + missed > 0.0 else -np.inf
    shares = np.exp(np.array(weights) - max(weights))
    # probability that the first detection was at an event or before it, back from the track's own
    there = np.cumsum(shares[::-1])[::-1] / shares.sum()
    back = int(np.count_nonzero(there[1:] > PROBABLE))
    earlier = np.arange(first - back, first)
    parts = [part for part in parts if part[0] >= first - back]
    return Extended(
        extend_back(trajectory, earlier, run.times[earlier], run.motion, trajectory.existence[0] * there[back:0:-1]),
        np.concatenate([np.empty(0, np.int64), *(np.arange(*run.starts[[k, k + 1]]) for k, _ in parts)]),
        np.concatenate([np.empty(0), *(terms for _, terms in parts)]),
    )


def _factors(trajectory: Trajectory, others: Sequence[Trajectory], event: int, run: WholeRun) -> tuple[Array, float]:
    """Return the terms of L for an event: of each detection, and missed; no terms and 1 where nothing is known."""
    nothing = np.zeros(run.starts[event + 1] - run.starts[event]), 1.0
    if run.looks[event] < 0:
        return nothing
    dt = run.times[[event]] - trajectory.times[0]
    state, covariance = run.motion.transition(dt).predict(trajectory.states[:1], trajectory.covariances[:1])
    if not run.in_view(np.array([event]), state)[0]:
        return nothing
    p_detect = run.cameras[run.looks[event]].detector.p_detect
    # odds of each detection over clutter, and those of others: were it not theirs, they would have missed one
    there = [(other, k) for other in others if (k := other.place(event)) >= 0]
    states = np.concatenate([state, *(other.states[k : k + 1] for other, k in there)])
    covariances = np.concatenate([covariance, *(other.covariances[k : k + 1] for other, k in there)])
    odds = np.exp(run.gains(event, states, covariances))
    missed = max(1.0 - p_detect, LEAST_RATIO)
    return missed * odds[0] / (1.0 + odds[1:].sum(axis=0)), missed
