"""Two tracks that exchanged their objects and never changed back: the ends of both are exchanged (ours).

At a cut the state of track a from its detections before, predicted over a window to the first event after it, is
compared with the state of track b from its detections from there on. With the difference d and its covariance S the
logarithm of the odds that each track continues as the other, and not as itself, is

    log N(d_ab; 0, S_ab) + log N(d_ba; 0, S_ba) - log N(d_aa; 0, S_aa) - log N(d_bb; 0, S_bb),

for the detections before and after the window are the same in both. `stereophd.core.trajectories.reassociation` says
what becomes of those in the window.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.trajectories.chains import Chain
from stereophd.core.trajectories.smoothing import Trajectory

# Tracks further apart than this many standard deviations of a prediction over the window do not exchange their ends.
NEAR = 6.0
# Fewest events before and after a cut.
LEAST_EVENTS = 6


class Cut(NamedTuple):
    """An exchange of the ends of two chains after an event, and its log-odds."""

    one: int
    other: int
    event: int
    odds: float


def cuts(chains: Sequence[Chain], width: float, least: float) -> Iterator[Cut]:
    """Yield the best cut of every two chains, with windows of `width` s to either side, where its odds exceed `least`.

    Only events that both tracks have count.
    """
    for i in range(len(chains)):
        for j in range(i + 1, len(chains)):
            found = _best_cut(chains[i], chains[j], width)
            if found is not None and found[1] > least:
                yield Cut(i, j, *found)


def with_ends_exchanged(one: Chain, other: Chain, event: int) -> tuple[Chain, Chain]:
    """Return two chains whose ends after an event are exchanged."""
    parts = []
    for chain in (one, other):
        place = int(np.searchsorted(chain.trajectory.events, event, side="right"))
        parts.append((chain, place))
    (a, at_a), (b, at_b) = parts
    return _joined(a, at_a, b, at_b, event), _joined(b, at_b, a, at_a, event)


def _joined(before: Chain, place: int, after: Chain, since: int, event: int) -> Chain:
    """Return the one chain up to a place, and then the other."""
    first, last = before.trajectory, after.trajectory

    def joined(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([one[:place], other[since:]])

    trajectory = Trajectory(
        first.track_id, joined(first.events, last.events), joined(first.times, last.times),
        joined(first.states, last.states), joined(first.covariances, last.covariances),
        joined(first.existence, last.existence),
    )  # fmt: skip
    detections = {number: row for number, row in before.detections.items() if number <= event}
    detections |= {number: row for number, row in after.detections.items() if number > event}
    return Chain(trajectory, detections, before.run)


def _best_cut(one: Chain, other: Chain, width: float) -> tuple[int, float] | None:
    """Event and log-odds of the best cut of two chains; None where they have too little in common or never meet."""
    common, a, b = np.intersect1d(
        one.trajectory.events, other.trajectory.events, assume_unique=True, return_indices=True
    )
    if len(common) < 2 * LEAST_EVENTS:
        return None
    times = one.trajectory.times[a]
    left = np.searchsorted(times, times - width, side="right") - 1
    right = np.searchsorted(times, times + width, side="right")
    cut = np.flatnonzero((left >= LEAST_EVENTS) & (right < len(common) - LEAST_EVENTS))
    if not len(cut):
        return None
    left, right = left[cut], right[cut]
    steps = [one.run.step(float(dt)) for dt in times[right] - times[left]]
    matrix = np.stack([step.matrix for step in steps])
    noise, drift = np.stack([step.noise for step in steps]), np.stack([step.drift for step in steps])
    predicted, following = [], []
    for chain, places in ((one, a), (other, b)):
        mean, spread = chain.ahead[0][places[left]], chain.ahead[1][places[left]]
        state = np.einsum("nij,nj->ni", matrix, mean) + drift
        predicted.append((state, matrix @ spread @ np.swapaxes(matrix, 1, 2) + noise))
        following.append((chain.behind[0][places[right]], chain.behind[1][places[right]]))
    apart = np.linalg.norm(predicted[0][0][:, :3] - predicted[1][0][:, :3], axis=1)
    reach = sum(np.sqrt(np.trace(spread[:, :3, :3], axis1=1, axis2=2)) for _, spread in predicted)
    near = np.flatnonzero(apart <= NEAR * reach)
    if not len(near):
        return None
    odds = np.zeros(len(near))
    for sign, k, m in ((1.0, 0, 1), (1.0, 1, 0), (-1.0, 0, 0), (-1.0, 1, 1)):
        error = following[m][0][near] - predicted[k][0][near]
        spread = following[m][1][near] + predicted[k][1][near]
        distance = np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[:, :, None])[:, :, 0])
        odds += sign * (-0.5 * distance - 0.5 * np.linalg.slogdet(spread)[1])
    best = int(np.argmax(odds))
    return int(common[cut[near[best]]]), float(odds[best])
