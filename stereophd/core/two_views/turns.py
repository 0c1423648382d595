"""Likelihoods of a frame if its camera were turned: by one of a family of turns, against none."""

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.pose import Pose
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import copy_gaussian
from stereophd.core.two_views.responses import (
    Pinhole,
    Predicted,
    add_residual,
    follow_detection,
    predict_track,
    square_of,
)

# Sizes of the turns (rad), how many sides each is to, and the standard deviation that a turn lends to each point, as a
# part of its size: the family has no gaps.
SMALLEST, LARGEST, RATIO, SIDES = math.radians(0.25), math.radians(12.0), 1.35, 16
SPREAD = 0.2
# The same of turns about the axis and of moves along it, whose size counts at one focal length from the middle.
SPREAD_ABOUT = 0.02


class Turns(NamedTuple):
    """What turns (h,) do to a normalised image."""

    shifts: Array  # (h, 2)
    linear: Array  # (h, 2, 2)
    spread: Array  # (h,): Added noise

    def size(self, turn: int) -> float:
        """Angle of a turn, rad."""
        return max(float(np.hypot(*self.shifts[turn])), float(np.abs(self.linear[turn]).max()))


@cache
def all_turns() -> Turns:
    """Return turns to all sides, about the axis, and moves along it, from the smallest to the largest."""
    sizes = SMALLEST * RATIO ** np.arange(int(math.log(LARGEST / SMALLEST) / math.log(RATIO)) + 1)
    angles = 2.0 * math.pi * np.arange(SIDES) / SIDES
    shifts = (sizes[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)).reshape(-1, 2)
    about, along = np.array([[0.0, -1.0], [1.0, 0.0]]), np.eye(2)
    linear = np.concatenate([np.multiply.outer(sign * sizes, each) for sign in (1, -1) for each in (about, along)])
    return Turns(
        np.concatenate([shifts, np.zeros((len(linear), 2))]),
        np.concatenate([np.zeros((len(shifts), 2, 2)), linear]),
        np.concatenate([SPREAD * np.repeat(sizes, SIDES), SPREAD_ABOUT * np.tile(sizes, 4)]),
    )


class LookedAt(NamedTuple):
    """Tracks that are looked at, t of n, and how they have followed the cameras."""

    rows: Integers  # (t,): Their rows among all, -1 for none
    counting: Booleans  # (t,): Whether they count
    responses: Array  # (t, 6, 6 c): To the poses of all c cameras; they become those after a frame
    passed_s: float  # Time since these


class TracksBefore(NamedTuple):
    """All tracks before a frame."""

    states: Array  # (n, 6)
    covariances: Array  # (n, 6, 6)
    in_view: Booleans  # (n,)
    since_s: float  # Time since then


class FrameDetections(NamedTuple):
    """Detections of a frame."""

    points: Array  # (m, 2): Undistorted pixels
    covariances: Array  # (m, 2, 2), px^2
    limit: float  # Squared residual, in variances, within which a detection is a track's
    factor: float  # Of the variances, for what detections say about poses


def prepare_turns() -> None:
    """Load the kernels, with no points."""
    none, covariances, nobody = np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0, dtype=np.bool_)
    pose = Pose(np.eye(3), np.zeros(3))
    # the arrays of a pose are read-only: those of others would load another form of the kernel
    camera = Pinhole(pose.rotation, pose.center, 1.0, 1.0, 0.0, 0.0)
    frame_ratios(*turn_ratios(none, covariances, none, camera, all_turns(), 1.0, 1.0), 0.0)
    tracks = TracksBefore(np.empty((0, 6)), np.empty((0, 6, 6)), nobody, 0.0)
    followed = LookedAt(np.empty(0, dtype=np.int64), nobody, np.empty((0, 6, 6)), 0.0)
    look_at_frame(tracks, followed, camera, 0, FrameDetections(none, covariances, 1.0, 1.0), np.zeros((2, 1, 6, 7)))


