"""Whether a camera has been knocked: a sequential test of its detections against what the tracks predict for it.

At a look, the confirmed tracks are predicted into the image. For each track and each of a set of *turns* of the camera
(to any side by 0.15 to 12 degrees, about its axis, or nearer), the likelihood of the frame is compared with that
without a turn. A detection is any one of the track's neighbours, or false, or missed: nothing is gated, so a turn of a
hundred standard deviations is as visible as one of three. The log-likelihood ratios of a track add up to a CUSUM, which
never falls below 0. Without a knock it exceeds c with a probability of at most exp(-c) (Wald), and the sum over T
tracks has the tail of a gamma distribution of shape T. A camera is knocked when the sum is beyond the quantile that is
exceeded once in `FALSE_ALARM_S` by chance, over all looks, turns and cameras. A single track adds no more than its
share, so a wrong track alone is no knock.

A small steady misfit of lens, pose or motion is no knock either: the spread of the residuals, which follows their
median within a minute, widens all likelihoods.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.two_views.turns import all_turns, turn_ratios

# Mean time between two false alarms, s, if the model holds: ten days.
FALSE_ALARM_S = 864_000.0
# Shortest time between two looks at a camera, s; tracks of a look, the most certain ones; the fewest that must agree.
LOOK_S, MOST_TRACKS, FEWEST_TRACKS = 0.1, 10, 2
# Tracks that were not looked at for this long count no more, s.
FORGET_S = 5.0
# Part of the threshold from which a camera may be the one that was knocked, if another is beyond it.
SUSPICIOUS = 0.4
# Part of the tracks that must agree, if it is more than the fewest.
AGREEING = 0.5
# A frame whose median squared residual is below this, in variances, is passed over while no CUSUM is above 0.
CALM = 3.0
# Least probability that a track has no detection: it may be wrong, or hidden.
MISSED = 0.1
# The median of a squared residual in variances (two dimensions), the rate at which the spread follows it, and looks
# before an alarm.
MEDIAN, RATE, FIRST_LOOKS = 2.0 * math.log(2.0), 2e-3, 30


@dataclass(frozen=True)
class Knock:
    """A camera that has been knocked."""

    camera: str
    time_s: float  # When it was noticed
    since_s: float  # When it happened, estimated
    turn_deg: float  # Angle that explains it best, degrees
    shift_px: tuple[float, float]  # How far the image of the scene has moved, px


@dataclass(frozen=True)
class TrackSums:
    """CUSUMs of one track in one camera, one for each turn (h,), and since when each is above 0, s."""

    seen_s: float
    sums: Array
    since_s: Array


@dataclass(frozen=True)
class SuspectedTurn:
    """A sum of CUSUMs that is large, but may still be chance."""

    first_s: float  # When it was first as large
    since_s: float  # When it began to grow
    turn: int


@dataclass(frozen=True)
class CameraLooks:
    """What is known of one camera."""

    looked_s: float = -math.inf
    looks: int = 0
    spread: float = 1.0  # Factor of the variances
    tracks: dict[int, TrackSums] = field(default_factory=dict)
    suspicion: SuspectedTurn | None = None


@dataclass(frozen=True)
class KnockTest:
    """State of the test; it is replaced, never changed. After the first knock nothing is tested."""

    cameras: dict[str, CameraLooks] = field(default_factory=dict)
    is_over: bool = False


def look(test: KnockTest, cameras: tuple[Camera, ...], event: Event, since_s: float, before: Estimates
         ) -> tuple[KnockTest, Knock | None]:  # fmt: skip
    """Test an event's camera against the objects `before` it, which are those at `since_s`."""
    name = cameras[event.camera].name
    known = test.cameras.get(name, CameraLooks())
    if test.is_over or not len(before.track_ids) or before.extents is not None:
        return test, None
    if event.time_s < known.looked_s + LOOK_S or not len(event.points):
        return test, None
    camera = cameras[event.camera].at(event.time_s)
    predicted = _predict(camera, before, event.time_s - since_s)
    if predicted is None:
        return test, None
    ids, points, covariances = predicted
    noise = covariances + event.covariances.mean(axis=0)
    residuals = event.points[None] - points[:, None]
    squares = np.einsum("nmi,nij,nmj->nm", residuals, np.linalg.inv(noise), residuals).min(axis=1)
    tracks = {track: sums for track, sums in known.tracks.items() if sums.seen_s >= event.time_s - FORGET_S}
    if tracks or np.median(squares) > CALM * known.spread:
        most = _threshold(len(cameras), max(len(ids), len(tracks))).share
        turns, p_detect = all_turns(), camera.detector.p_detect
        ratios = turn_ratios(
            points, noise * known.spread, event.points, (camera.fx, camera.fy, camera.cx, camera.cy),
            (turns.shifts, turns.linear, turns.spread), max(1.0 - p_detect, MISSED),
            p_detect * camera.width * camera.height / len(event.points),
        )  # fmt: skip
        for track, ratio in zip(ids.tolist(), ratios, strict=True):
            old = tracks.get(track)
            sums = np.zeros(len(ratio)) if old is None else old.sums
            since = np.where(sums > 0.0, math.inf if old is None else old.since_s, event.time_s)
            tracks[track] = TrackSums(event.time_s, np.clip(sums + ratio, 0.0, most), since)
        if not any(sums.sums.any() for sums in tracks.values()):
            tracks = {}
    steps = np.sign(squares / known.spread - MEDIAN).sum() * max(RATE, 0.3 / (known.looks + 1))
    spread = max(known.spread * math.exp(min(max(steps, -0.2), 0.2)), 1.0)
    ratio, suspicion = _suspicion(tracks, len(cameras), event.time_s, known.suspicion)
    test = KnockTest({**test.cameras, name: CameraLooks(event.time_s, known.looks + 1, spread, tracks, suspicion)})
    if known.looks < FIRST_LOOKS or ratio < 1.0:
        return test, None
    # the tracks follow a camera that is wrong, and then others seem to be: it was the first
    suspects = [(c, test.cameras[c.name].suspicion) for c in cameras if c.name in test.cameras]
    turned, first = min(((c, s) for c, s in suspects if s is not None), key=lambda each: each[1].first_s)
    turns = all_turns()
    u, v = (turns.shifts[first.turn] * (turned.fx, turned.fy)).tolist()
    turn_deg = math.degrees(turns.size(first.turn))
    return KnockTest(is_over=True), Knock(turned.name, event.time_s, first.since_s, turn_deg, (u, v))


