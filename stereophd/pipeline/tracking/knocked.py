"""Whether a camera has been knocked: two sequential tests of its detections against what the tracks predict for it.

**Turns** show at once, and by however much. At a look, the confirmed tracks are predicted into the image. For each
track and each of a set of turns of the camera (to any side by 0.25 to 12 degrees, about its axis, or nearer), the
likelihood of the frame is compared with that without a turn. A detection is any one of the track's neighbours, or
false, or missed: nothing is gated, so a turn of a hundred standard deviations is as visible as one of three. The
log-likelihood ratios of the tracks add up to one of the frame, and those of the frames to a CUSUM for each turn, which
never falls below 0. Without a knock a CUSUM exceeds c with a probability of at most exp(-c) (Wald). A camera is knocked
when one is beyond the value that is exceeded once in `FALSE_ALARM_S` by chance, over all looks, turns and cameras. In a
frame a track speaks for a turn at most twice as loud as all others together, and half of the tracks, two at least, must
speak for it: a wrong track is no knock. Tracks soon follow a small turn; from then on this test says nothing.

**Changes of a pose** that tracks follow show in the residuals of all cameras, a little in each. The test knows how far
each track has followed each camera (`stereophd.core.two_views.responses`), and compares the poses of the last seconds,
all six unknowns of each, with what they were off by before.

A small steady misfit of lens, pose or motion is no knock either: the spread of the residuals, which follows
their tail, widens all likelihoods. Objects that move as one, such as the corners of a board, may be off
together, and stay so while they brake: the ratios are divided by the factor by which the running mean of the residuals
spreads more than that of independent ones. What poses seem to change by all the time divides the evidence as well.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cache
from statistics import median

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.two_views.responses import Pinhole, PoseChange, find_change
from stereophd.core.two_views.turns import (
    FrameDetections,
    LookedAt,
    TracksBefore,
    all_turns,
    frame_ratios,
    look_at_frame,
    turn_ratios,
)

# Mean time between two false alarms, s, if the model holds: ten days.
FALSE_ALARM_S = 864_000.0
# Most looks per second at all cameras; tracks that are looked at, chosen as if at random by their numbers' multiples of
# the golden ratio; the fewest that must agree.
MOST_LOOKS, MOST_TRACKS, FEWEST_TRACKS = 80.0, 12, 2.0
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
# Pairs of a track and a detection of a look: in a crowd fewer of the other tracks are predicted.
MOST_PAIRS = 20_000
# Residuals are summed over blocks of so long, s; a change is looked for in the last one, two, ... so many of them,
# against all before, whose sums shrink by a factor of e in so many blocks. Once the noise is known it is looked for in
# slow logs after so many looks at the camera, or before a change is older than the blocks.
BLOCK_S, BLOCKS, REMEMBERED, LOOKS_A_QUESTION = 1.0, 5, 20, 4
# Age from which a track counts, s: a new one may be wrong.
LEAST_AGE_S = 1.0
# After so long without a look the sums begin anew, s.
FORGET_S = 5.0
# Part of the threshold from which a camera may be the one that was knocked, if another is beyond it.
SUSPICIOUS = 0.4
# So long after a knock tracks have followed the camera, if it moved their images by less than so many deviations of the
# noise: then a turn is as well that of any other camera.
CLEAR_S, FOLLOWED = 0.2, 10.0
# Part of the tracks that must agree, if it is more than the fewest, and of the threshold that one look may give: what
# jumps as one, such as a board, looks like a knock to the first camera that sees it, until the others have.
AGREEING, OF_ONE_LOOK = 0.5, 0.75
# A frame whose median squared residual is below this, in variances, is passed over while no CUSUM is above 0.
CALM = 3.0
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
    # Mean squared misfit of a block to those before, in what the model expects, and of how many blocks it is
    scatter: float = 1.0
    blocks: int = 0
    asked: int = 0  # Looks when a change was looked for last, and when that was, s
    asked_s: float = -math.inf


@dataclass(frozen=True)
class Responses:
    """How far tracks have followed the cameras, and what their residuals say about the poses."""

    time_s: float  # Of the last look
    all_ids: Integers  # Of all tracks
    track_ids: Integers  # (t,): Tracks that are looked at, -1 for none
    rows: Integers  # (t,): Their rows among all
    since_s: Array  # (t,): Since when
    values: Array  # (t, 6, 6 c): Derivatives of their states with respect to the poses of all c cameras
    began_s: float  # When the last block began
    # Sums (2, c, 6, 7) of each block: the first is of all before the others, the last one goes on
    blocks: tuple[Array, ...]


@dataclass(frozen=True)
class KnockTest:
    """State of the test; it is replaced, never changed. After the first knock nothing is tested."""

    cameras: dict[str, CameraLooks] = field(default_factory=dict)
    responses: Responses | None = None
    is_over: bool = False


# After a knock, and of a run that is asked for none.
NO_TEST = KnockTest(is_over=True)


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
    in_view = camera.in_view(before.states[:, :3] + elapsed_s * before.states[:, 3:])
    if not in_view.any():
        return test, None
    responses = _responses_at(test.responses, before.track_ids, len(cameras), event.time_s)
    predicted = max(MOST_PAIRS // len(event.points), MOST_TRACKS)
    if predicted < len(in_view):
        in_view[predicted:] &= np.isin(before.track_ids[predicted:], responses.track_ids)
    pinhole = Pinhole(camera.pose.rotation, camera.pose.center, camera.fx, camera.fy, camera.cx, camera.cy)
    # what belongs to a track that is not looked at speaks for no turn of the others
    values, sums_of_block = responses.values.copy(), responses.blocks[-1].copy()
    is_old = responses.since_s <= event.time_s - LEAST_AGE_S
    points, noise, nearest, is_free, alone = look_at_frame(
        TracksBefore(before.states, before.covariances, in_view, elapsed_s),
        LookedAt(responses.rows, is_old, values, event.time_s - responses.time_s), pinhole, event.camera,
        FrameDetections(event.points, event.covariances, TAKEN * known.spread, known.spread), sums_of_block,
    )  # fmt: skip
    responses = replace(responses, time_s=event.time_s, values=values, blocks=(*responses.blocks[:-1], sums_of_block))
    waits = known.blocks > BLOCKS and event.time_s < known.asked_s + (BLOCKS - 1) * BLOCK_S
    is_due = known.looked_s < responses.began_s and not (waits and known.looks < known.asked + LOOKS_A_QUESTION)
    if is_due and len(responses.blocks) > BLOCKS + 1:
        known = replace(known, asked=known.looks, asked_s=event.time_s)
        change = _change(responses, event.camera, known)
        if change is not None:
            # exceeded once in that time by chance, of one of so many poses
            least = math.log(len(cameras) * BLOCKS * FALSE_ALARM_S / BLOCK_S)
            if known.blocks > BLOCKS and change.evidence > least:
                return NO_TEST, _changed(test.cameras, responses, cameras, event.time_s)
            if change.misfit is not None:
                blocks = known.blocks + 1
                scatter = known.scatter + (change.misfit - known.scatter) / min(blocks, REMEMBERED)
                known = replace(known, scatter=scatter, blocks=blocks)
    squares: list[float] = nearest.tolist()
    if not squares:
        return KnockTest({**test.cameras, name: replace(known, looked_s=event.time_s)}, responses), None
    sums, rising_s = (None, None) if event.time_s > known.looked_s + FORGET_S else (known.sums, known.since_s)
    if known.looks >= FIRST_LOOKS and (sums is not None or median(squares) > CALM * known.spread):
        p_detect = camera.detector.p_detect
        ratios, likely = turn_ratios(
            points, noise * known.spread, event.points[is_free], pinhole, all_turns(), max(1.0 - p_detect, MISSED),
            p_detect * camera.width * camera.height / len(event.points),
        )  # fmt: skip
        sums, rising_s = _added(sums, rising_s, ratios, likely, known.coherence, event.time_s)
    strange = STRANGE * known.spread if known.looks >= FIRST_LOOKS else math.inf
    spread = _followed(known.spread, [each for each in squares if each < strange], TAIL, known.looks)
    lasting, together = known.lasting, []
    if not math.isnan(alone[0]):
        alone = alone / math.sqrt(known.spread)
        lasting = alone if lasting is None else LASTING * lasting + math.sqrt(1.0 - LASTING**2) * alone
        together = [float(lasting @ lasting)]
    coherence = _followed(known.coherence, together, MEDIAN, known.looks)
    looks = CameraLooks(
        event.time_s, known.looks + 1, spread, lasting, coherence, sums, rising_s, known.scatter, known.blocks,
        known.asked, known.asked_s,
    )  # fmt: skip
    test = KnockTest({**test.cameras, name: looks}, responses)
    knock = _turned(test.cameras, cameras, event.camera, event.time_s)
    return (test, None) if knock is None else (NO_TEST, knock)


def _turned(looks: dict[str, CameraLooks], cameras: tuple[Camera, ...], index: int, time_s: float) -> Knock | None:
    """Return the knock if a camera has turned, unless tracks would by now have followed such a turn."""
    camera = cameras[index]
    known = looks[camera.name]
    if known.sums is None or known.since_s is None or known.sums.max() < _threshold():
        return None
    turn = int(known.sums.argmax())
    since_s, size = float(known.since_s[turn]), all_turns().size(turn)
    is_small = size * camera.fx < FOLLOWED * max(camera.detector.sigma) * math.sqrt(known.spread)
    if is_small and time_s > since_s + CLEAR_S:
        return None
    u, v = (all_turns().shifts[turn] * (camera.fx, camera.fy)).tolist()
    largest = {name: each.sums.max() for name, each in looks.items() if each.sums is not None}
    others = tuple(
        each.name for each in cameras if each is not camera and largest.get(each.name, 0.0) > SUSPICIOUS * _threshold()
    )
    return Knock(camera.name, time_s, since_s, math.degrees(size), (u, v), others)


def _responses_at(known: Responses | None, track_ids: Integers, cameras: int, time_s: float) -> Responses:
    """Return responses with the tracks there are, in the block of a time."""
    if known is None:
        nothing, nobody = np.zeros((2, cameras, 6, 7)), np.full(MOST_TRACKS, -1)
        values = np.zeros((MOST_TRACKS, 6, 6 * cameras))
        known = Responses(time_s, nobody, nobody, nobody, np.full(MOST_TRACKS, time_s), values, time_s, (nothing,))
    if time_s >= known.began_s + BLOCK_S:
        blocks = known.blocks
        if len(blocks) > BLOCKS + 1:
            blocks = (math.exp(-1.0 / REMEMBERED) * blocks[0] + blocks[1], *blocks[2:])
        known = replace(known, began_s=time_s, blocks=(*blocks, np.zeros_like(blocks[0])))
    if np.array_equal(track_ids, known.all_ids):
        return known
    # the places of tracks that go are those of tracks that come
    chosen = np.sort(track_ids[np.argsort(track_ids * GOLDEN % 1.0)[:MOST_TRACKS]])
    stay, come = np.isin(known.track_ids, chosen), np.setdiff1d(chosen, known.track_ids)
    places = np.flatnonzero(~stay)[: len(come)]
    ids, since_s, values = np.where(stay, known.track_ids, -1), known.since_s.copy(), known.values.copy()
    ids[places], since_s[places], values[places] = come, time_s, 0.0
    row_of = {track: row for row, track in enumerate(track_ids.tolist())}
    rows = np.array([row_of.get(track, -1) for track in ids.tolist()])
    return replace(known, all_ids=track_ids, track_ids=ids, rows=rows, since_s=since_s, values=values)


def _change(responses: Responses, camera: int, known: CameraLooks) -> PoseChange | None:
    """Return the clearest change of a camera's pose within the blocks that have ended."""
    return find_change(np.stack(responses.blocks[:-1])[:, :, camera], max(known.scatter, 1.0))


