"""Tracks choose their detections anew: neighbours that a filter took for each other are swapped (ours).

A filter decides from the past alone. Where objects are near one another and seldom seen it takes one for its neighbour
for an event or two, above all at the first frames, when it knows neither depth nor velocity. The smoother knows what
follows, but it keeps the decision. (`core.multi.swaps.swap_test` decides the same while the filter
runs.) Here all detections of each track decide, by two proposals:

1. *Windows.* At every event each track is predicted from its detections before and after, without those in a window
   about the event: first the event alone, then half an interval between frames to either side, then a whole one, for
   cameras that look one after another can be wrong together. Tracks and detections are assigned at the greatest total
   gain (`WholeRun.gains`). Changes that share tracks or detections within the window are one group. A group that does
   not explain the detections better is divided in time, down to single events.
2. *Ends.* Once a round of all windows changes nothing, tracks that never change back to their own objects, so that no
   window is long enough, swap their ends. At a cut the state of track a from its detections before, predicted over
   a window to the first event after it, is compared with that of track b from its detections from there on. With the
   difference d and its covariance S the log-odds that each track continues as the other, and not as itself, are

       log N(d_ab; 0, S_ab) + log N(d_ba; 0, S_ba) - log N(d_aa; 0, S_aa) - log N(d_bb; 0, S_bb).

   About the cut the two choose their detections anew.

Both are decided by the log-likelihood of all detections of the tracks that would change (`Chain.log_likelihood`). This
is repeated until nothing changes, for `ROUNDS` rounds at most. What was refused is not tried again before one of its
tracks has changed, no group is longer than `MOST_CHANGES`, and in every stretch of time each state is smoothed or
predicted `MOST_WORK` times in the mean: so the work grows with tracks times events, even in a crowd whose detections
are so much worse than stated that proposals never end.

Objects that are thought more agile than they are follow a wrong detection as well as a right one. So the noise of the
motion of each track is then taken at that factor of what is stated, of `FACTORS`, at which the track is likeliest, and
they choose once more. One factor for all would make an agile object among resting ones far too certain.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.motion.base import Accelerated
from stereophd.core.trajectories.chain import LEAST_GAIN, NONE, Chain, WholeRun

# Most rounds, and events to either side of a group over which its tracks are compared.
ROUNDS, REACH = 6, 30
# Factors on the noise of the motion, and the standard deviation of the prior of their logarithm.
FACTORS, FACTOR_STD = 2.0 ** np.arange(-5, 4), 0.5
# Windows about an event, to either side, in intervals between frames.
WINDOWS = (0.0, 0.5, 1.0)
# Most changes that are decided together: in a crowd all changes of a recording may be linked.
MOST_CHANGES = 64
# How often the states about an event are smoothed or predicted in the mean. Crowded corners of a board take 9 to 23.
MOST_WORK = 24
# Times the window, to either side of a cut, in which the two tracks choose anew.
AROUND = 4.0
# Tracks further apart than this many standard deviations of a prediction over the window do not swap their ends.
NEAR = 6.0
# Fewest events that both tracks have before and after a cut.
LEAST_EVENTS = 6
# Owner of a detection that tracks cannot take.
ANOTHER = -2


class Change(NamedTuple):
    """The detection that one event would give to one track in place of another; `NONE` for none."""

    event: int
    track: int
    before: int
    after: int


class Cut(NamedTuple):
    """A swap of the ends of two tracks after an event, and its log-odds."""

    first: int
    second: int
    event: int
    odds: float


def choose_anew(tracks: Sequence[Chain], run: WholeRun) -> tuple[list[Chain], Booleans]:
    """Let smoothed tracks, over events from their first to their last, choose their detections anew.

    No two have the same detection; the objects of the run move. Returns the same tracks, each smoothed from its
    detections at the noise of the motion that it shows; and the events (r,) about which they still changed when the
    work that is allowed there was done.
    """
    motion = run.motion
    assert isinstance(motion, Accelerated)
    found, _ = _chosen(tracks, run)
    runs = [replace(run, motion=replace(motion, acceleration_std=factor * motion.noise_std)) for factor in FACTORS]
    prior = 0.5 * (np.log(FACTORS) / FACTOR_STD) ** 2
    shown = [runs[int(np.argmax([replace(track, run=moved).ahead[2] for moved in runs] - prior))] for track in found]
    return _chosen([replace(track, run=own).smoothed() for track, own in zip(found, shown, strict=True)], run)


def _chosen(tracks: Sequence[Chain], run: WholeRun) -> tuple[list[Chain], Booleans]:
    """Return what tracks choose, each at the noise of its motion, and where the work ended, as `choose_anew`."""
    book = _Book(tracks, _owners(tracks, run), run)
    steps = np.concatenate([np.diff(run.times[run.looks == camera]) for camera in range(len(run.cameras))])
    interval = float(np.median(steps)) if len(steps) else 0.0
    everywhere = np.ones(len(run.times), dtype=np.bool_)
    touched = [everywhere] * len(WINDOWS)
    for number in range(ROUNDS * len(WINDOWS)):
        width = WINDOWS[number % len(WINDOWS)] * interval
        # elsewhere the last round has decided the same proposals
        where = np.logical_or.reduce(touched[-len(WINDOWS) :])
        book.decide_parts(book.proposed(width, where), 2.0 * width + interval)
        touched.append(book.settle())
        if not np.logical_or.reduce(touched[-len(WINDOWS) :]).any():
            if not sum(book.swap_ends(width * interval) for width in WINDOWS if width):
                break
            touched.append(book.settle())
    else:
        book.stopped |= touched[-1]
    return book.tracks, book.stopped


def assigned(gains: Array) -> Integers:
    """Return the detection (t,) of each of some tracks at the greatest total gain (t, m); `NONE` where none gains."""
    best = np.argmax(gains, axis=1)
    out = np.where(gains[np.arange(len(gains)), best] > 0.0, best, NONE)
    wanted = out[out != NONE]
    if len(np.unique(wanted)) == len(wanted):
        return out
    from scipy.optimize import linear_sum_assignment  # costly to import, often not needed

    # a track may also have none of them, at no gain
    table = np.concatenate([np.maximum(gains, 0.0), np.zeros((len(gains), len(gains)))], axis=1)
    rows, columns = linear_sum_assignment(-table)
    out[rows] = np.where(columns < gains.shape[1], columns, NONE)
    out[table[rows, columns] <= 0.0] = NONE
    return out


def best_cuts(tracks: Sequence[Chain], width: float, least: float) -> Iterator[Cut]:
    """Yield the best cut of every two tracks, with windows of `width` s to either side, if its odds exceed `least`."""
    for i in range(len(tracks)):
        for j in range(i + 1, len(tracks)):
            cut = _best_cut(tracks[i], tracks[j], width)
            if cut is not None and cut[1] > least:
                yield Cut(i, j, *cut)


class _Book:
    """Tracks that change, and which of them has each detection."""

    def __init__(self, tracks: Sequence[Chain], owners: Integers, run: WholeRun) -> None:
        self.tracks = list(tracks)
        self._owners = owners
        self._run = run
        # how often each track has changed, and the groups that were refused, with these numbers then
        self._versions = [0] * len(self.tracks)
        self._changed: set[int] = set()
        self._touched = np.zeros(len(run.times), dtype=np.bool_)
        self._refused: set[tuple[Any, ...]] = set()
        # (r,): how many states about each event may still be smoothed, for windows and for ends
        self._work = np.zeros(len(run.times), dtype=np.int64)
        for track in self.tracks:
            self._work[track.trajectory.events] += MOST_WORK
        self._ends = 2 * self._work
        # (r,): the events about which tracks still changed, or proposals were left undecided, when the work ended
        self.stopped = np.zeros(len(run.times), dtype=np.bool_)

    def proposed(self, width: float, where: Booleans) -> list[Change]:
        """Changes of the joint assignment of every event among those (r,) to look at, in order, where work is left."""
        run, where = self._run, where & (self._work > 0)
        out: list[Change] = []
        if not where.any():
            return []
        parts: list[tuple[Integers, Integers, Array, Array]] = []
        for number, track in enumerate(self.tracks):
            self._work[track.trajectory.events] -= 1
            states, covariances = track.without_window(width)
            parts.append((track.trajectory.events, np.full(len(states), number), states, covariances))
        events, numbers, states, covariances = (np.concatenate(part) for part in zip(*parts, strict=True))
        taken = np.concatenate([track.detections for track in self.tracks])
        order = np.argsort(events, kind="stable")
        order = order[(where & (np.diff(run.starts) > 0))[events[order]]]
        ends = np.flatnonzero(np.diff(events[order], append=-1)) + 1
        for first, last in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
            rows = order[first:last]
            event = int(events[rows[0]])
            places = assigned(run.gains(event, states[rows], covariances[rows]))
            after = np.where(places == NONE, NONE, places + run.starts[event])
            changes = np.stack([numbers[rows], taken[rows], after], axis=1)[after != taken[rows]]
            out += [Change(event, *change) for change in changes.tolist()]
        return out

    def decide_parts(self, changes: Sequence[Change], apart_s: float) -> None:
        """Decide groups of changes; those refused once more in two parts."""
        for group in _groups(changes, self._run, apart_s):
            events = sorted({change.event for change in group})
            if not self._decide(group) and len(events) > 1:
                # where most time passes, in the middle half: few divisions reach single events
                gaps = np.diff(self._run.times[events])
                first = len(gaps) // 4
                middle = events[first + int(np.argmax(gaps[first : len(gaps) - first]))]
                for early in (True, False):
                    self.decide_parts([c for c in group if (c.event <= middle) == early], apart_s)

    def settle(self) -> Booleans:
        """Smooth the tracks that changed, over all of their events; return the events (r,) about the changes."""
        for number in self._changed:
            self._work[self.tracks[number].trajectory.events] -= 1
            self.tracks[number] = self.tracks[number].smoothed()
        touched, self._touched = self._touched, np.zeros_like(self._touched)
        self._changed.clear()
        self.stopped |= touched & (self._work <= 0)
        return touched

    def swap_ends(self, width: float) -> int:
        """Swap the ends of tracks that continue each other better than themselves; return how many pairs did.

        A second cut is tried after the first, for objects that were swapped for some time only.
        """
        done: set[int] = set()
        for cut in sorted(best_cuts(self.tracks, width, LEAST_GAIN), key=lambda one: -one.odds):
            pair = (cut.first, cut.second)
            if not done.isdisjoint(pair) or not self._is_left(self._ends, cut.event, cut.event):
                continue
            before = [self.tracks[k] for k in pair]
            tried = [self._cut_at(before, pair, cut.event, width)]
            tried += [self._cut_at(tried[0], pair, again.event, width) for again in best_cuts(tried[0], width, 0.0)]
            totals = [sum(track.log_likelihood for track in tracks) for tracks in (before, *tried)]
            best = int(np.argmax(totals))
            if totals[best] > totals[0] + LEAST_GAIN:
                for number, track in zip(pair, tried[best - 1], strict=True):
                    self._replace(number, track, (cut.event, cut.event))
                done |= {*pair}
        return len(done) // 2

    def _cut_at(self, pair: Sequence[Chain], numbers: tuple[int, int], event: int, width: float) -> list[Chain]:
        """Return two tracks with their ends after an event swapped, and the detections about it chosen anew."""
        run = self._run
        (a, at_a), (b, at_b) = ((one, int(np.searchsorted(one.trajectory.events, event, side="right"))) for one in pair)
        owners = np.where(np.isin(self._owners, [*numbers, NONE]), NONE, ANOTHER)
        tracks = [_joined(a, at_a, b, at_b).smoothed(), _joined(b, at_b, a, at_a).smoothed()]
        book = _Book(tracks, _owners(tracks, run, owners), run)
        book._work = self._ends
        near = np.abs(run.times - run.times[event]) <= AROUND * width
        for again in (width, 0.0, width):
            book.decide_parts(book.proposed(again, near), AROUND * width)
            book.settle()
        return book.tracks

    def _decide(self, group: Sequence[Change]) -> bool:
        """Take a group of changes if it explains the detections better; return whether it was taken."""
        numbers = sorted({change.track for change in group})
        key = (*group, *(self._versions[number] for number in numbers))
        events = [change.event for change in group]
        if len(group) > MOST_CHANGES or key in self._refused or not self._are_free(group):
            return False
        if not self._is_left(self._work, min(events), max(events)):
            return False
        gain, tried = 0.0, []
        for number in numbers:
            track = self.tracks[number]
            own = [change for change in group if change.track == number]
            detections = track.detections.copy()
            places = np.searchsorted(track.trajectory.events, [change.event for change in own])
            detections[places] = [change.after for change in own]
            first, last = track.around(min(events), max(events), REACH)
            self._work[track.trajectory.events[first:last]] -= 1
            part = replace(track, detections=detections).part(first, last).smoothed()
            gain += part.log_likelihood - track.part(first, last).log_likelihood
            # at the ends of the part little is known
            inner, until = track.around(min(events), max(events), REACH // 2)
            known = part.part(inner - first, until - first)
            tried.append((number, replace(track, detections=detections).with_part(known, inner)))
        if not gain > LEAST_GAIN:
            self._refused.add(key)
            return False
        for number, track in tried:
            self._replace(number, track, (min(events), max(events)))
        return True

    def _are_free(self, group: Sequence[Change]) -> bool:
        """Whether no detection that a group takes is one of a track that keeps it."""
        given = {change.before for change in group}
        wanted = [change.after for change in group if change.after != NONE]
        return all(self._owners[one] == NONE or one in given for one in wanted)

    def _is_left(self, work: Integers, first: int, last: int) -> bool:
        """Whether any of the work (r,) is left about the events from first to last; if not, this is where it ended."""
        is_left = bool(work[max(first - REACH, 0) : last + REACH + 1].sum() > 0)
        self.stopped[first : last + 1] |= not is_left
        return is_left

    def _replace(self, number: int, track: Chain, events: tuple[int, int]) -> None:
        """Enter a track that changed from an event to another."""
        for detections, owner in ((self.tracks[number].detections, NONE), (track.detections, number)):
            known = detections[detections != NONE]
            # another track of the group may have taken what this one gave
            mine = (self._owners[known] == number) | (owner == number)
            self._owners[known[mine]] = owner
        self.tracks[number] = track
        self._versions[number] += 1
        self._changed.add(number)
        self._touched[max(events[0] - REACH, 0) : events[1] + REACH] = True


def _owners(tracks: Sequence[Chain], run: WholeRun, owners: Integers | None = None) -> Integers:
    """Return the track (d,) that has each detection of a run, in addition to those that are known."""
    out = np.full(len(run.rows), NONE) if owners is None else owners.copy()
    for number, track in enumerate(tracks):
        out[track.detections[track.detections != NONE]] = number
    return out


def _groups(changes: Sequence[Change], run: WholeRun, apart_s: float) -> list[list[Change]]:
    """Changes, in order of events, that share tracks or detections, no further apart in time than this."""
    if not changes:
        return []
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    last: dict[int, int] = {}
    having: dict[int, int] = {}
    edges: list[tuple[int, int]] = []
    for k, change in enumerate(changes):
        before = last.get(change.track)
        if before is not None and run.times[change.event] - run.times[changes[before].event] <= apart_s:
            edges.append((before, k))
        last[change.track] = k
        for detection in {change.before, change.after} - {NONE}:
            if detection in having:
                edges.append((having[detection], k))
            having[detection] = k
    ends = np.array(edges, dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(changes), len(changes)))
    count, members = connected_components(graph, directed=False)
    groups: list[list[Change]] = [[] for _ in range(count)]
    for change, member in zip(changes, members.tolist(), strict=True):
        groups[member].append(change)
    return groups


def _joined(before: Chain, place: int, after: Chain, since: int) -> Chain:
    """Return the one track up to a place, and then the other."""
    trajectory = before.trajectory.take(slice(place)).join(after.trajectory.take(slice(since, None)))
    detections = np.concatenate([before.detections[:place], after.detections[since:]])
    return replace(before, trajectory=trajectory, detections=detections)


def _best_cut(one: Chain, other: Chain, width: float) -> tuple[int, float] | None:
    """Event and log-odds of the best cut of two tracks; None where they have too little in common or never meet."""
    common, a, b = np.intersect1d(
        one.trajectory.events, other.trajectory.events, assume_unique=True, return_indices=True
    )
    if len(common) < 2 * LEAST_EVENTS:
        return None
    times = one.trajectory.times[a]
    left = np.searchsorted(times, times - width, side="right") - 1
    right = np.searchsorted(times, times + width, side="right")
    cut = np.flatnonzero((left >= LEAST_EVENTS) & (right < len(common) - LEAST_EVENTS))
    near = cut[_is_near(one, a[cut], other, b[cut], width)]
    if not len(near):
        return None
    left, right = left[near], right[near]
    dt = times[right] - times[left]
    before, after = [], []
    for chain, places in ((one, a), (other, b)):
        (ahead, spreads, _), (behind, widths) = chain.ahead, chain.behind
        before.append(chain.run.motion.transition(dt).predict(ahead[places[left]], spreads[places[left]]))
        after.append((behind[places[right]], widths[places[right]]))
    odds = np.zeros(len(near))
    for sign, k, m in ((1.0, 0, 1), (1.0, 1, 0), (-1.0, 0, 0), (-1.0, 1, 1)):
        error, spread = after[m][0] - before[k][0], after[m][1] + before[k][1]
        distance = np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[:, :, None])[:, :, 0])
        odds += sign * (-0.5 * distance - 0.5 * np.linalg.slogdet(spread)[1])
    best = int(np.argmax(odds))
    return int(common[near[best]]), float(odds[best])


def _is_near(one: Chain, a: Integers, other: Chain, b: Integers, width: float) -> Booleans:
    """Whether two tracks at places of each are so near that a prediction over a window may confuse them."""
    reach = np.zeros(len(a))
    for chain, places in ((one, a), (other, b)):
        step, track = chain.run.motion.transition(width), chain.trajectory
        _, spreads = step.predict(track.states[places], track.covariances[places])
        reach += np.sqrt(np.trace(spreads[:, :3, :3], axis1=1, axis2=2))
    apart = np.linalg.norm(one.trajectory.states[a, :3] - other.trajectory.states[b, :3], axis=1)
    return np.asarray(apart <= NEAR * reach)
