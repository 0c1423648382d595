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
median within a minute, widens all likelihoods. Objects that move as one, such as the corners of a board, may be off
together: the ratios are divided by the factor by which the sum of their residuals spreads more than it would alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
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
# Pairs of a track and a detection of a look: in a crowd fewer tracks are predicted.
MOST_PAIRS = 20_000
# Age from which a track counts, s: a new one may be wrong.
LEAST_AGE_S = 1.0
# Tracks that were not looked at for this long count no more, s.
FORGET_S = 5.0
# Part of the threshold from which a camera may be the one that was knocked, if another is beyond it.
SUSPICIOUS = 0.4
# Part of the tracks that must agree, if it is more than the fewest.
AGREEING = 0.5
# A frame whose median squared residual is below this, in variances, is passed over while no CUSUM is above 0.
CALM = 3.0
# Factor of the variances in the test: an object may turn or brake harder than the motion model leads to expect.
MISFIT = 2.0
# Squared residual, in variances, within which a detection belongs to a track.
TAKEN = 16.0
# Least probability that a track has no detection: it may be wrong, or hidden.
MISSED = 0.1
# The median of a squared residual in variances (two dimensions), and the rates at which factors follow it, at last and
# at first; looks before an alarm.
MEDIAN, RATE, FIRST_RATE, FIRST_LOOKS = 2.0 * math.log(2.0), 2e-3, 0.3, 30


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
    coherence: float = 1.0  # Factor of the variance of the sum of the residuals of a frame
    tracks: dict[int, TrackSums] = field(default_factory=dict)
    suspicion: SuspectedTurn | None = None


@dataclass(frozen=True)
class KnockTest:
    """State of the test; it is replaced, never changed. After the first knock nothing is tested."""

    cameras: dict[str, CameraLooks] = field(default_factory=dict)
    born_s: dict[int, float] = field(default_factory=dict)  # Track -> time at which it was first seen here
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
    most_known = max(MOST_TRACKS, MOST_PAIRS // len(event.points))
    ids, points, covariances = predicted[0][:most_known], predicted[1][:most_known], predicted[2][:most_known]
    noise = covariances + event.covariances.mean(axis=0)
    residuals = event.points[None] - points[:, None]
    squares = np.einsum("nmi,nij,nmj->nm", residuals, np.linalg.inv(noise), residuals)
    born_s = {track: test.born_s.get(track, event.time_s) for track in before.track_ids.tolist()}
    test = replace(test, born_s=born_s)
    is_old = np.array([born_s[track] <= event.time_s - LEAST_AGE_S for track in ids.tolist()])
    chosen, others = np.flatnonzero(is_old)[:MOST_TRACKS], np.ones(len(ids), dtype=bool)
    if not len(chosen):
        return test, None
    others[chosen] = False
    # what belongs to a track that is not looked at speaks for no turn of the others
    detections = event.points[~(squares[others] < TAKEN * known.spread).any(axis=0)]
    nearest = squares[chosen].argmin(axis=1)
    ids, points, noise, residuals, squares = (
        ids[chosen], points[chosen], noise[chosen], residuals[chosen, nearest], squares[chosen, nearest]
    )  # fmt: skip
    tracks = {track: sums for track, sums in known.tracks.items() if sums.seen_s >= event.time_s - FORGET_S}
    if tracks or np.median(squares) > CALM * known.spread:
        most = _threshold(len(cameras), max(len(ids), len(tracks))).share
        turns, p_detect = all_turns(), camera.detector.p_detect
        ratios = turn_ratios(
            points, noise * (MISFIT * known.spread), detections, (camera.fx, camera.fy, camera.cx, camera.cy),
            (turns.shifts, turns.linear, turns.spread), max(1.0 - p_detect, MISSED),
            p_detect * camera.width * camera.height / len(event.points),
        )  # fmt: skip
        # neighbours hide together, and a turn may bring others into their places: those speak against it
        ratios = np.where(ratios.sum(axis=0) > 0.0, ratios, np.minimum(ratios, 0.0)) / known.coherence
        for track, ratio in zip(ids.tolist(), ratios, strict=True):
            old = tracks.get(track)
            sums = np.zeros(len(ratio)) if old is None else old.sums
            since = np.where(sums > 0.0, math.inf if old is None else old.since_s, event.time_s)
            tracks[track] = TrackSums(event.time_s, np.clip(sums + ratio, 0.0, most), since)
        if not any(sums.sums.any() for sums in tracks.values()):
            tracks = {}
    spread = _followed(known.spread, squares / known.spread, known.looks)
    good = squares < TAKEN * known.spread
    mean, variance = residuals[good].sum(axis=0), noise[good].sum(axis=0) * known.spread
    together = np.array([mean @ np.linalg.solve(variance, mean)]) if good.any() else np.empty(0)
    coherence = _followed(known.coherence, together / known.coherence, known.looks)
    looks = CameraLooks(event.time_s, known.looks + 1, spread, coherence, tracks)
    ratio, suspicion = _suspicion(tracks, len(cameras), event.time_s, known.suspicion)
    test = replace(test, cameras={**test.cameras, name: replace(looks, suspicion=suspicion)})
    if known.looks < FIRST_LOOKS or ratio < 1.0:
        return test, None
    # the tracks follow a camera that is wrong, and then others seem to be: it was the first
    suspects = [(c, test.cameras[c.name].suspicion) for c in cameras if c.name in test.cameras]
    turned, first = min(((c, s) for c, s in suspects if s is not None), key=lambda each: each[1].first_s)
    turns = all_turns()
    u, v = (turns.shifts[first.turn] * (turned.fx, turned.fy)).tolist()
    turn_deg = math.degrees(turns.size(first.turn))
    return KnockTest(is_over=True), Knock(turned.name, event.time_s, first.since_s, turn_deg, (u, v))


def _followed(factor: float, squares: Array, looks: int) -> float:
    """Return a factor of variances after more squared residuals in such variances: at least 1, and half are within."""
    step = float(np.sign(squares - MEDIAN).sum()) * max(RATE, FIRST_RATE / (looks + 1))
    return max(factor * math.exp(min(max(step, -FIRST_RATE), FIRST_RATE)), 1.0)


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
    order = np.argsort(np.trace(spread, axis1=1, axis2=2), kind="stable")
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