def _changed(looks: dict[str, CameraLooks], responses: Responses, cameras: tuple[Camera, ...], time_s: float) -> Knock:
    """Return the camera whose pose has changed most clearly, and those for which the evidence is not much less."""
    changes = [
        (camera, change)
        for index, camera in enumerate(cameras)
        if camera.name in looks and (change := _change(responses, index, looks[camera.name])) is not None
    ]
    (camera, first), *others = sorted(changes, key=lambda each: -each[1].evidence)
    names = tuple(c.name for c, change in others if change.evidence > SUSPICIOUS * first.evidence)
    side = np.array([first.turns[1] - first.moves[0], -first.turns[0] - first.moves[1]])
    size = max(float(np.hypot(*side)), abs(first.turns[2]), abs(first.moves[2]))
    u, v = (side * (camera.fx, camera.fy)).tolist()
    since_s = responses.began_s - BLOCK_S * first.blocks
    return Knock(camera.name, time_s, since_s, math.degrees(size), (u, v), names)


def _followed(factor: float, squares: list[float], quantile: tuple[float, float, float], looks: int) -> float:
    """Return a factor of variances, at least 1, after more squared residuals in the variances stated."""
    level, beyond, rate = quantile
    step = (sum(each > level * factor for each in squares) - beyond * len(squares)) * max(
        rate, FIRST_RATE / (looks + 1)
    )
    return max(factor * math.exp(min(max(step, -FIRST_RATE), FIRST_RATE)), 1.0)


def _added(
    sums: Array | None, since_s: Array | None, ratios: Array, likely: Integers, coherence: float, time_s: float
) -> tuple[Array | None, Array | None]:
    """Return CUSUMs, and since when they are above 0, with what `turn_ratios` returns of a look."""
    total = frame_ratios(ratios, likely, max(FEWEST_TRACKS, AGREEING * len(ratios))) / coherence
    total *= min(1.0, OF_ONE_LOOK * _threshold() / max(float(total.max()), 1e-12))
    before = np.zeros(len(total)) if sums is None else sums
    after = np.maximum(before + total, 0.0)
    if not after.any():
        return None, None
    return after, np.where(before > 0.0, time_s if since_s is None else since_s, time_s)


@cache
def _threshold() -> float:
    """CUSUM that is exceeded once in `FALSE_ALARM_S` by chance."""
    return math.log(len(all_turns().spread) * FALSE_ALARM_S * MOST_LOOKS)
