"""Whether a camera has been knocked: a sequential test of its detections against what the tracks predict for it.

At a look, the confirmed tracks are predicted into the image. For each track and each of a set of *turns* of the camera
(to any side by 0.15 to 12 degrees, about its axis, or nearer), the likelihood of the frame is compared with that
without a turn. A detection is any one of the track's neighbours, or false, or missed: nothing is gated, so a turn of a
hundred standard deviations is as visible as one of three. The log-likelihood ratios of the tracks add up to one of the
frame, and those of the frames to a CUSUM for each turn, which never falls below 0. Without a knock a CUSUM exceeds c
with a probability of at most exp(-c) (Wald). A camera is knocked when one is beyond the value that is exceeded once in
`FALSE_ALARM_S` by chance, over all looks, turns and cameras. In a frame a track speaks for a turn at most twice
as loud as all others together, and half of the tracks, two at least, must speak for it: a wrong track is no knock.

A small steady misfit of lens, pose or motion is no knock either: the spread of the residuals, which follows
their tail, widens all likelihoods. Objects that move as one, such as the corners of a board, may be off
together, and stay so while they brake: the ratios are divided by the factor by which the running mean of the residuals
spreads more than that of independent ones.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cache
from statistics import median

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.two_views.turns import all_turns, frame_ratios, nearest_detections, turn_ratios

# Mean time between two false alarms, s, if the model holds: ten days.
FALSE_ALARM_S = 864_000.0
# Most looks a second at all cameras; tracks of a look, the most certain ones; the fewest that must agree.
MOST_LOOKS, MOST_TRACKS, FEWEST_TRACKS = 80.0, 10, 2.0
# Pairs of a track and a detection of a look: in a crowd fewer tracks are predicted.
MOST_PAIRS = 20_000
# Age from which a track counts, s: a new one may be wrong.
LEAST_AGE_S = 1.0
# After so long without a look the sums begin anew, s.
FORGET_S = 5.0
# Part of the threshold from which a camera may be the one that was knocked, if another is beyond it.
SUSPICIOUS = 0.4
# So long after a knock tracks have followed the camera, if it moved their images by less than so many deviations of the
# noise: then any other camera may be the one.
CLEAR_S, FOLLOWED = 0.2, 10.0
# Part of the tracks that must agree, if it is more than the fewest.
AGREEING = 0.5
# A frame whose median squared residual is below this, in variances, is passed over while no CUSUM is above 0.
CALM = 2.0
# Part of the running mean of residuals that stays from look to look.
LASTING = 0.925
# Squared residual, in variances, within which a detection belongs to a track, and beyond which it is surely another's.
TAKEN, STRANGE = 16.0, 100.0
# Least probability that a track has no detection: it may be wrong, or hidden.
MISSED = 0.1
# A factor of variances follows a quantile: the squared residual in variances (two dimensions), the part beyond it, and
# the rate for each residual. That of single ones is in the tail: an object may turn or brake harder than the motion
# model leads to expect. At first rates are higher; looks before the sums begin.
TAIL, MEDIAN = (-2.0 * math.log(0.05), 0.05, 5e-3), (2.0 * math.log(2.0), 0.5, 4e-3)
FIRST_RATE, FIRST_LOOKS = 0.3, 30


@dataclass(frozen=True)
class Knock:
    """A camera that has been knocked."""

    camera: str
    time_s: float  # When it was noticed
    since_s: float  # When it happened, estimated
    turn_deg: float  # Angle that explains it best, degrees
    shift_px: tuple[float, float]  # How far the image of the scene has moved, px
    others: tuple[str, ...] = ()  # Cameras that may be the one in its place


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
    # (2,): Running mean of the sum of the residuals of a frame, in the deviations of residuals that are independent
    lasting: Array | None = None
    coherence: float = 1.0  # Factor of the variance of that mean
    sums: Array | None = None  # CUSUM of each turn (h,); None: all are 0
    since_s: Array | None = None  # Since when each is above 0, s
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
    if event.time_s < known.looked_s + len(cameras) / MOST_LOOKS or not len(event.points):
        return test, None
    camera = cameras[event.camera].at(event.time_s)
    elapsed_s = event.time_s - since_s
    seen = np.flatnonzero(camera.in_view(before.states[:, :3] + elapsed_s * before.states[:, 3:]))
    if not len(seen):
        return test, None
    born_s = {track: test.born_s.get(track, event.time_s) for track in before.track_ids.tolist()}
    test = replace(test, born_s=born_s)
    is_old = np.array([born_s[track] <= event.time_s - LEAST_AGE_S for track in before.track_ids[seen].tolist()])
    pixels = camera.fx, camera.fy, camera.cx, camera.cy
    # what belongs to a track that is not looked at speaks for no turn of the others
    points, noise, nearest, is_free, alone = nearest_detections(
        (before.states[seen], before.covariances[seen], is_old, elapsed_s), (camera.pose.rotation, camera.pose.center),
        pixels, (event.points, event.covariances),
        (max(MOST_TRACKS, MOST_PAIRS // len(event.points)), MOST_TRACKS), TAKEN * known.spread,
    )  # fmt: skip
    squares: list[float] = nearest.tolist()
    if not squares:
        return replace(test, cameras={**test.cameras, name: replace(known, looked_s=event.time_s)}), None
    sums, rising_s = (None, None) if event.time_s > known.looked_s + FORGET_S else (known.sums, known.since_s)
    if known.looks >= FIRST_LOOKS and (sums is not None or median(squares) > CALM * known.spread):
        turns, p_detect = all_turns(), camera.detector.p_detect
        ratios = turn_ratios(
            points, noise * known.spread, event.points[is_free], pixels,
            (turns.shifts, turns.linear, turns.spread), max(1.0 - p_detect, MISSED),
            p_detect * camera.width * camera.height / len(event.points),
        )  # fmt: skip
        sums, rising_s = _added(sums, rising_s, ratios, known.coherence, event.time_s)
    strange = STRANGE * known.spread if known.looks >= FIRST_LOOKS else math.inf
    spread = _followed(known.spread, [each for each in squares if each < strange], TAIL, known.looks)
    lasting, together = known.lasting, []
    if not math.isnan(alone[0]):
        alone = alone / math.sqrt(known.spread)
        lasting = alone if lasting is None else LASTING * lasting + math.sqrt(1.0 - LASTING**2) * alone
        together = [float(lasting @ lasting)]
    coherence = _followed(known.coherence, together, MEDIAN, known.looks)
    ratio, suspicion = _suspicion(sums, rising_s, _threshold(), event.time_s, known.suspicion)
    looks = CameraLooks(event.time_s, known.looks + 1, spread, lasting, coherence, sums, rising_s, suspicion)
    test = replace(test, cameras={**test.cameras, name: looks})
    return (test, None) if ratio < 1.0 else (KnockTest(is_over=True), _knock(test, cameras, event.time_s))


def _knock(test: KnockTest, cameras: tuple[Camera, ...], time_s: float) -> Knock:
    """Return which camera was knocked: the tracks follow it, and then others seem to be; it was the first."""
    suspects = [(c, test.cameras[c.name].suspicion) for c in cameras if c.name in test.cameras]
    (camera, first), *others = sorted(((c, s) for c, s in suspects if s is not None), key=lambda each: each[1].first_s)
    u, v = (all_turns().shifts[first.turn] * (camera.fx, camera.fy)).tolist()
    size = all_turns().size(first.turn)
    noise_px = max(camera.detector.sigma) * math.sqrt(test.cameras[camera.name].spread)
    if time_s > first.since_s + CLEAR_S and size * camera.fx < FOLLOWED * noise_px:
        names = tuple(c.name for c, _ in suspects if c is not camera)
    else:
        names = tuple(c.name for c, _ in others)
    return Knock(camera.name, time_s, first.since_s, math.degrees(size), (u, v), names)


def _followed(factor: float, squares: list[float], quantile: tuple[float, float, float], looks: int) -> float:
    """Return a factor of variances, at least 1, after more squared residuals in the variances stated."""
    level, beyond, rate = quantile
    step = (sum(each > level * factor for each in squares) - beyond * len(squares)) * max(
        rate, FIRST_RATE / (looks + 1)
    )
    return max(factor * math.exp(min(max(step, -FIRST_RATE), FIRST_RATE)), 1.0)


def _added(
    sums: Array | None, since_s: Array | None, ratios: Array, coherence: float, time_s: float
) -> tuple[Array | None, Array | None]:
    """Return CUSUMs, and since when they are above 0, with the ratios (n, h) of the tracks of a look."""
    total = frame_ratios(ratios, max(FEWEST_TRACKS, AGREEING * len(ratios))) / coherence
    before = np.zeros(len(total)) if sums is None else sums
    after = np.maximum(before + total, 0.0)
    if not after.any():
        return None, None
    return after, np.where(before > 0.0, time_s if since_s is None else since_s, time_s)


def _suspicion(
    sums: Array | None, since_s: Array | None, threshold: float, time_s: float, before: SuspectedTurn | None
) -> tuple[float, SuspectedTurn | None]:
    """Return how far the largest CUSUM has come, in thresholds, and whether the camera is suspected."""
    if sums is None or since_s is None:
        return 0.0, before if before is not None and time_s < before.first_s + FORGET_S else None
    turn = int(sums.argmax())
    ratio = float(sums[turn]) / threshold
    if ratio < SUSPICIOUS:
        return ratio, before if ratio > 0.5 * SUSPICIOUS else None
    return ratio, SuspectedTurn(time_s if before is None else before.first_s, float(since_s[turn]), turn)


@cache
def _threshold() -> float:
    """CUSUM that is exceeded once in `FALSE_ALARM_S` by chance."""
    return math.log(len(all_turns().spread) * FALSE_ALARM_S * MOST_LOOKS)
