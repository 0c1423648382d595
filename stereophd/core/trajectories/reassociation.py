"""Smoothed tracks choose their detections anew: neighbours that a filter took for each other are exchanged (ours).

A filter decides from the past alone. Where objects are near one another and seldom seen it takes one for its neighbour
for an event or two, above all at the first frames, when it knows neither depth nor velocity. The smoother knows what
follows, but it keeps the decision. Here all detections of each track decide:

1. *Proposal.* At every event each track is predicted from its detections before and after, without those within a
   window about the event: first the event alone, then half an interval between frames to either side, for cameras that
   look one after another can be wrong together. Tracks and detections are assigned at the greatest total gain

       log(p_D N(z; h(x), S) / c) - log(1 - p_D),

   with the density c of clutter.
2. *Decision.* Changes that share tracks or detections within the window are one group. A group is accepted if it raises
   the log-likelihood of all detections of its tracks, with their motion integrated out, by more than `LEAST_GAIN`. One
   that does not is divided in time, and its parts are tried, down to single events.

3. *Ends.* Once a round of all windows changes nothing, tracks that never change back to their own objects, so that no
   window is long enough, exchange their ends (`stereophd.core.trajectories.exchanged_ends`).

This is repeated until nothing changes, for `ROUNDS` rounds at most. A track whose detections change is smoothed again
from its detections; the others stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.trajectories.chains import Chain, WholeRun
from stereophd.core.trajectories.exchanged_ends import cuts, with_ends_exchanged
from stereophd.core.trajectories.smoothing import Trajectory

# Squared Mahalanobis distance (99.9 % of a chi-square with 2 degrees of freedom) up to which a detection may be taken.
GATE = 13.8
# Nats by which a change must be better.
LEAST_GAIN = 1.0
# Most rounds, and events to either side of a group over which its tracks are compared.
ROUNDS, REACH = 6, 60
# Windows about an event, to either side, in intervals between frames.
WINDOWS = (0.0, 0.5, 1.0)
# Times the window, to either side of a cut, in which the two tracks choose anew.
AROUND = 4.0
# A clutter of zero would make every detection certain.
LEAST_CLUTTER = 1e-6

# Detection of each event (numbers of both) that a track has.
Detections = Mapping[int, int]


@dataclass(frozen=True)
class Reassociated:
    """A track after its detections were chosen anew."""

    trajectory: Trajectory  # Smoothed again if any of its detections changed, and otherwise the one given
    # Event -> (detection before, detection after), None for none, of every event that changed.
    changed: dict[int, tuple[int | None, int | None]] = field(default_factory=dict)


def reassociate(
    trajectories: Sequence[Trajectory],
    detections: Sequence[Detections],
    events: Sequence[Event | None],
    cameras: Sequence[Camera],
    motion: Motion,
) -> list[Reassociated]:
    """Let smoothed tracks choose their detections anew.

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Smoothed, over events from their first to their last.
    detections : sequence of mapping
        Event -> detection of each track, by their numbers.
    events : sequence of Event or None
        Every record of the run; None: a prediction, which has no detections.
    cameras : sequence of Camera
    motion : Motion
        One that moves.
    """
    run = WholeRun(tuple(events), tuple(cameras), motion)
    chains = [Chain(t, dict(own), run) for t, own in zip(trajectories, detections, strict=True)]
    interval = _frame_interval(events)
    quiet = 0
    for number in range(ROUNDS * len(WINDOWS)):
        width = WINDOWS[number % len(WINDOWS)] * interval
        accepted = _decide_parts(chains, run, list(_proposed(chains, run, width)), 2.0 * width + interval)
        quiet = 0 if accepted else quiet + 1
        if quiet == len(WINDOWS):
            if not sum(_exchange_ends(chains, width * interval) for width in WINDOWS if width):
                break
            quiet = 0
    out = []
    for trajectory, before, chain in zip(trajectories, detections, chains, strict=True):
        changed = {
            event: (before.get(event), chain.detections.get(event))
            for event in sorted({*before, *chain.detections})
            if before.get(event) != chain.detections.get(event)
        }
        out.append(Reassociated(chain.trajectory if changed else trajectory, changed))
    return out


def _exchange_ends(chains: list[Chain], width: float) -> int:
    """Exchange the ends of tracks that continue each other better than themselves; return how many were exchanged.

    About the cut the two choose their detections anew. A second cut is tried after the first, for objects that were
    exchanged for some time only. What raises the log-likelihood most is taken.
    """
    done: set[int] = set()
    for cut in sorted(cuts(chains, width, LEAST_GAIN), key=lambda one: -one.odds):
        if not done.isdisjoint({cut.one, cut.other}):
            continue
        before = [chains[cut.one], chains[cut.other]]
        others = [one for k, one in enumerate(chains) if k not in {cut.one, cut.other}]
        tried = [_cut_at(before, cut.event, others, width)]
        tried += [_cut_at(tried[0], one.event, others, width) for one in cuts(tried[0], width, 0.0)]
        totals = [sum(one.log_likelihood(0, len(one.trajectory.events)) for one in pair) for pair in (before, *tried)]
        best = int(np.argmax(totals))
        if totals[best] > totals[0] + LEAST_GAIN:
            chains[cut.one], chains[cut.other] = tried[best - 1]
            done |= {cut.one, cut.other}
    return len(done) // 2


def _cut_at(pair: Sequence[Chain], event: int, others: Sequence[Chain], width: float) -> list[Chain]:
    """Return two tracks with their ends after an event exchanged, and the detections about it chosen anew."""
    run, track = pair[0].run, pair[0].trajectory
    at_s = float(track.times[np.searchsorted(track.events, event)])
    found = [one.smoothed() for one in with_ends_exchanged(pair[0], pair[1], event)]
    for again in (width, 0.0, width):
        near = [
            change
            for change in _proposed(found, run, again)
            if abs(run.time(change.event) - at_s) <= AROUND * width and not _has(others, change)
        ]
        _decide_parts(found, run, near, AROUND * width)
    return found


def _has(chains: Sequence[Chain], change: _Change) -> bool:
    """Whether one of some tracks has the detection that a change takes."""
    return change.after is not None and any(one.detections.get(change.event) == change.after for one in chains)


def _frame_interval(events: Sequence[Event | None]) -> float:
    """Median interval between frames of one camera, s; 0 where none has two."""
    times: dict[int, list[float]] = {}
    for event in events:
        if event is not None:
            times.setdefault(event.camera, []).append(event.time_s)
    steps = np.concatenate([np.empty(0), *(np.diff(own) for own in times.values())])
    return float(np.median(steps)) if len(steps) else 0.0


@dataclass(frozen=True)
class _Change:
    """What one event would give to one track: a detection, or none."""

    event: int
    chain: int
    before: int | None
    after: int | None


def _proposed(chains: Sequence[Chain], run: WholeRun, width: float) -> Iterator[_Change]:
    """Changes of the joint assignment of every event, in order of events."""
    at: dict[int, list[tuple[int, Array, Array]]] = {}
    for number, chain in enumerate(chains):
        states, covariances = chain.without_window(width)
        for k, event in enumerate(chain.trajectory.events.tolist()):
            at.setdefault(event, []).append((number, states[k], covariances[k]))
    for event, tracks in sorted(at.items()):
        found = run.events[event]
        if found is None or not len(found.points):
            continue
        taken = _assigned(run, event, np.stack([s for _, s, _ in tracks]), np.stack([c for _, _, c in tracks]))
        for (number, _, _), detection in zip(tracks, taken, strict=True):
            before = chains[number].detections.get(event)
            if detection != before:
                yield _Change(event, number, before, detection)


def _assigned(run: WholeRun, event: int, states: Array, covariances: Array) -> list[int | None]:
    """Detection of each of some tracks (t, 6), (t, 6, 6) at an event, at the greatest total gain."""
    found = run.event(event)
    camera = run.cameras[found.camera]
    in_view, (points, jacobians) = run.in_view(event, states), run.pixels(event, states)
    spread = jacobians @ covariances @ np.swapaxes(jacobians, 1, 2)
    gains = np.full((len(states), len(found.points)), -np.inf)
    p_detect = camera.detector.p_detect
    clutter = max(camera.detector.clutter_per_frame, LEAST_CLUTTER) / (camera.width * camera.height)
    for row in np.flatnonzero(in_view).tolist():
        every = spread[row] + found.covariances
        errors = found.points - points[row]
        distances = np.einsum("mi,mi->m", errors, np.linalg.solve(every, errors[:, :, None])[:, :, 0])
        densities = -0.5 * distances - np.log(2.0 * np.pi) - 0.5 * np.log(np.linalg.det(every)) + np.log(found.areas)
        gain = densities + np.log(p_detect / max(1.0 - p_detect, LEAST_CLUTTER)) - np.log(clutter)
        gains[row] = np.where(distances <= GATE, gain, -np.inf)
    # a track may also have none of them, at no gain
    table = np.concatenate([np.where(np.isfinite(gains), np.maximum(gains, 0.0), 0.0), np.zeros(2 * (len(states),))], 1)
    from scipy.optimize import linear_sum_assignment  # costly to import, often not needed

    rows, columns = linear_sum_assignment(-table)
    out: list[int | None] = [None] * len(states)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if column < gains.shape[1] and gains[row, column] > 0.0:
            out[row] = column
    return out


def _groups(changes: Sequence[_Change], run: WholeRun, apart_s: float) -> list[list[_Change]]:
    """Changes that share tracks or detections, no further apart in time than this."""
    groups: list[list[_Change]] = []
    for change in changes:
        time_s = run.time(change.event)
        joined = [
            group
            for group in groups
            if any(_meet(change, other) and time_s - run.time(other.event) <= apart_s for other in group)
        ]
        groups = [group for group in groups if not any(group is one for one in joined)]
        groups.append([one for group in joined for one in group] + [change])
    return groups


def _meet(one: _Change, other: _Change) -> bool:
    """Whether two changes concern one track, or one detection."""
    if one.chain == other.chain:
        return True
    if one.event != other.event:
        return False
    return not {one.before, one.after}.isdisjoint({other.before, other.after} - {None})


def _decide_parts(chains: list[Chain], run: WholeRun, changes: Sequence[_Change], apart_s: float) -> int:
    """Decide groups of changes; those that are not taken, once more in two parts, divided where most time passes."""
    taken = 0
    for group in _groups(changes, run, apart_s):
        if count := _decide(chains, group):
            taken += count
            continue
        events = sorted({change.event for change in group})
        if len(events) > 1:
            widest = int(np.argmax(np.diff([run.time(event) for event in events])))
            for part in (events[: widest + 1], events[widest + 1 :]):
                taken += _decide_parts(chains, run, [one for one in group if one.event in part], apart_s)
    return taken


def _decide(chains: list[Chain], group: Sequence[_Change]) -> int:
    """Take a group of changes into the chains if it explains the detections better; return how many were taken."""
    numbers = sorted({change.chain for change in group})
    owners = {(event, d): number for number in numbers for event, d in chains[number].detections.items()}
    for change in group:
        held = None if change.after is None else owners.get((change.event, change.after))
        let_go = held is None or any(o.chain == held and o.event == change.event for o in group)
        if not let_go or _has([one for k, one in enumerate(chains) if k not in numbers], change):
            return 0  # another track has that detection, and does not give it away
    events = [change.event for change in group]
    gain, tried = 0.0, {}
    for number in numbers:
        chain = chains[number]
        new = dict(chain.detections)
        for change in group:
            if change.chain == number:
                new.pop(change.event, None)
                if change.after is not None:
                    new[change.event] = change.after
        first, last = chain.around(min(events), max(events), REACH)
        other = replace(chain, detections=new).smoothed(first, last)
        gain += other.log_likelihood(first, last) - chain.log_likelihood(first, last)
        tried[number] = new
    if not gain > LEAST_GAIN:
        return 0
    for number, new in tried.items():
        chains[number] = replace(chains[number], detections=new).smoothed()
    return len(group)