@compiled
def look_at_frame(
    tracks: TracksBefore, followed: LookedAt, camera: Pinhole, index: int, detections: FrameDetections, sums: Array
) -> tuple[Array, Array, Array, Booleans, Array]:
    """Return tracks predicted into an image and what detections are about them; add what these say about the poses.

    The camera's number is the index. To `sums` (2, c, 6, 7), information about the pose of each camera, and gradient,
    from every other one of the tracks looked at, the frame is added.

    Returns, of the tracks looked at that count and are in view, pixels (k, 2) and the covariances (k, 2, 2) of a
    detection about them, squared residuals (k,) of their nearest detections, in variances; which detections (m,) belong
    to no other track; and the sum (2,) of those residuals that are within the limit, in its standard deviations, NaN
    without any.
    """
    in_view, rows, counting, responses = tracks.in_view, followed.rows, followed.counting, followed.responses
    points, limit = detections.points, detections.limit
    average = np.zeros((2, 2))
    for j in range(len(points)):
        for r in range(2):
            for s in range(2):
                average[r, s] += detections.covariances[j, r, s] / len(points)
    place_of = np.full(len(in_view), -1)
    for i in range(len(rows)):
        if rows[i] >= 0:
            place_of[rows[i]] = i
        for r in range(3):
            for q in range(responses.shape[2]):
                responses[i, r, q] += followed.passed_s * responses[i, r + 3, q]
    # of the tracks that are looked at, and of one of the others
    places, pixels, seen = np.empty((len(rows) + 1, 3)), np.empty((len(rows) + 1, 2)), np.empty((len(rows) + 1, 2, 3))
    shared, spreads = np.empty((len(rows) + 1, 2, 6)), np.empty((len(rows) + 1, 2, 2))
    squares, nearest = np.full(len(rows), np.inf), np.full(len(rows), -1)
    owners, free = np.zeros(len(points), dtype=np.int64), np.ones(len(points), dtype=np.bool_)
    for k in range(len(in_view)):
        if not in_view[k]:
            continue
        i = place_of[k]
        predicted = Predicted(places[i], pixels[i], seen[i], shared[i], spreads[i])
        predict_track(tracks.states[k], tracks.covariances[k], tracks.since_s, camera, predicted)
        for r in range(2):
            for s in range(2):
                spreads[i, r, s] += average[r, s]
        for j in range(len(points)):
            square = square_of(points[j, 0] - pixels[i, 0], points[j, 1] - pixels[i, 1], spreads[i])
            owners[j] += square < limit
            if i < 0:
                free[j] &= square >= limit
            elif square < squares[i]:
                squares[i], nearest[i] = square, j
    total_u, total_v, a, b, c, count = 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for i in range(len(rows)):
        if squares[i] >= limit:
            continue
        j = nearest[i]
        u, v = points[j, 0] - pixels[i, 0], points[j, 1] - pixels[i, 1]
        if counting[i]:
            total_u, total_v = total_u + u, total_v + v
            a, b, c = a + spreads[i, 0, 0], b + spreads[i, 0, 1], c + spreads[i, 1, 1]
            count += 1
        if owners[j] == 1:
            predicted = Predicted(places[i], pixels[i], seen[i], shared[i], spreads[i])
            slope = follow_detection(responses[i], predicted, camera, index)
            if counting[i]:
                add_residual(sums[i % 2], slope, (u, v), spreads[i], detections.factor)
    mean = np.full(2, np.nan)
    if count > 0:
        mean[0] = total_u / math.sqrt(a)
        mean[1] = (total_v - b / a * total_u) / math.sqrt(c - b**2 / a)
    count = 0
    for i in range(len(rows)):
        if rows[i] >= 0 and counting[i] and in_view[rows[i]]:
            squares[count] = squares[i]
            copy_gaussian(pixels, spreads, i, pixels, spreads, count)
            count += 1
    return pixels[:count], spreads[:count], squares[:count], free, mean


