"""Smoothed tracks of a run that choose their detections anew (`stereophd.core.trajectories.reassociation`).

What they choose is a decision: the likelihood of the whole log made it, and no probability is left to state. Its
association has probability 1, and all other claims of a track at an event at which its detection changed are dropped.
So are the claims of others to that detection (`without_claims_of_others`), if the track is written. All other claims
stay those of the filter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.trajectories.reaching_back import Extended
from stereophd.core.trajectories.reassociation import Reassociated, reassociate
from stereophd.pipeline.tracking.associations import Associated
from stereophd.pipeline.tracking.loop import Record

# Detections, each an event and its pixel, and the track that each was given to.
Given = dict[tuple[int, tuple[float, ...]], int]

# A track has the detection that it claims with more than this probability.
PROBABLE = 0.5


def choose_again(
    whole: Sequence[Record], extended: Sequence[Extended], cameras: Sequence[Camera], motion: Motion
) -> tuple[list[Record], list[Extended], Given]:
    """Let smoothed tracks choose their detections anew.

    Parameters
    ----------
    whole : sequence of Record
        Of a run that keeps its events and claims.
    extended : sequence of Extended
        Its tracks, smoothed.
    cameras : sequence of Camera
    motion : Motion

    Returns
    -------
    records : list of Record
    tracks : list of Extended
        Both with what changed.
    given : dict
        Detections that a track has now and had not before.
    """
    if not motion.moves:
        return list(whole), list(extended), {}
    numbers = _numbers(whole)
    own = _detections(whole, extended, numbers)
    events = [record.event for record in whole]
    found = reassociate([one.trajectory for one in extended], own, events, cameras, motion)
    gone = {(track.trajectory.track_id, event) for track in found for event in track.changed}
    records, tracks = list(whole), []
    for number, record in enumerate(records):
        left = _without(record.associations, gone, numbers)
        records[number] = replace(record, associations=left, attributed={})
    for before, detections, track in zip(extended, own, found, strict=True):
        kept = [k for k, event in enumerate(before.detected) if event not in track.changed]
        detected, shares = tuple(before.detected[k] for k in kept), tuple(before.shares[k] for k in kept)
        tracks.append(Extended(track.trajectory, detected, shares))
        # those that the track reached back to are counted with it
        _enter(records, track, {event for event in detections if event not in track.changed} - set(detected))
    return records, tracks, _given(found, events)


def without_claims_of_others(
    whole: Sequence[Record], given: Mapping[tuple[int, tuple[float, ...]], int]
) -> list[Record]:
    """Return records without what others claim of detections that a track was given.

    Parameters
    ----------
    whole : sequence of Record
    given : mapping
        From `choose_again`, without those of tracks that are not written: what these were given has the rows of others.
    """
    if not given:
        return list(whole)
    numbers = _numbers(whole)
    out = []
    for record in whole:
        left = []
        for one in record.associations:
            number = numbers[one.time_s, one.camera, one.frame]
            pairs = zip(one.track_ids.tolist(), one.pixels.tolist(), strict=True)
            owners = ((track_id, given.get((number, tuple(pixel)), track_id)) for track_id, pixel in pairs)
            left.append(_kept(one, [track_id == owner for track_id, owner in owners]))
        out.append(replace(record, associations=tuple(one for one in left if len(one.track_ids))))
    return out


def _numbers(whole: Sequence[Record]) -> dict[tuple[float, str, int], int]:
    """Return the number of the record of each event."""
    return {(one.time_s, one.camera, one.frame): number for number, one in enumerate(whole) if one.is_event}


def _detections(
    whole: Sequence[Record], extended: Sequence[Extended], numbers: dict[tuple[float, str, int], int]
) -> list[dict[int, int]]:
    """Detections that each track has: event -> row of its points."""
    places = {one.trajectory.track_id: k for k, one in enumerate(extended)}
    spans = [set(one.trajectory.events.tolist()) for one in extended]
    rows_of = [
        {} if event is None or event.pixels is None else {tuple(p): k for k, p in enumerate(event.pixels.tolist())}
        for event in (record.event for record in whole)
    ]
    out: list[dict[int, int]] = [{} for _ in extended]
    for record in whole:
        for one in record.associations:
            number = numbers[one.time_s, one.camera, one.frame]
            for pixel, track_id, probability in zip(
                one.pixels.tolist(), one.track_ids.tolist(), one.probabilities.tolist(), strict=True
            ):
                place = places.get(track_id)
                row = rows_of[number].get(tuple(pixel))
                if place is not None and row is not None and probability > PROBABLE and number in spans[place]:
                    out[place][number] = row
    for track, own in zip(extended, out, strict=True):
        for number, shares in zip(track.detected, track.shares, strict=True):
            if shares.max() > PROBABLE:
                own[number] = int(shares.argmax())
    return out


def _given(found: Sequence[Reassociated], events: Sequence[Event | None]) -> Given:
    """Detections that a track has now and had not before."""
    given = {}
    for track in found:
        for number, (_, after) in track.changed.items():
            event = events[number]
            if after is not None and event is not None and event.pixels is not None:
                given[number, tuple(event.pixels[after].tolist())] = track.trajectory.track_id
    return given


def _without(
    associations: tuple[Associated, ...],
    gone: set[tuple[int, int]],
    numbers: dict[tuple[float, str, int], int],
) -> tuple[Associated, ...]:
    """Associations without those of tracks at events (pairs) that changed."""
    out = []
    for one in associations:
        number = numbers[one.time_s, one.camera, one.frame]
        out.append(_kept(one, [(track_id, number) not in gone for track_id in one.track_ids.tolist()]))
    return tuple(one for one in out if len(one.track_ids))


def _kept(one: Associated, flags: list[bool]) -> Associated:
    """Return the rows that are kept."""
    return one if all(flags) else one.take(np.array(flags, dtype=np.bool_))


def _enter(records: list[Record], track: Reassociated, kept: set[int]) -> None:
    """Enter the detections that a track has now, and count them and those kept (events)."""
    track_id = track.trajectory.track_id
    entered = {event: after for event, (_, after) in track.changed.items() if after is not None}
    for number, row in entered.items():
        record, event = records[number], records[number].event
        if event is None or event.pixels is None:
            continue
        chosen = Associated(
            record.time_s, record.camera, record.frame, event.pixels[[row]], np.array([track_id]), np.ones(1)
        )
        records[number] = replace(record, associations=(*record.associations, chosen))
    for number in sorted(kept | set(entered)):
        record = records[number]
        attributed = {**record.attributed, track_id: Counter({record.camera: 1})}
        records[number] = replace(record, attributed=attributed)
