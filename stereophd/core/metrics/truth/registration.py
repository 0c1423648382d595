"""The motion and the map of time that bring estimates nearest to the truth.

Calibrated cameras have the frame and the time base of their reference camera. Neither is an error of the tracks, so
both are removed before the tracks are scored (J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems",
IROS 2012, for the frame). With estimates x of time t and the truth q,

    true time = t_0 + shift + rate (t - t_0),     q(true time) ~ scale * rotation x + translation,

are found together by reweighted least squares (Cauchy weights at twice the median distance), each estimate with the
true object nearest to it at its time. The frames must agree well enough for these pairs to be right mostly; a single
object needs no such start.
"""

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.geometry.rotations import cross_matrices
from stereophd.core.metrics.truth.interpolation import Truth, align_truth

# Steps of the least squares at most, those of them with equal weights, and the change at which they end, in parts of
# the median distance.
MOST_STEPS, EQUAL_STEPS, TOLERANCE = 100, 10, 1e-9
# Estimates that are used at most (evenly chosen) and at least.
MOST_ESTIMATES, LEAST_ESTIMATES = 5000, 6
# Slowest and fastest rate of a clock relative to the truth's.
LOWEST_RATE, HIGHEST_RATE = 0.5, 2.0


@dataclass(frozen=True)
class Freedom:
    """What may be changed: the frame (and its scale) and the clock."""

    frame: bool = True
    scale: bool = False
    clock: bool = False

    @property
    def columns(self) -> Integers:
        """Places of the free values among rotation (3), translation (3), scale, shift and rate."""
        return np.flatnonzero([self.frame] * 6 + [self.scale] + [self.clock] * 2)


@dataclass(frozen=True)
class Registration:
    """A similarity of space and an affine map of time, from the tracks to the truth."""

    rotation: Array  # (3, 3) array
    translation: Array  # (3,) array: Length
    scale: float
    at_s: float  # The time t_0, s
    # `shift_s`, `rate`: What the truth's clock shows more at t_0, s; and its rate relative to the clock of the
    # estimates.
    shift_s: float
    rate: float
    estimates: int  # How many estimates had a true object at their time

    def times(self, time_s: Array) -> Array:
        """True times (n,) of times of the tracks, s."""
        return np.asarray(self.at_s + self.shift_s + self.rate * (time_s - self.at_s))

    def track_times(self, time_s: Array) -> Array:
        """Times (n,) of the tracks at true times, s."""
        return np.asarray(self.at_s + (time_s - self.at_s - self.shift_s) / self.rate)

    def positions(self, positions: Array) -> Array:
        """Positions (n, 3) in the frame of the truth."""
        return np.asarray(self.scale * positions @ self.rotation.T + self.translation)

    def velocities(self, velocities: Array) -> Array:
        """Velocities (n, 3) in the frame of the truth."""
        return np.asarray(self.scale / self.rate * velocities @ self.rotation.T)

    def covariances(self, covariances: Array) -> Array:
        """Covariances (n, 3, 3) of positions in the frame of the truth."""
        return np.asarray(self.scale**2 * self.rotation @ covariances @ self.rotation.T)


@dataclass(frozen=True)
class Residuals:
    """Distances of the estimates that `register` uses from the truth, and their derivatives."""

    rows: Integers  # (r,): Estimates that have a true object at their time
    center: Array  # (3,): Middle of the moved estimates, about which they are turned and scaled
    errors: Array  # (r, 3): True position less the moved estimate
    weights: Array  # (r,): Cauchy weights
    reach: float  # Twice the median distance
    jacobian: Array  # (r, 3, 9): Of the moved estimates less the truth, in the order of `Freedom.columns`


