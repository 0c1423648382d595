"""Smoothed tracks of a whole run, in place of the filtered ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.trajectories.reaching_back import Extended, reach_back
from stereophd.core.trajectories.smoothing import Trajectory, extend_back, smooth
from stereophd.core.trajectories.stitching import stitch
from stereophd.pipeline.tracking.associations import LEAST_PROBABILITY, Associated, reduced_to_what_is_left
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.reassociated import Given, choose_again, without_claims_of_others

# A track that ends coasting, existence falling, was not seen again: smoothed, it ends where it was still
# more probable than not.
SEEN_EXISTENCE = 0.5


def smoothed_records(
    records: Iterable[Record],
    cameras: Sequence[Camera],
    motion: Motion,
    max_gap_s: float,
    reassociate: bool = False,
    max_position_std: float | None = None,
) -> Iterator[Record]:
    """Yield the records of a whole run with smoothed estimates in place of the filtered ones.

    Every track reaches back to its first detection (beyond the filter's, if records carry their events), ends
    where it was last more probable than not, and is stitched to the track that it continues, if any. Predictions
    to the times of a grid are smoothed as events are that measure nothing: the state between two events given
    both, by the motion model. With `reassociate` the smoothed tracks choose their detections anew. Associations are
    those of tracks that are reported at least once, with `max_position_std` as certain as this.
    """
    whole = list(records)
    times = np.array([record.time_s for record in whole])
    labels = np.array([record.first_label for record in whole], dtype=np.int64)
    trajectories = [_smooth_back(t, label, times, labels, motion) for t, label in _trajectories(whole, times)]
    extended = _reach_back(trajectories, [record.event for record in whole], times, cameras, motion, max_gap_s)
    given: Given = {}
    if reassociate:
        whole, extended, given = choose_again(whole, extended, cameras, motion)
    trajectories = [one.trajectory for one in extended]
    continued = stitch(trajectories, motion, max_gap_s)

    def name(track_id: int) -> int:
        while track_id in continued:
            track_id = continued[track_id]
        return track_id

    rows: list[list[tuple[int, Trajectory, int]]] = [[] for _ in whole]
    for trajectory in trajectories:
        for k, number in enumerate(trajectory.events.tolist()):
            rows[number].append((name(trajectory.track_id), trajectory, k))
    detections: list[dict[int, Counter[str]]] = [{} for _ in whole]
    for number, record in enumerate(whole):
        for track_id, counts in record.attributed.items():
            detections[number].setdefault(name(track_id), Counter()).update(counts)
    for one in extended:
        for number in one.detected:
            track_id = name(one.trajectory.track_id)
            detections[number].setdefault(track_id, Counter())[whole[number].camera] += 1
    reported = np.array([record.reported for record in whole])
    written = {name(one.track_id) for one in trajectories if _is_written(one, reported, max_position_std)}
    whole = without_claims_of_others(whole, {key: owner for key, owner in given.items() if name(owner) in written})
    associations = _continued_associations(whole, extended, name, written)
    for record, found, attributed, sightings in zip(whole, rows, detections, associations, strict=True):
        found.sort(key=lambda row: row[0])
        yield replace(record, estimates=_estimates(found), attributed=attributed, associations=sightings)


def _is_written(trajectory: Trajectory, reported: NDArray[np.bool_], max_position_std: float | None) -> bool:
    """Whether any estimate of a track is reported, with `max_position_std` one as certain as this."""
    shown = reported[trajectory.events]
    if max_position_std is not None:
        shown = shown & (np.trace(trajectory.covariances[:, :3, :3], axis1=1, axis2=2) <= max_position_std**2)
    return bool(shown.any())


def _continued_associations(
    whole: Sequence[Record], extended: Sequence[Extended], name: Callable[[int], int], written: Set[int]
) -> list[tuple[Associated, ...]]:
    """Associations of every record, under the names of the stitched tracks (those `written`), each with its own event.

    With them the detections to which smoothed tracks reach back, with what the filter's claims to these leave.
    """
    numbers = {(one.time_s, one.camera, one.frame): number for number, one in enumerate(whole) if one.is_event}
    claimed: list[list[Associated]] = [[] for _ in whole]
    reached: list[list[Associated]] = [[] for _ in whole]
    for record in whole:
        for one in record.associations:
            names = np.array([name(track_id) for track_id in one.track_ids.tolist()])
            kept = np.array([track_id in written for track_id in names.tolist()], dtype=np.bool_)
            if kept.any():
                found = replace(one, track_ids=names)
                claimed[numbers[one.time_s, one.camera, one.frame]].append(found if kept.all() else found.take(kept))
    for track in extended:
        track_id = name(track.trajectory.track_id)
        if track_id not in written:
            continue
        for number, shares in zip(track.detected, track.shares, strict=True):
            event, record = whole[number].event, whole[number]
            if event is None or event.pixels is None:
                continue
            rows = np.flatnonzero(shares >= LEAST_PROBABILITY)
            ids = np.full(len(rows), track_id)
            reached[number].append(
                Associated(record.time_s, record.camera, record.frame, event.pixels[rows], ids, shares[rows])
            )
    return [(*sure, *reduced_to_what_is_left(sure, further)) for sure, further in zip(claimed, reached, strict=True)]


def _reach_back(
    trajectories: Sequence[Trajectory],
    events: Sequence[Event | None],
    times: NDArray[np.float64],
    cameras: Sequence[Camera],
    motion: Motion,
    max_gap_s: float,
) -> list[Extended]:
    """Continue all tracks back to the first detections that their objects probably made."""
    begins = np.array([t.times[0] for t in trajectories])
    ends = np.array([t.times[-1] for t in trajectories])
    out = []
    for k, trajectory in enumerate(trajectories):
        about = np.flatnonzero((begins < begins[k]) & (ends >= begins[k] - max_gap_s))
        others = [trajectories[other] for other in about.tolist()]
        out.append(reach_back(trajectory, others, events, times, cameras, motion, max_gap_s))
    return out


def _trajectories(records: Sequence[Record], times: NDArray[np.float64]) -> list[tuple[Trajectory, int]]:
    """Filtered states of every track, in order of identity, with the label of its first report."""
    events: dict[int, list[tuple[int, int]]] = {}
    for number, record in enumerate(records):
        for row, track_id in enumerate(record.estimates.track_ids.tolist()):
            events.setdefault(track_id, []).append((number, row))
    out = []
    for track_id, places in sorted(events.items()):
        found = [records[number].estimates for number, _ in places]
        rows = [row for _, row in places]
        existence = np.array([e.existence[row] for e, row in zip(found, rows, strict=True)])
        seen = np.flatnonzero(existence >= min(SEEN_EXISTENCE, existence.max()))
        last = int(seen[-1]) + 1
        numbers = np.array([number for number, _ in places[:last]])
        trajectory = Trajectory(
            track_id,
            numbers,
            times[numbers],
            np.array([e.states[row] for e, row in zip(found, rows, strict=True)][:last]),
            np.array([e.covariances[row] for e, row in zip(found, rows, strict=True)][:last]),
            existence[:last],
        )
        out.append((trajectory, int(found[0].labels[rows[0]])))
    return out


def _smooth_back(
    trajectory: Trajectory,
    label: int,
    times: NDArray[np.float64],
    first_labels: NDArray[np.int64],
    motion: Motion,
) -> Trajectory:
    """Smooth a track and continue it back to the event of its first detection."""
    born = int(np.searchsorted(first_labels, label, side="right")) - 1
    earlier = np.arange(max(born, 0), int(trajectory.events[0]))
    return extend_back(smooth(trajectory, motion), earlier, times[earlier], motion)


def _estimates(rows: list[tuple[int, Trajectory, int]]) -> Estimates:
    return Estimates(
        np.array([name for name, _, _ in rows], dtype=np.int64),
        np.array([t.states[k] for _, t, k in rows]).reshape(-1, 6),
        np.array([t.covariances[k] for _, t, k in rows]).reshape(-1, 6, 6),
        np.array([t.existence[k] for _, t, k in rows]),
        np.full(len(rows), -1),
    )
