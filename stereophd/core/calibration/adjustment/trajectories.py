"""Trajectories of many objects, each a chain of knots, the motion model between them.

A knot is a position and a velocity. Between two knots the position is the mean of the motion model given both
(`Motion.between`; of white acceleration a cubic), an affine function of the two (T. D. Barfoot, C. H. Tong and
S. Sarkka, "Batch continuous-time trajectory estimation as exactly sparse Gaussian process regression", RSS 2014).
Knots are at times of detections, all that a Markov process needs. Detections between two knots are so near to them
(`Motion.knot_spacing`) that the motion strays from the mean by well less than the noise of a detection. Between
detections it may stray further (`straying`). Without noise of the motion a trajectory is one knot; of a static object
the velocity is held at zero.

The knots of successive objects follow one another in one array, so all trajectories are one banded system.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import solveh_banded

from stereophd.core.arrays import Array, Integers
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.compilation.compiled import compiled

# Standard deviation of the deviation from the mean half-way between knots, in parts of the detection noise.
DEVIATION = 0.3
# Accelerations below this part of the largest axis count as this: no axis is exactly straight while others turn.
LEAST_AXIS = 1e-3
# Detections sooner after a knot than this part of the spacing need no knot, however long none follows.
SOON = 0.1
# Weight of a unit velocity of a static object, against positions in pixels: it stays zero.
STATIC_WEIGHT = 1e6
# Axes of `MotionNoise` that are regressed, and those that they are regressed on; how unlike axes are, orthogonal.
REGRESSED = (np.array([1, 2, 2]), np.array([0, 0, 1]))
UNLIKE = np.array([[-1.0, -1.0], [1.0, -1.0], [0.0, 2.0]]) / np.sqrt([2.0, 6.0])
# Its unknowns where the noise is as stated.
STATED = np.zeros(6)
# The unknown of all axes together, which the logarithm of a scale adds to.
OF_ALL = np.eye(6)[0]
# In place of a spacing of 0, of objects that cameras at one place put into themselves.
SMALLEST = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Knots:
    """Where the knots of all trajectories are."""

    times: Array  # (n,): Times of the knots, s, increasing within a trajectory
    first: Integers  # Trajectory j has the knots first[j] to first[j + 1] - 1
    spans: Array  # (k, 2): First and last time of each trajectory, s
    # (3,): Standard deviations of the noise of the motion, length/s^2, none of them exactly zero while others are
    # not.
    noise_std: Array
    motion: Motion

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


def place_knots(detected: Sequence[Array], spacing: float, motion: Motion) -> Knots:
    """Place knots at some of the times (n,) of the detections of each trajectory; one for motion without noise.

    A knot is followed by one at the last detection within `spacing`, or else at the next one beyond. Detections that
    follow a knot by less than the part `SOON` of the spacing have none of their own.
    """
    spans = np.array([(times.min(), times.max()) for times in detected], dtype=np.float64).reshape(-1, 2)
    pieces = []
    for times, (start, end) in zip(detected, spans, strict=True):
        # the variance of positions grows with the third power
        is_one = not motion.noisy or (end - start) ** 3 <= SMALLEST
        pieces.append(np.array([start]) if is_one else _some_of(np.unique(times), max(spacing, SMALLEST)))
    first = np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])]).astype(np.int64)
    return Knots(np.concatenate([*pieces, np.empty(0)]), first, spans, least_noise(motion), motion)


@compiled
def _some_of(times: Array, spacing: float) -> Array:
    """Return those of increasing times that `place_knots` takes."""
    chosen, count, following = np.empty_like(times), 0, 0
    while following < len(times):
        begin, late = times[following], following + 1
        chosen[count] = begin
        count += 1
        while late < len(times) and times[late] <= begin + spacing:
            late += 1
        following = late - 1 if times[late - 1] > begin + SOON * spacing else late
    return chosen[:count]


def least_noise(motion: Motion) -> Array:
    """Return the standard deviations (3,) of the noise of a motion, none exactly zero while others are not."""
    std = motion.noise_std
    return np.asarray(np.maximum(std, LEAST_AXIS * std.max()))


def knot_spacing(motion: Motion, noise: float) -> float:
    """Spacing (s) at which the motion strays by `DEVIATION` of a noise given in length."""
    return motion.knot_spacing(DEVIATION * noise)


class Interpolation(NamedTuple):
    """Positions or velocities as functions of the knots."""

    knot: Integers  # (n,) of int: The knot before each time
    weights: Array  # (n, 4): Weights of its position and velocity, and of those of the next knot
    offsets: Array  # (n, 3): What the drift of the motion adds


def interpolation(knots: Knots, trajectories: Integers, times: Array) -> Interpolation:
    """Interpolation of positions of trajectories (n,) at times (n,); outside its knots one continues without noise."""
    return _interpolated(knots, trajectories, times, velocities=False)


@compiled
def _knots_before(of_knots: Array, first: Integers, trajectories: Integers, times: Array, knot: Integers) -> None:
    """Find the knot before each time of a trajectory that has one after it; the first one of any time before it."""
    for n in range(times.shape[0]):
        low, high = first[trajectories[n]], first[trajectories[n] + 1]
        found = np.searchsorted(of_knots[low:high], times[n], side="right") - 1
        knot[n] = low + min(max(found, 0), max(high - low - 2, 0))


def _interpolated(knots: Knots, trajectories: Integers, times: Array, velocities: bool) -> Interpolation:
    motion, part = knots.motion, slice(3, 6) if velocities else slice(0, 3)
    between = motion.velocity_between if velocities else motion.between
    knot, single = np.empty(len(times), dtype=np.int64), (np.diff(knots.first) == 1)[trajectories]
    _knots_before(knots.times, knots.first, trajectories, times, knot)
    elapsed, following = times - knots.times[knot], np.minimum(knot + 1, len(knots.times) - 1)
    step = np.where(single, 1.0, knots.times[following] - knots.times[knot])
    weights, offsets = np.empty((len(times), 4)), np.empty((len(times), 3))
    if not single.all():  # without noise nothing is between
        weights, offsets = between(np.clip(elapsed, 0.0, step), step)

    def alone(rows: Integers, first: int, since: Array) -> None:
        """From one knot on, whose position is the weight `first`."""
        flow = motion.flow(since[rows])
        weights[rows] = 0.0
        weights[rows, first] = 0.0 if velocities else 1.0
        weights[rows, first + 1] = flow.keep * motion.moves if velocities else flow.reach
        offsets[rows] = flow.drift[:, part]

    before = single | (elapsed < 0.0)
    alone(np.flatnonzero(before), 0, elapsed)
    alone(np.flatnonzero(~before & (elapsed > step)), 2, elapsed - step)
    return Interpolation(knot, weights, offsets)


def straying(knots: Knots, trajectories: Integers, times: Array) -> Array:
    """Variances (n,) of positions about their interpolation, for unit noise of the motion."""
    knot = np.empty(len(times), dtype=np.int64)
    _knots_before(knots.times, knots.first, trajectories, times, knot)
    last = knots.first[trajectories + 1] - 1
    since, until = times - knots.times[knot], knots.times[np.minimum(knot + 1, last)] - times
    is_inside = (since > 0.0) & (until > 0.0)
    beyond = np.where(is_inside, 0.0, np.maximum(np.maximum(-since, -until), 0.0))
    out = np.asarray(knots.motion.noise(beyond).position, dtype=np.float64)
    out[is_inside] = knots.motion.straying(since[is_inside], (since + until)[is_inside])
    return out


def slopes(knots: Knots, trajectories: Integers, times: Array) -> Interpolation:
    """Return the interpolation of the velocities at given times."""
    return _interpolated(knots, trajectories, times, velocities=True)


def positions(states: Array, knot: Integers, weights: Array, offsets: Array) -> Array:
    """Positions or velocities (n, 3) from the states of all knots (k, 2, 3) and the fields of an `Interpolation`."""
    out = offsets.copy()
    _add_states(np.ascontiguousarray(states), knot, weights, out)
    return out


@compiled
def _add_states(states: Array, knot: Integers, weights: Array, out: Array) -> None:
    """Add position and velocity of knots and of those after them, with weights (n, 4), to points (n, 3)."""
    for n in range(knot.shape[0]):
        first, second = knot[n], min(knot[n] + 1, states.shape[0] - 1)
        for axis in range(3):
            out[n, axis] += (
                weights[n, 0] * states[first, 0, axis]
                + weights[n, 1] * states[first, 1, axis]
                + weights[n, 2] * states[second, 0, axis]
                + weights[n, 3] * states[second, 1, axis]
            )


class Links(NamedTuple):
    """The motion between successive knots.

    What it changes, A x - drift with A = [[-1, -reach, 1, 0], [0, -keep, 0, 1]] over the positions and velocities of
    both knots, has for unit noise the covariance Q of `Motion.noise` on each axis.
    """

    knot: Integers  # (l,) of int: The knot before each link
    precisions: Array  # (l, 4, 4): A^T Q^-1 A
    pull: Array  # (l, 4, 3): A^T Q^-1 drift
    energy: Array  # (l, 3, 3): drift^T Q^-1 drift


def motion_links(knots: Knots) -> Links:
    """Return the motion between successive knots."""
    knot = knots.links()
    step = knots.times[knot + 1] - knots.times[knot] if len(knot) else np.empty(0)
    flow, inverse = knots.motion.flow(step), knots.motion.precision(step)
    difference = np.zeros((len(knot), 2, 4))
    difference[:, 0, 0], difference[:, 0, 1], difference[:, 0, 2] = -1.0, -flow.reach, 1.0
    difference[:, 1, 1], difference[:, 1, 3] = -flow.keep, 1.0
    drift = flow.drift.reshape(-1, 2, 3)
    pull = inverse @ drift
    energy = np.swapaxes(drift, 1, 2) @ pull
    across = np.swapaxes(difference, 1, 2)
    return Links(knot, across @ inverse @ difference, across @ pull, energy)


@dataclass(frozen=True)
class MotionPrior:
    """The links of all trajectories, for unit noise, which is the same on every axis.

    With X (2 k, 3) the positions and velocities of all knots, `bands` (4, 2 k) holds K, lower banded. Minus twice the
    logarithm of the density is tr(D (X^T K X - pull^T X - X^T pull + energy)), D (3, 3) the precision of the noise.
    """

    bands: Array
    pull: Array  # (2 k, 3)
    energy: Array  # (3, 3)
    moves: bool  # Whether objects have a velocity; if not, it is held at zero.
    links: Links

    @classmethod
    def of(cls, knots: Knots) -> Self:
        """Return the motion model between all knots."""
        size = 2 * len(knots.times)
        bands, pull, links = np.zeros((4, size)), np.zeros((size, 3)), motion_links(knots)
        for row in range(4):
            np.add.at(pull, 2 * links.knot + row, links.pull[:, row])
            for column in range(row + 1):
                np.add.at(bands[row - column], 2 * links.knot + column, links.precisions[:, row, column])
        return cls(bands, pull, links.energy.sum(axis=0), knots.motion.moves, links)

    def with_axes(self, precision: Array, out: Array | None = None) -> Array:
        """Return or add to `out` the matrix (12, 6 k) of all unknowns at a precision (3, 3) of the noise."""
        out = np.zeros((12, 3 * self.bands.shape[1])) if out is None else out
        for (below, unit), i, j in product(enumerate(self.bands), range(3), range(3)):
            if 3 * below + i >= j and precision[i, j] != 0.0:  # axes that are independent have no products
                out[3 * below + i - j, j::3] += precision[i, j] * unit
        if not self.moves:
            out[0].reshape(-1, 2, 3)[:, 1] += STATIC_WEIGHT
        return out

    def pulls(self, states: Array) -> tuple[Array, Array]:
        """Return K X - pull (2 k, 3) at knots (k, 2, 3), and what D multiplies in the density (3, 3)."""
        points = states.reshape(-1, 3)
        moved = np.stack([banded_product(self.bands, column) for column in points.T], axis=1)
        pulls = moved - self.pull
        return pulls, points.T @ pulls - self.pull.T @ points + self.energy


@dataclass(frozen=True)
class MotionNoise:
    """Noise of the motion, which need not be alike along all axes nor independent on them.

    Differences d (3,) between knots over their standard deviations by the configuration are whitened as
    r = diag(e^-u) (1 + T) d, with T below the diagonal: the noise of an axis, and its regression on those before it
    (M. Pourahmadi, Biometrika 86, 1999). The unknowns are the mean of u, its two deviations `UNLIKE`, and T_yx, T_zx
    and T_zy.
    """

    whitening: Array  # (3, 3): Of differences in lengths
    slopes: Array  # (6, 3, 3): Its derivatives by the unknowns
    stated: Array  # (3,): Standard deviations beside which the unknowns are; 0 without noise

    @classmethod
    def of(cls, unknowns: Array, noise_std: Array) -> Self:
        """Return the noise of unknowns (6,) beside stated standard deviations (3,)."""
        mixed, unit = np.eye(3), np.zeros((3, 3, 3))
        mixed[REGRESSED] = unknowns[3:]
        unit[np.arange(3), *REGRESSED] = 1.0
        along = np.column_stack([np.ones(3), UNLIKE])
        scales = np.exp(-along @ unknowns[:3])[:, None]
        inverse = 1.0 / np.where(noise_std > 0.0, noise_std, 1.0)  # without noise there are no differences
        slopes = np.concatenate([-along.T[:, :, None] * mixed, unit])
        return cls(scales * mixed * inverse, scales * slopes * inverse, noise_std)

    @property
    def precision(self) -> Array:
        """Precision (3, 3) of differences, in lengths."""
        return np.asarray(self.whitening.T @ self.whitening)

    @property
    def std(self) -> Array:
        """Standard deviations (3,) along the axes, length/s^2."""
        return np.where(self.stated > 0.0, np.sqrt(np.diag(np.linalg.inv(self.precision))), 0.0)

    def by_unknowns(self, products: Array) -> Array:
        """Derivatives (..., 6) of half of tr(precision products), (..., 3, 3), by the unknowns."""
        return np.asarray(np.einsum("jab,...bc,ac->...j", self.slopes, products, self.whitening))


def banded_product(bands: Array, vector: Array) -> Array:
    """Product of a symmetric matrix in lower banded form with a vector (size,)."""
    out = bands[0] * vector
    for k in range(1, min(len(bands), len(vector))):
        out[k:] += bands[k, : len(vector) - k] * vector[: len(vector) - k]
        out[: len(vector) - k] += bands[k, : len(vector) - k] * vector[k:]
    return np.asarray(out)


def fit_states(knots: Knots, knot: Integers, weights: Array, offsets: Array, points: Array, precision: Array) -> Array:
    """Fit the knots (k, 2, 3) to positions (n, 3) of scalar precision (n,), with the motion model between."""
    prior, size = MotionPrior.of(knots), knots.size
    precision_of_motion = MotionNoise.of(STATED, knots.noise_std).precision
    bands, right = prior.with_axes(precision_of_motion), (prior.pull @ precision_of_motion).ravel()
    points = points - offsets
    for axis in range(3):
        for row in range(4):
            place = 6 * knot + 3 * row + axis
            used = place < size
            np.add.at(right, place[used], (precision * weights[:, row] * points[:, axis])[used])
            for column in range(row + 1):
                value = precision * weights[:, row] * weights[:, column]
                np.add.at(bands[3 * (row - column)], (6 * knot + 3 * column + axis)[used], value[used])
    # a trace of weight on every unknown: a track of a single estimate has no velocity
    bands[0] += 1e-9 * max(float(bands[0].max(initial=0.0)), 1e-300)
    return np.asarray(solveh_banded(bands, right, lower=True)).reshape(-1, 2, 3)