def _suspicion(
    tracks: Mapping[int, TrackSums], cameras: int, time_s: float, before: SuspectedTurn | None
) -> tuple[float, SuspectedTurn | None]:
    """Return how far the sum of the CUSUMs has come, in thresholds, and whether the camera is suspected."""
    if len(tracks) < FEWEST_TRACKS:
        return 0.0, before if before is not None and time_s < before.first_s + FORGET_S else None
    total = np.sum([track.sums for track in tracks.values()], axis=0)
    turn = int(total.argmax())
    ratio = float(total[turn]) / _threshold(cameras, len(tracks)).total
    if ratio < SUSPICIOUS:
        return ratio, before if ratio > 0.5 * SUSPICIOUS else None
    since_s = float(np.median([track.since_s[turn] for track in tracks.values() if track.sums[turn] > 0.0]))
    return ratio, SuspectedTurn(time_s if before is None else before.first_s, since_s, turn)


def _predict(camera: Camera, before: Estimates, elapsed_s: float) -> tuple[Integers, Array, Array] | None:
    """Return tracks in view, the most certain first: their numbers, undistorted pixels (n, 2), covariances (n, 2, 2).

    None if there are none.
    """
    states, covariances = before.states, before.covariances
    x = states[:, :3] + elapsed_s * states[:, 3:]
    seen = np.flatnonzero(camera.in_view(x))
    if not len(seen):
        return None
    step = np.hstack([np.eye(3), elapsed_s * np.eye(3)])
    local = camera.pose.to_camera(x[seen])
    scale = np.array([camera.fx, camera.fy]) / local[:, 2:]
    jacobians = np.zeros((len(seen), 2, 3))
    jacobians[:, 0, 0], jacobians[:, 1, 1] = scale.T
    jacobians[:, :, 2] = -scale * local[:, :2] / local[:, 2:]
    jacobians = jacobians @ camera.pose.rotation @ step
    spread = jacobians @ covariances[seen] @ np.swapaxes(jacobians, 1, 2)
    order = np.argsort(np.trace(spread, axis1=1, axis2=2), kind="stable")[:MOST_TRACKS]
    points = scale * local[:, :2] + (camera.cx, camera.cy)
    return before.track_ids[seen[order]], np.asarray(points[order]), np.asarray(spread[order])


@dataclass(frozen=True)
class _Threshold:
    total: float  # Of the sum over the tracks
    share: float  # Of one track


@cache
def _threshold(cameras: int, tracks: int) -> _Threshold:
    """Sum of the CUSUMs of tracks that is exceeded once in `FALSE_ALARM_S` in so many cameras, by bisection."""
    chance = LOOK_S / (FALSE_ALARM_S * cameras * len(all_turns().spread))
    low, high = 0.0, 50.0 + 5.0 * tracks
    for _ in range(60):
        middle = 0.5 * (low + high)
        terms = np.cumsum(np.log(middle / np.arange(1.0, tracks))) if tracks > 1 else np.empty(0)
        tail = math.exp(-middle) * (1.0 + float(np.exp(terms).sum()))
        low, high = (middle, high) if tail > chance else (low, middle)
    return _Threshold(high, high / max(FEWEST_TRACKS - 0.5, AGREEING * tracks))
