"""Trajectories of many objects, each a chain of knots: white acceleration between knots, cubic between.

A knot is a position and a velocity. Between two knots (spacing D, fraction s of the way) the position is the cubic

    p = (1 - 3 s^2 + 2 s^3) p_0 + D (s - 2 s^2 + s^3) v_0 + (3 s^2 - 2 s^3) p_1 + D (s^3 - s^2) v_1,

which is the mean of white acceleration given both knots (T. D. Barfoot, C. H. Tong and S. Sarkka, "Batch continuous-
time trajectory estimation as exactly sparse Gaussian process regression", RSS 2014); its variance there is at most
q^2 D^3 / 192 per axis. Knots are set so far apart that this stays well below the noise of a detection. Without
acceleration a trajectory is one knot and a straight line; of a static object the velocity is held at zero.

The knots of successive objects follow one another in one array, so all trajectories are one banded system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from stereophd.core.motion.models import Motion, Static

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Standard deviation of the deviation from the cubic half-way between knots, in parts of the detection noise.
CUBIC_DEVIATION = 0.3
# Accelerations below this part of the largest axis count as this: no axis is exactly straight while others turn.
LEAST_AXIS = 1e-3
# Weight of a unit velocity of a static object, against positions in pixels: it stays zero.
STATIC_WEIGHT = 1e6


@dataclass(frozen=True)
class Knots:
    """Where the knots of all trajectories are.

    Attributes
    ----------
    times : array (n,)
        Times of the knots, s, increasing within a trajectory.
    first : array (k + 1,) of int
        Trajectory j has the knots first[j] to first[j + 1] - 1.
    spans : array (k, 2)
        First and last time of each trajectory, s.
    acceleration_std : array (3,)
        Of the white acceleration, length/s^2, as in `stereophd.core.motion.models.ConstantVelocity`.
    static : bool
        Whether objects stand still.
    """

    times: Array
    first: Integers
    spans: Array
    acceleration_std: Array
    static: bool

    @property
    def count(self) -> int:
        """Number of trajectories."""
        return len(self.first) - 1

    @property
    def size(self) -> int:
        """Number of unknowns, six a knot: position, velocity."""
        return 6 * len(self.times)

    def links(self) -> Integers:
        """Knots that are followed by another of the same trajectory."""
        inner = np.ones(len(self.times), dtype=bool)
        inner[self.first[1:] - 1] = False
        return np.flatnonzero(inner)


def place_knots(spans: Sequence[tuple[float, float]], spacing: float, motion: Motion) -> Knots:
    """Place knots over spans of time, no further apart than `spacing`; one knot for a straight line."""
    static = isinstance(motion, Static)
    std = np.asarray(motion.acceleration_std, dtype=np.float64)
    straight = static or not std.any()
    pieces = []
    for start, end in spans:
        parts = 0 if straight or end <= start else max(int(np.ceil((end - start) / spacing)), 1)
        pieces.append(np.linspace(start, end, parts + 1) if parts else np.array([start]))
    first = np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])]).astype(np.int64)
    times = np.concatenate([*pieces, np.empty(0)])
    return Knots(
        times,
        first,
        np.asarray(spans, dtype=np.float64).reshape(-1, 2),
        np.maximum(std, LEAST_AXIS * std.max()),
        static,
    )


def knot_spacing(acceleration_std: Array, noise: float) -> float:
    """Spacing (s) at which the cubic deviates by `CUBIC_DEVIATION` of a noise given in length."""
    largest = float(np.max(acceleration_std))
    if largest == 0.0:
        return np.inf
    return float((192.0 * (CUBIC_DEVIATION * noise / largest) ** 2) ** (1.0 / 3.0))


def interpolation(knots: Knots, trajectories: Integers, times: Array) -> tuple[Integers, Array]:
    """Weights of the knots in the positions at given times.

    Parameters
    ----------
    knots : Knots
    trajectories : array (n,) of int
    times : array (n,)
        Outside its knots a trajectory goes on straight.

    Returns
    -------
    knot : array (n,) of int
        The knot before each time.
    weights : array (n, 4)
        Of its position and velocity, and of those of the next knot.
    """
    knot = np.empty(len(times), dtype=np.int64)
    weights = np.zeros((len(times), 4))
    for j in np.unique(trajectories):
        low, high = int(knots.first[j]), int(knots.first[j + 1])
        rows = np.flatnonzero(trajectories == j)
        at = knots.times[low:high]
        t = times[rows]
        if high - low == 1:
            knot[rows] = low
            weights[rows, 0] = 1.0
            weights[rows, 1] = 0.0 if knots.static else t - at[0]
            continue
        left = np.clip(np.searchsorted(at, t, side="right") - 1, 0, high - low - 2)
        knot[rows] = low + left
        step = at[left + 1] - at[left]
        s = (t - at[left]) / step
        weights[rows, 0] = 1.0 - 3.0 * s**2 + 2.0 * s**3
        weights[rows, 1] = step * (s - 2.0 * s**2 + s**3)
        weights[rows, 2] = 3.0 * s**2 - 2.0 * s**3
        weights[rows, 3] = step * (s**3 - s**2)
        before, after = s < 0.0, s > 1.0
        weights[rows[before]] = np.column_stack(
            [np.ones(before.sum()), (s * step)[before], np.zeros((before.sum(), 2))]
        )
        beyond = ((s - 1.0) * step)[after]
        weights[rows[after]] = np.column_stack([np.zeros((len(beyond), 2)), np.ones(len(beyond)), beyond])
    return knot, weights


def slopes(knots: Knots, trajectories: Integers, times: Array) -> Array:
    """Weights (n, 4) of the knots of `interpolation` in the velocities at given times."""
    weights = np.zeros((len(times), 4))
    for j in np.unique(trajectories):
        low, high = int(knots.first[j]), int(knots.first[j + 1])
        rows = np.flatnonzero(trajectories == j)
        at = knots.times[low:high]
        if high - low == 1:
            weights[rows, 1] = 0.0 if knots.static else 1.0
            continue
        left = np.clip(np.searchsorted(at, times[rows], side="right") - 1, 0, high - low - 2)
        step = at[left + 1] - at[left]
        s = np.clip((times[rows] - at[left]) / step, 0.0, 1.0)
        bend = 6.0 * (s - s**2) / step
        weights[rows] = np.column_stack([-bend, 1.0 - 4.0 * s + 3.0 * s**2, bend, 3.0 * s**2 - 2.0 * s])
    return weights


def positions(states: Array, knot: Integers, weights: Array) -> Array:
    """Positions (n, 3) from the states of all knots (k, 2, 3) and the weights of `interpolation`."""
    following = np.minimum(knot + 1, len(states) - 1)
    return np.asarray(
        weights[:, 0, None] * states[knot, 0]
        + weights[:, 1, None] * states[knot, 1]
        + weights[:, 2, None] * states[following, 0]
        + weights[:, 3, None] * states[following, 1]
    )


def link_precisions(knots: Knots) -> tuple[Integers, Array]:
    """Inverse covariances of white acceleration between successive knots.

    Returns
    -------
    links : array (l,) of int
        The knot before each link.
    precisions : array (l, 4, 4)
        For unit acceleration_std, A^T Q^-1 A with A = [[-1, -D, 1, 0], [0, -1, 0, 1]] over the positions and
        velocities of both knots, and Q the discretised covariance of `stereophd.core.motion.models`.
    """
    links = knots.links()
    step = knots.times[links + 1] - knots.times[links] if len(links) else np.empty(0)
    difference = np.zeros((len(links), 2, 4))
    difference[:, 0, 0], difference[:, 0, 1], difference[:, 0, 2] = -1.0, -step, 1.0
    difference[:, 1, 1], difference[:, 1, 3] = -1.0, 1.0
    inverse = np.empty((len(links), 2, 2))
    inverse[:, 0, 0] = 12.0 / step**3
    inverse[:, 0, 1] = inverse[:, 1, 0] = -6.0 / step**2
    inverse[:, 1, 1] = 4.0 / step
    return links, np.swapaxes(difference, 1, 2) @ inverse @ difference


def motion_bands(knots: Knots) -> Array:
    """Precision of the motion model over all unknowns, lower banded (12, size): the prior of no position."""
    bands = np.zeros((12, knots.size))
    links, precisions = link_precisions(knots)
    for axis in range(3):
        density = knots.acceleration_std[axis] ** 2
        for row in range(4):
            for column in range(row + 1):
                below = 3 * (row - column)
                np.add.at(bands[below], 6 * links + 3 * column + axis, precisions[:, row, column] / density)
        if knots.static:
            bands[0, 3 + axis :: 6] += STATIC_WEIGHT
    return bands


def banded_product(bands: Array, vector: Array) -> Array:
    """Product of a symmetric matrix in lower banded form with a vector (size,)."""
    out = bands[0] * vector
    for k in range(1, min(len(bands), len(vector))):
        out[k:] += bands[k, : len(vector) - k] * vector[: len(vector) - k]
        out[: len(vector) - k] += bands[k, : len(vector) - k] * vector[k:]
    return np.asarray(out)


def fit_states(knots: Knots, knot: Integers, weights: Array, points: Array, precision: Array) -> Array:
    """Fit the knots (k, 2, 3) to positions (n, 3) of scalar precision (n,), with the motion model between."""
    bands = motion_bands(knots)
    size = knots.size
    right = np.zeros(size)
    for axis in range(3):
        for row in range(4):
            place = 6 * knot + 3 * row + axis
            used = place < size
            np.add.at(right, place[used], (precision * weights[:, row] * points[:, axis])[used])
            for column in range(row + 1):
                value = precision * weights[:, row] * weights[:, column]
                np.add.at(bands[3 * (row - column)], (6 * knot + 3 * column + axis)[used], value[used])
    # a trace of weight on every unknown: a track of a single estimate has no velocity
    bands[0] += 1e-9 * max(float(bands[0].max()), 1e-300)
    return np.asarray(solveh_banded(bands, right, lower=True)).reshape(-1, 2, 3)