def register(
    time_s: Array, positions: Array, truth: Truth, max_gap_s: float, freedom: Freedom, start: Registration | None = None
) -> Registration:
    """Find the motion and the map of time that bring estimates nearest to the truth, within what `freedom` allows.

    Estimates at times (n,), s, never decreasing, have positions (n, 3); intervals of the truth longer than `max_gap_s`
    are not interpolated over. Frames and clocks nearly agree, or `start` brings them near each other. Raises ValueError
    when fewer than six estimates have a true object at their time, or the clocks cannot be reconciled.
    """
    chosen = np.unique(np.linspace(0, len(time_s) - 1, min(len(time_s), MOST_ESTIMATES)).astype(np.int64))
    time_s, positions = time_s[chosen], positions[chosen]
    middle = float(np.median(time_s)) if len(time_s) else 0.0
    registration = Registration(np.eye(3), np.zeros(3), 1.0, middle, 0.0, 1.0, 0)
    if start is not None:
        shift = float(start.times(np.array(middle))) - middle
        registration = replace(start, at_s=middle, shift_s=shift)
    columns = freedom.columns
    for number in range(MOST_STEPS):
        fit = residuals(registration, time_s, positions, truth, max_gap_s)
        if len(fit.rows) < LEAST_ESTIMATES:
            raise ValueError(
                f"expected {LEAST_ESTIMATES} or more estimates at times of the truth, found {len(fit.rows)}"
            )
        weights = np.ones(len(fit.rows)) if number < EQUAL_STEPS else fit.weights
        jacobian = fit.jacobian[:, :, columns]
        # all columns of one size, those of the rotation together: what the estimates leave open then stays as it is
        sizes = np.maximum(np.sqrt((jacobian**2).sum(axis=(0, 1))), 1e-300)
        sizes[columns < 3] = sizes[columns < 3].max(initial=1e-300)
        roots = np.sqrt(weights)
        solved = np.linalg.lstsq(
            (roots[:, None, None] * jacobian / sizes).reshape(-1, len(columns)),
            (roots[:, None] * fit.errors).ravel(),
            1e-9,
        )[0]
        step = np.zeros(9)
        step[columns] = solved / sizes
        registration = stepped(registration, step, fit.center, len(fit.rows))
        change = np.abs(jacobian @ step[columns]).max()
        if number >= EQUAL_STEPS and change <= TOLERANCE * fit.reach:
            break
    return registration


def residuals(registration: Registration, time_s: Array, positions: Array, truth: Truth, max_gap_s: float) -> Residuals:
    """Return how far estimates (n, 3) at times (n,) are from the nearest true objects."""
    rows, targets, velocities = _nearest(registration, time_s, positions, truth, max_gap_s)
    moved = registration.positions(positions[rows])
    center = moved.mean(axis=0) if len(rows) else np.zeros(3)
    errors = targets - moved
    distances = np.linalg.norm(errors, axis=1)
    reach = max(2.0 * float(np.median(distances)) if len(rows) else 0.0, 1e-12)
    jacobian = derivatives(moved - center, velocities, time_s[rows] - registration.at_s)
    return Residuals(rows, center, errors, 1.0 / (1.0 + (distances / reach) ** 2), reach, jacobian)


def _nearest(
    registration: Registration, time_s: Array, positions: Array, truth: Truth, max_gap_s: float
) -> tuple[Integers, Array, Array]:
    """Estimates (r,) that have true objects at their times, and position and velocity (r, 3) of the nearest."""
    aligned = align_truth(truth, registration.times(time_s), max_gap_s)
    starts = aligned.points.start
    counts = np.where(aligned.outside | aligned.gap, 0, np.diff(starts))
    rows = np.repeat(np.arange(len(time_s)), counts)
    places = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts) + starts[:-1][rows]
    moved = registration.positions(positions)
    distances = ((aligned.points.position[places] - moved[rows]) ** 2).sum(axis=1)
    order = np.lexsort((distances, rows))
    _, first = np.unique(rows[order], return_index=True)
    best = order[first]
    return rows[best], aligned.points.position[places[best]], np.nan_to_num(aligned.points.velocity[places[best]])


def derivatives(from_center: Array, velocities: Array, elapsed: Array) -> Array:
    """Derivatives (r, 3, 9) of moved estimates less the truth: by rotation, translation, log scale, shift, rate.

    Of moved estimates less their middle (r, 3), velocities of the truth (r, 3), and times since `at_s` (r,).
    """
    out = np.zeros((len(elapsed), 3, 9))
    out[:, :, :3] = -cross_matrices(from_center)
    out[:, :, 3:6] = np.eye(3)
    out[:, :, 6] = from_center
    out[:, :, 7] = -velocities
    out[:, :, 8] = -velocities * elapsed[:, None]
    return out


def stepped(before: Registration, step: Array, center: Array, estimates: int) -> Registration:
    """Return a registration that is turned and scaled about a centre, moved, and timed anew."""
    turn, factor = rotation_from_vector(step[:3]), float(np.exp(step[6]))
    translation = center + step[3:6] + factor * turn @ (before.translation - center)
    rate = before.rate + float(step[8])
    if not LOWEST_RATE < rate < HIGHEST_RATE:
        raise ValueError(f"expected clocks of nearly one rate, before a ratio of {rate:.3g}")
    return Registration(
        turn @ before.rotation, translation, factor * before.scale, before.at_s, before.shift_s + float(step[7]), rate,
        estimates
    )  # fmt: skip