@compiled
def turn_ratios(
    points: Array, covariances: Array, detections: Array, camera: Pinhole, turns: Turns, missed: float, weight: float
) -> tuple[Array, Integers]:
    """Log-likelihood ratios (n, h + 1) of a frame for each of n predicted points alone, of each turn against none.

    The last ones are those of points that something hides. Also returns which detection (n, h + 1) is most probably the
    point's, -1 for none.

    Points (n, 2) are predicted pixels, with the covariances (n, 2, 2) of a detection about them, px^2. Each of the
    detections (m, 2) may be the point's; it is missed with the probability `missed`, and `weight` is the probability
    that it is detected over the density of detections in the image, px^2. Pixels are undistorted.
    """
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    shifts, linear, spread = turns.shifts, turns.linear, turns.spread
    out, likely = np.empty((len(points), len(spread) + 1)), np.full((len(points), len(spread) + 1), -1)
    for i in range(len(points)):
        x, y = (points[i, 0] - cx) / fx, (points[i, 1] - cy) / fy
        still = missed
        for h in range(-1, len(spread)):
            move_u, move_v, more = 0.0, 0.0, 0.0
            if h >= 0:
                move_u = (shifts[h, 0] + x * linear[h, 0, 0] + y * linear[h, 1, 0]) * fx
                move_v = (shifts[h, 1] + x * linear[h, 0, 1] + y * linear[h, 1, 1]) * fy
                more = (spread[h] * fx) ** 2
            a, b, c = covariances[i, 0, 0] + more, covariances[i, 0, 1], covariances[i, 1, 1] + more
            determinant = a * c - b * b
            total, largest = 0.0, 0.0
            for j in range(len(detections)):
                u = detections[j, 0] - points[i, 0] - move_u
                v = detections[j, 1] - points[i, 1] - move_v
                if u * u > 50.0 * a or v * v > 50.0 * c:  # each alone is at most the square
                    continue
                square = (c * u * u - 2.0 * b * u * v + a * v * v) / determinant
                if square < 50.0:
                    density = math.exp(-0.5 * square)
                    total += density
                    if density > largest:
                        largest, likely[i, h] = density, j
            likelihood = missed + weight * total / (2.0 * math.pi * math.sqrt(determinant))
            if h < 0:
                still = likelihood
            else:
                out[i, h] = math.log(likelihood / still)
        out[i, -1] = -math.log(still)
    return out, likely


@compiled
def frame_ratios(ratios: Array, likely: Integers, fewest: float) -> Array:
    """Return the log-likelihood ratio (h,) of a frame for each turn, from what `turn_ratios` returns of its tracks.

    A detection speaks for one track, for which it does so loudest: a false one lies near several of them after some
    turn. What is compared with a turn is no turn, or that something hides all tracks for as long as it likes, whichever
    is more probable. No track speaks more than twice as loud as all others together. Where fewer tracks than `fewest`
    speak for a turn, only what speaks against it counts: neighbours hide together, and a turn may bring others into
    their places.
    """
    out, hidden = np.empty(ratios.shape[1] - 1), max(ratios[:, -1].sum(), 0.0)
    for h in range(len(out)):
        total, against, loudest, agreeing = 0.0, 0.0, -np.inf, 0
        for i in range(len(ratios)):
            ratio = ratios[i, h]
            for k in range(len(ratios)):
                if k != i and likely[k, h] == likely[i, h] >= 0 and (ratios[k, h], -k) > (ratios[i, h], -i):
                    ratio = min(ratio, 0.0)
            total += ratio
            against += min(ratio, 0.0)
            loudest = max(loudest, ratio)
            agreeing += ratio > 0.0
        out[h] = min(total, 3.0 * (total - loudest)) - hidden if agreeing >= fewest else against
    return out
