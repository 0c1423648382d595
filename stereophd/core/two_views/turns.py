"""Likelihoods of a frame if its camera were turned: by one of a family of turns, against none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from stereophd.core.arrays import Array
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
    """Load the kernel of `turn_ratios`, with no points."""
    turns, none = all_turns(), np.empty((0, 2))
    turn_ratios(
        none, np.empty((0, 2, 2)), none, (1.0, 1.0, 0.0, 0.0), (turns.shifts, turns.linear, turns.spread), 1.0, 1.0
    )


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
                square = (c * u * u - 2.0 * b * u * v + a * v * v) / determinant
                if square < 50.0:
                    total += math.exp(-0.5 * square)
            likelihood = missed + weight * total / (2.0 * math.pi * math.sqrt(determinant))
            if h < 0:
                still = likelihood
            else:
                out[i, h] = math.log(likelihood / still)
    return out
