"""Likelihoods of a frame if its camera were turned: by one of a family of turns, against none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry.pose import Pose
from stereophd.core.numerics.compilation.compiled import compiled

# Sizes of the turns (rad), how many sides each is to, and the standard deviation that a turn lends to each point, as a
# part of its size: the family has no gaps.
SMALLEST, LARGEST, RATIO, SIDES = math.radians(0.15), math.radians(12.0), 1.35, 16
SPREAD = 0.2
# The same of turns about the axis and of moves along it, whose size counts at one focal length from the middle.
SPREAD_ABOUT = 0.02


@dataclass(frozen=True)
class Turns:
    """What turns (h,) do to a normalised image: shifts (h, 2), matrices (h, 2, 2), added noise (h,)."""

    shifts: Array
    linear: Array
    spread: Array

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


def prepare_turns() -> None:
    """Load the kernels, with no points."""
    turns, none = all_turns(), np.empty((0, 2))
    ratios = turn_ratios(
        none, np.empty((0, 2, 2)), none, (1.0, 1.0, 0.0, 0.0), (turns.shifts, turns.linear, turns.spread), 1.0, 1.0
    )
    frame_ratios(ratios, 0.0)
    tracks = np.empty((0, 6)), np.empty((0, 6, 6)), np.empty(0, dtype=np.bool_), 0.0
    pose, detections = Pose(np.eye(3), np.zeros(3)), (none, np.empty((0, 2, 2)))
    # the arrays of a pose are read-only: those of others would load another form of the kernel
    nearest_detections(tracks, (pose.rotation, pose.center), (1.0, 1.0, 0.0, 0.0), detections, (0, 0), 1.0)


@compiled
def nearest_detections(
    tracks: tuple[Array, Array, Booleans, float], pose: tuple[Array, Array], camera: tuple[float, float, float, float],
    detections: tuple[Array, Array], most: tuple[int, int], limit: float,
) -> tuple[Array, Array, Array, Booleans, Array]:  # fmt: skip
    """Return tracks predicted into an image, the most certain first, and what detections are about them.

    Parameters
    ----------
    tracks : tuple
        States (n, 6), covariances (n, 6, 6), which of them are wanted (n,), and the time since then, s.
    pose : tuple of arrays
        Rotation (3, 3) and centre (3,).
    camera : tuple
        fx, fy, cx, cy, px.
    detections : tuple of arrays
        Undistorted pixels (m, 2) and their covariances (m, 2, 2), px^2.
    most : tuple
        How many tracks count, and how many of those are wanted at most.
    limit : float
        Squared residual, in variances, within which a detection is a track's.

    Returns
    -------
    pixels, covariances : array (c, 2), (c, 2, 2)
        Of the wanted tracks, and of a detection about them.
    squares : array (c,)
        Squared residuals of their nearest detections, in variances.
    free : array (m,)
        Which detections belong to no other track.
    mean : array (2,)
        Sum of those residuals that are within the limit, in its standard deviations; NaN without any.
    """
    states, covariances, wanted, since_s = tracks
    rotation, center = pose
    fx, fy, cx, cy = camera
    points, noises = detections
    noise = np.zeros((2, 2))
    for j in range(len(points)):
        noise += noises[j] / len(points)
    pixels, spreads, traces = np.empty((len(states), 2)), np.empty((len(states), 2, 2)), np.empty(len(states))
    x, seen = np.empty(3), np.empty((2, 3))
    for k in range(len(states)):
        for a in range(3):
            x[a] = 0.0
            for b in range(3):
                x[a] += rotation[a, b] * (states[k, b] + since_s * states[k, b + 3] - center[b])
        pixels[k] = fx * x[0] / x[2] + cx, fy * x[1] / x[2] + cy
        for b in range(3):
            seen[0, b] = fx / x[2] * (rotation[0, b] - x[0] / x[2] * rotation[2, b])
            seen[1, b] = fy / x[2] * (rotation[1, b] - x[1] / x[2] * rotation[2, b])
        spreads[k] = 0.0
        for a in range(3):
            for b in range(3):
                moved = covariances[k, a, b] + since_s * (
                    covariances[k, a, b + 3] + covariances[k, a + 3, b] + since_s * covariances[k, a + 3, b + 3]
                )
                for r in range(2):
                    for s in range(2):
                        spreads[k, r, s] += seen[r, a] * moved * seen[s, b]
        traces[k] = spreads[k, 0, 0] + spreads[k, 1, 1]
    order = np.argsort(traces, kind="mergesort")[: most[0]]
    chosen, free = order[wanted[order]][: most[1]], np.ones(len(points), dtype=np.bool_)
    residuals, squares = np.empty((len(chosen), 2)), np.full(len(chosen), np.inf)
    total, variance, count = np.zeros(2), np.zeros((2, 2)), 0
    for k in order:
        spreads[k] += noise
        a, b, c = spreads[k, 0, 0], spreads[k, 0, 1], spreads[k, 1, 1]
        place = np.flatnonzero(chosen == k)
        for j in range(len(points)):
            u, v = points[j, 0] - pixels[k, 0], points[j, 1] - pixels[k, 1]
            square = (c * u * u - 2.0 * b * u * v + a * v * v) / (a * c - b * b)
            if not len(place):
                free[j] &= square >= limit
            elif square < squares[place[0]]:
                squares[place[0]], residuals[place[0]] = square, (u, v)
        if len(place) and squares[place[0]] < limit:
            total += residuals[place[0]]
            variance += spreads[k]
            count += 1
    mean = np.full(2, np.nan)
    if count:
        mean[0] = total[0] / math.sqrt(variance[0, 0])
        rest = variance[1, 1] - variance[0, 1] ** 2 / variance[0, 0]
        mean[1] = (total[1] - variance[0, 1] / variance[0, 0] * total[0]) / math.sqrt(rest)
    return pixels[chosen], spreads[chosen], squares, free, mean


@compiled
def turn_ratios(
    points: Array, covariances: Array, detections: Array, camera: tuple[float, float, float, float],
    turns: tuple[Array, Array, Array], missed: float, weight: float,
) -> Array:  # fmt: skip
    """Log-likelihood ratios (n, h) of a frame for each of n predicted points alone, of each turn against none.

    Each of the detections (m, 2) may be the point's; it is missed with the probability `missed`, and `weight` is the
    probability that it is detected over the density of detections in the image, px^2. Pixels are undistorted.

    Parameters
    ----------
    points, covariances : array (n, 2), (n, 2, 2)
        Predicted pixels, with the covariance of a detection about them, px^2.
    camera : tuple
        fx, fy, cx, cy, px.
    turns : tuple of arrays
        Fields of `Turns`.
    """
    fx, fy, cx, cy = camera
    shifts, linear, spread = turns
    out = np.empty((len(points), len(spread)))
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
            total = 0.0
            for j in range(len(detections)):
                u = detections[j, 0] - points[i, 0] - move_u
                v = detections[j, 1] - points[i, 1] - move_v
                if u * u > 50.0 * a or v * v > 50.0 * c:  # each alone is at most the square
                    continue
                square = (c * u * u - 2.0 * b * u * v + a * v * v) / determinant
                if square < 50.0:
                    total += math.exp(-0.5 * square)
            likelihood = missed + weight * total / (2.0 * math.pi * math.sqrt(determinant))
            if h < 0:
                still = likelihood
            else:
                out[i, h] = math.log(likelihood / still)
    return out


@compiled
def frame_ratios(ratios: Array, fewest: float) -> Array:
    """Return the log-likelihood ratio (h,) of a frame for each turn, from those of its tracks (n, h).

    No track speaks more than twice as loud as all others together. Where fewer tracks than `fewest` speak for a turn,
    only what speaks against it counts: neighbours hide together, and a turn may bring others into their places.
    """
    out = np.empty(ratios.shape[1])
    for h in range(len(out)):
        total, against, loudest, agreeing = 0.0, 0.0, -np.inf, 0
        for i in range(len(ratios)):
            ratio = ratios[i, h]
            total += ratio
            against += min(ratio, 0.0)
            loudest = max(loudest, ratio)
            agreeing += ratio > 0.0
        out[h] = min(total, 3.0 * (total - loudest)) if agreeing >= fewest else against
    return out
