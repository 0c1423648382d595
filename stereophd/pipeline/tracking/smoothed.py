"""Smoothed tracks of a whole run, in place of the filtered ones.

With `reassociate` smoothed tracks choose their detections anew (`stereophd.core.trajectories.swaps`). What they choose
is a decision: the likelihood of the whole log made it, and no probability is left to state. Its association has
probability 1, and all other claims of a track at an event at which its detection changed are dropped. So are the claims
of others to that detection, if the track is written. All other claims stay those of the filter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from stereophd.config.report import SmoothConfig
from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.numerics.rows import ArrayRows
from stereophd.core.trajectories.chain import NONE, Chain, WholeRun, make_chain, make_run
from stereophd.core.trajectories.joins import stitch
from stereophd.core.trajectories.reaching_back import Extended, reach_back
from stereophd.core.trajectories.smoothing import Trajectory, extend_back, smooth
from stereophd.core.trajectories.swaps import choose_anew
from stereophd.pipeline.tracking.associations import LEAST_PROBABILITY, Associated
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.residuals import PROBABLE
from stereophd.pipeline.tracking.unfinished import bare
from stereophd.wording import LOGGER, percent

# A track that ends coasting, existence falling, was not seen again: smoothed, it ends where it was still
# more probable than not.
SEEN_EXISTENCE = 0.5


def smoothed_records(
    records: Iterable[Record],
    cameras: Sequence[Camera],
    motion: Motion,
    settings: SmoothConfig,
    back: bool = False,
    max_position_std: float | None = None,
) -> Iterator[Record]:
    """Yield the records of a whole run, with their events, with smoothed estimates in place of the filtered ones.

    Every track reaches back to its first detection (beyond the filter's, with `back`), ends where it was last more
    probable than not, and is stitched to the track that it continues, if any. Predictions to the times of a grid are
    smoothed as events are that measure nothing: the state between two events given both, by the motion model.
    Associations are those of tracks that are reported at least once, with `max_position_std` as certain as this. Bodies
    have the size throughout that they had last.
    """
    whole = list(records)
    extents = _last_extents(whole)
    run = make_run([record.event for record in whole], np.array([record.time_s for record in whole]), cameras, motion)
    claims = claims_of_run(whole, run)
    labels = np.array([record.first_label for record in whole], dtype=np.int64)
    trajectories = _smoothed(_trajectories(whole, run.times), run, labels)
    extended = [Extended(one) for one in trajectories]
    if back:
        extended = _reach_back(trajectories, run, settings.max_gap_s)
    counts: list[dict[int, Counter[str]]] = [
        {track_id: Counter(seen) for track_id, seen in record.attributed.items()} for record in whole
    ]
    reached = [
        RunClaims(one.detections, np.full(len(one.detections), one.trajectory.track_id), one.probabilities)
        for one in extended
    ]
    further = claims.take(np.zeros(len(claims.detections), dtype=np.bool_)).join(*reached)
    given = claims.take(np.zeros(len(claims.detections), dtype=np.bool_))
    trajectories = [one.trajectory for one in extended]
    if settings.reassociate and motion.moves:
        before = [
            make_chain(one.trajectory, claims.join(more).detections_of(one.trajectory, run), run)
            for one, more in zip(extended, reached, strict=True)
        ]
        after, stopped = choose_anew(before, run)
        _warn_of_bound(run.times[stopped], len(run.times))
        # a track that gave all of its detections away is none
        trajectories = [
            new.trajectory for old, new in zip(before, after, strict=True) if new.n_detections or not old.n_detections
        ]
        gone, given = _changes(before, after)
        claims, further = (one.without(gone.track_ids, run.event_of(gone.detections), run) for one in (claims, further))
        claims = claims.join(given)
        counts = _counts(after, whole, run)
    else:
        for one in extended:
            for event in np.unique(run.event_of(one.detections)).tolist():
                counts[event].setdefault(one.trajectory.track_id, Counter())[whole[event].camera] += 1
    name = _names(stitch(trajectories, motion, settings.max_gap_s))
    reported = np.array([record.reported for record in whole])
    written = {name(one.track_id) for one in trajectories if _is_written(one, reported, max_position_std)}
    claims, further = (_of_written(one, given, name, written) for one in (claims, further))
    associations = claims.join(further.reduced(claims)).by_record(whole, run)
    rows: list[list[tuple[int, Trajectory, int]]] = [[] for _ in whole]
    for trajectory in trajectories:
        for k, number in enumerate(trajectory.events.tolist()):
            rows[number].append((name(trajectory.track_id), trajectory, k))
    for record, own, seen, sightings in zip(whole, rows, counts, associations, strict=True):
        attributed: dict[int, Counter[str]] = {}
        for track_id, count in seen.items():
            attributed.setdefault(name(track_id), Counter()).update(count)
        own.sort(key=lambda row: row[0])
        yield replace(
            record, estimates=_estimates(own, extents), attributed=attributed, associations=sightings,
            filtered=Record(**bare(record)).renamed(name),
        )  # fmt: skip


def _names(continued: dict[int, int]) -> Callable[[int], int]:
    """Return a function that names a track: the name of the first track that it continues."""

    def name(track_id: int) -> int:
        while track_id in continued:
            track_id = continued[track_id]
        return track_id

    return name


def _is_written(trajectory: Trajectory, reported: Array, max_position_std: float | None) -> bool:
    """Whether any estimate of a track is reported, with `max_position_std` one as certain as this."""
    shown = reported[trajectory.events]
    if max_position_std is not None:
        shown = shown & (np.trace(trajectory.covariances[:, :3, :3], axis1=1, axis2=2) <= max_position_std**2)
    return bool(shown.any())


def _changes(before: Sequence[Chain], after: Sequence[Chain]) -> tuple[RunClaims, RunClaims]:
    """Return the detections that tracks had before or have after and not both, and of these those that they have."""
    changed: list[tuple[Integers, int]] = []
    taken: list[tuple[Integers, int]] = []
    for old, new in zip(before, after, strict=True):
        had, has = (one.detections[one.detections != NONE] for one in (old, new))
        changed.append((np.setxor1d(had, has), old.trajectory.track_id))
        taken.append((np.setdiff1d(has, had), old.trajectory.track_id))
    return _decided(changed), _decided(taken)


def _decided(parts: Sequence[tuple[Integers, int]]) -> RunClaims:
    """Return claims of probability 1, of detections and the track that they belong to."""
    nothing = np.empty(0, dtype=np.int64)
    detections = np.concatenate([nothing, *(own for own, _ in parts)])
    ids = np.concatenate([nothing, *(np.full(len(own), track_id) for own, track_id in parts)])
    return RunClaims(detections, ids, np.ones(len(ids)))


def _counts(tracks: Sequence[Chain], whole: Sequence[Record], run: WholeRun) -> list[dict[int, Counter[str]]]:
    """Return the detections that tracks have, counted for each record."""
    counts: list[dict[int, Counter[str]]] = [{} for _ in whole]
    for track in tracks:
        for event in track.trajectory.events[track.detections != NONE].tolist():
            counts[event][track.trajectory.track_id] = Counter({whole[event].camera: 1})
    return counts


def _of_written(claims: RunClaims, given: RunClaims, name: Callable[[int], int], written: Set[int]) -> RunClaims:
    """Return the claims of the tracks that are written, under the names of the stitched tracks.

    Without what others claim of a detection that one of these was given.
    """
    ids = np.array(sorted(written), dtype=np.int64)
    owners = given.take(np.isin(given.renamed(name).track_ids, ids))
    order = np.argsort(owners.detections)
    owned, owner = owners.detections[order], owners.track_ids[order]
    places = np.minimum(np.searchsorted(owned, claims.detections), max(len(owned) - 1, 0))
    if len(owned):
        others = (owned[places] == claims.detections) & (owner[places] != claims.track_ids)
        claims = claims.take(~others)
    claims = claims.renamed(name)
    return claims.take(np.isin(claims.track_ids, ids))


def _warn_of_bound(times: Array, n_events: int) -> None:
    """Say where `reassociate` reached the bound of its work, at these times (k,), s."""
    if len(times):
        LOGGER.warning(
            "report.smooth: reassociate stopped at the bound of its work about %s of the events (from %.1f to %.1f s): "
            "tracks may still hold each other's detections there. Do the detector settings describe these detections "
            "(`stereophd check`)? Boxes of people are better tracked as such (object.shape: ellipsoid).",
            percent(len(times) / n_events), times.min(), times.max(),
        )  # fmt: skip


def _reach_back(trajectories: Sequence[Trajectory], run: WholeRun, max_gap_s: float) -> list[Extended]:
    """Continue all tracks back to the first detections that their objects probably made."""
    begins = np.array([t.times[0] for t in trajectories])
    ends = np.array([t.times[-1] for t in trajectories])
    out = []
    for k, trajectory in enumerate(trajectories):
        about = np.flatnonzero((begins < begins[k]) & (ends >= begins[k] - max_gap_s))
        out.append(reach_back(trajectory, [trajectories[other] for other in about.tolist()], run, max_gap_s))
    return out


def trajectories_of(records: Sequence[Record], events: Iterable[int], times: Array) -> list[Trajectory]:
    """Return the states of every track of records, whose events have these numbers, in order of identity."""
    places: dict[int, list[tuple[int, Estimates, int]]] = {}
    for event, record in zip(events, records, strict=True):
        for row, track_id in enumerate(record.estimates.track_ids.tolist()):
            places.setdefault(track_id, []).append((event, record.estimates, row))
    out = []
    for track_id, found in sorted(places.items()):
        numbers = np.array([event for event, _, _ in found], dtype=np.int64)
        states, covariances, existence = (
            np.array([getattr(estimates, name)[row] for _, estimates, row in found])
            for name in ("states", "covariances", "existence")
        )
        out.append(Trajectory(track_id, numbers, times[numbers], states, covariances, existence))
    return out


def _trajectories(records: Sequence[Record], times: Array) -> list[tuple[Trajectory, int]]:
    """Filtered states of every track until it was last seen, with the label of its first report."""
    labels: dict[int, int] = {}
    for estimates in (record.estimates for record in reversed(records)):
        labels |= zip(estimates.track_ids.tolist(), estimates.labels.tolist(), strict=True)
    out = []
    for one in trajectories_of(records, range(len(records)), times):
        seen = np.flatnonzero(one.existence >= min(SEEN_EXISTENCE, one.existence.max()))
        out.append((one.take(slice(seen[-1] + 1)), labels[one.track_id]))
    return out


def _smoothed(filtered: Sequence[tuple[Trajectory, int]], run: WholeRun, first_labels: Integers) -> list[Trajectory]:
    """Smooth tracks, and continue each back to the event of its first detection."""
    out = []
    for track, label in filtered:
        born = int(np.searchsorted(first_labels, label, side="right")) - 1
        earlier = np.arange(max(born, 0), int(track.events[0]))
        out.append(extend_back(smooth(track, run.motion), earlier, run.times[earlier], run.motion))
    return out


def _last_extents(records: Sequence[Record]) -> dict[int, Array]:
    """Return the last height and width (4,) of each body, and how certain they are; none of points."""
    out: dict[int, Array] = {}
    for found in (record.estimates for record in records):
        if found.extents is not None:
            out.update(zip(found.track_ids.tolist(), found.extents, strict=True))
    return out


def _estimates(rows: list[tuple[int, Trajectory, int]], extents: dict[int, Array]) -> Estimates:
    return Estimates(
        np.array([name for name, _, _ in rows], dtype=np.int64),
        np.array([t.states[k] for _, t, k in rows]).reshape(-1, 6),
        np.array([t.covariances[k] for _, t, k in rows]).reshape(-1, 6, 6),
        np.array([t.existence[k] for _, t, k in rows]),
        np.full(len(rows), -1),
        extents=np.array([extents[t.track_id] for _, t, _ in rows]).reshape(-1, 4) if extents else None,
    )


@dataclass(frozen=True)
class RunClaims(ArrayRows):
    """Detections of a run that tracks claim; one row a detection and track."""

    detections: Integers  # (k,), their numbers in the run
    track_ids: Integers  # (k,)
    probabilities: Array  # (k,)

    def renamed(self, name: Callable[[int], int]) -> RunClaims:
        """Return the rows with other names of their tracks."""
        ids, places = np.unique(self.track_ids, return_inverse=True)
        names = np.array([name(one) for one in ids.tolist()], dtype=np.int64)
        return replace(self, track_ids=names[places])

    def without(self, track_ids: Integers, events: Integers, run: WholeRun) -> RunClaims:
        """Return the rows without those of tracks (n,) at events (n,)."""
        pairs = set(zip(track_ids.tolist(), events.tolist(), strict=True))
        own = zip(self.track_ids.tolist(), run.event_of(self.detections).tolist(), strict=True)
        return self.take(np.array([pair not in pairs for pair in own], dtype=np.bool_))

    def reduced(self, sure: RunClaims) -> RunClaims:
        """Return the rows reduced so that all rows of a detection, with others that are sure, add up to at most 1.

        They share what the others leave; the negligible ones are left out.
        """
        count = 1 + int(max(sure.detections.max(initial=NONE), self.detections.max(initial=NONE)))
        taken, wanted = (np.bincount(one.detections, one.probabilities, count) for one in (sure, self))
        room = np.maximum(1.0 - taken, 0.0) / np.maximum(wanted, LEAST_PROBABILITY)
        reduced = replace(self, probabilities=self.probabilities * np.minimum(room[self.detections], 1.0))
        return reduced.take(reduced.probabilities >= LEAST_PROBABILITY)

    def detections_of(self, track: Trajectory, run: WholeRun) -> Integers:
        """Return the detection (k,) that a track has at each of its events, or `NONE`."""
        out = np.full(len(track.events), NONE)
        own = self.detections[(self.track_ids == track.track_id) & (self.probabilities > PROBABLE)]
        events = run.event_of(own)
        places = np.minimum(np.searchsorted(track.events, events), len(track.events) - 1)
        there = track.events[places] == events
        out[places[there]] = own[there]
        return out

    def by_record(self, whole: Sequence[Record], run: WholeRun) -> list[tuple[Associated, ...]]:
        """Return the rows of each record, in order of detection, then of track; those of one pair are added up."""
        order = np.lexsort((self.track_ids, self.detections))
        detections, ids = self.detections[order], self.track_ids[order]
        firsts = np.flatnonzero((np.diff(detections, prepend=NONE) != 0) | (np.diff(ids, prepend=NONE) != 0))
        sums = np.add.reduceat(self.probabilities[order], firsts) if len(firsts) else np.empty(0)
        detections, ids = detections[firsts], ids[firsts]
        bounds = np.searchsorted(detections, run.starts).tolist()
        out: list[tuple[Associated, ...]] = []
        for number, record in enumerate(whole):
            rows, event = slice(bounds[number], bounds[number + 1]), record.event
            if rows.start == rows.stop or event is None or event.pixels is None:
                out.append(())
                continue
            own = detections[rows]
            pixels = event.pixels[own - run.starts[number]]
            out.append(
                (Associated(record.time_s, record.camera, record.frame, pixels, run.rows[own], ids[rows], sums[rows]),)
            )
        return out


def claims_of_run(whole: Sequence[Record], run: WholeRun) -> RunClaims:
    """Return what the records of a run claim."""
    parts = [one for record in whole for one in record.associations]
    rows = np.concatenate([np.empty(0, dtype=np.int64), *(one.rows for one in parts)])
    order = np.argsort(run.rows, kind="stable")
    return RunClaims(
        order[np.searchsorted(run.rows[order], rows)],
        np.concatenate([np.empty(0, dtype=np.int64), *(one.track_ids for one in parts)]),
        np.concatenate([np.empty(0), *(one.probabilities for one in parts)]),
    )
