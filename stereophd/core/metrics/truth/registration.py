"""The motion and the map of time that bring estimates nearest to the truth, and how well they are known.

Calibrated cameras have the frame and the time base of their reference camera. Neither is an error of the tracks, so
both are removed before the tracks are scored (J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems",
IROS 2012, for the frame), or cameras and tracks are brought into a world. With estimates x of time t and the truth q,

    true time = t_0 + shift + rate (t - t_0),     q(true time) ~ scale * rotation x + translation,

are found together by reweighted least squares, each estimate with the true object nearest to it at its time. An
estimate weighs by its covariance, and by how far it is off in standard deviations (weights of S. Geman, D. E. McClure,
"Statistical methods for tomographic image reconstruction", 1987), so that places that one camera alone saw hardly
count. Clocks run at nearly one rate, which is known beforehand to `RATE_STD`: else an error of the scale, or of any
other kind, passes for one of the clock. The frames must agree well enough for the pairs to be right mostly; a single
object needs no such start.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.geometry.rotations import cross_matrices
from stereophd.core.metrics.errors import independent_means
from stereophd.core.metrics.truth.interpolation import Truth, align_truth
from stereophd.core.numerics.rows import ArrayRows

# Steps of the least squares at most, and the change at which they end, in parts of the median distance.
MOST_STEPS, TOLERANCE = 100, 1e-6
# Estimates that are used at most (evenly chosen) and at least.
MOST_ESTIMATES, LEAST_ESTIMATES = 5000, 6
# Standard deviation of the rate of a clock relative to another; slowest and fastest rate.
RATE_STD, LOWEST_RATE, HIGHEST_RATE = 1e-3, 0.5, 2.0
# Least variance along an axis, in parts of the median variance: covariances may be singular.
LEAST_VARIANCE = 1e-6
# Median and lower quartile of the distances of normal errors of unit variance along three axes.
MEDIAN_DISTANCE, QUARTILE_DISTANCE = 1.538, 1.101


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
class TrackedPlaces(ArrayRows):
    """Estimates of places of objects, in order of time."""

    time_s: Array  # (n,): s, never decreasing
    position: Array  # (n, 3)
    covariance: Array  # (n, 3, 3): Of the positions
    track_id: Integers  # (n,): Of which track each is

    @property
    def safe_covariance(self) -> Array:
        """Covariances (n, 3, 3) that are positive definite; unit ones where none is stated."""
        middle = float(np.median(np.trace(self.covariance, axis1=1, axis2=2))) / 3.0 if len(self.time_s) else 0.0
        return np.asarray(self.covariance + (LEAST_VARIANCE * middle if middle > 0.0 else 1.0) * np.eye(3))


@dataclass(frozen=True)
class Alignment:
    """How tracks lie in a world: the similarity and the map of time, and how well they are known."""

    registration: Registration
    center: Array = field(default_factory=lambda: np.zeros(3))  # In the world, about which the covariance turns
    # (9, 9): Of rotation (rad, about the world's axes), translation, log scale, shift (s) and rate.
    covariance: Array = field(default_factory=lambda: np.zeros((9, 9)))
    members: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # Tracks that were used
    distances: Array = field(default_factory=lambda: np.zeros(0))  # (r,): That are left, length
    misfit: float = 1.0  # How many times what the estimates state they are (median)

    @property
    def std(self) -> Array:
        """Standard deviations (9,) in the order of the covariance."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Residuals:
    """Distances of the estimates that `register` uses from the truth, and their derivatives."""

    rows: Integers  # (r,): Estimates that have a true object at their time
    center: Array  # (3,): Middle of the moved estimates, about which they are turned and scaled
    errors: Array  # (r, 3): True position less the moved estimate
    jacobian: Array  # (r, 3, 9): Of the moved estimates less the truth, in the order of `Freedom.columns`
    roots: Array  # (r, 3, 3): With which errors become those of unit covariance
    precisions: Array  # (r,): Inverse mean variances, in the unit of the estimates

    @property
    def distances(self) -> Array:
        """Distances (r,), length."""
        return np.asarray(np.linalg.norm(self.errors, axis=1))

    @property
    def whitened(self) -> Array:
        """Errors (r, 3) in standard deviations."""
        return np.asarray((self.roots @ self.errors[:, :, None])[:, :, 0])

    @property
    def deviations(self) -> Array:
        """Distances (r,) in standard deviations."""
        return np.asarray(np.linalg.norm(self.whitened, axis=1))

    @property
    def reach(self) -> float:
        """Four median distances in standard deviations, by the lower quartile: most estimates may be far off."""
        return max(4.0 * MEDIAN_DISTANCE / QUARTILE_DISTANCE * float(np.quantile(self.deviations, 0.25)), 1e-12)

    @property
    def weights(self) -> Array:
        """Robust weights (r,)."""
        return np.asarray((1.0 + (self.deviations / self.reach) ** 2) ** -2)

    @property
    def misfit(self) -> float:
        """How many times what the estimates state the distances are (median)."""
        return float(np.median(self.deviations)) / MEDIAN_DISTANCE

    @property
    def distance(self) -> float:
        """Median distance, weighted by what is known of the places, length."""
        order = np.argsort(self.distances)
        known = np.cumsum(self.precisions[order])
        return float(self.distances[order][np.searchsorted(known, 0.5 * known[-1])])

    def variance(self, track_ids: Integers) -> float:
        """Variance, in parts of what is stated, of errors as alike as these when they are taken for independent."""
        errors = np.sqrt(self.weights)[:, None] * self.whitened
        return len(errors) / independent_means(errors, track_ids) * (0.25 * self.reach / MEDIAN_DISTANCE) ** 2


def register(
    estimates: TrackedPlaces, truth: Truth, max_gap_s: float, freedom: Freedom, start: Registration | None = None
) -> Alignment:
    """Find the motion and the map of time that bring estimates nearest to the truth, within what `freedom` allows.

    Intervals of the truth longer than `max_gap_s` are not interpolated over. Frames and clocks nearly agree, or `start`
    brings them near each other. The covariance follows from what is left over, and counts successive errors as alike as
    they are. Raises ValueError when fewer than six estimates have a true object at their time, or the clocks cannot be
    reconciled.
    """
    count = len(estimates.time_s)
    used = estimates.take(np.unique(np.linspace(0, count - 1, min(count, MOST_ESTIMATES)).astype(np.int64)))
    middle = float(np.median(used.time_s)) if count else 0.0
    registration = Registration(np.eye(3), np.zeros(3), 1.0, middle, 0.0, 1.0, 0)
    if start is not None:
        shift = float(start.times(np.array(middle))) - middle
        registration = replace(start, at_s=middle, shift_s=shift)
    columns = freedom.columns
    for _ in range(MOST_STEPS):
        fit = residuals(registration, used, truth, max_gap_s)
        if len(fit.rows) < LEAST_ESTIMATES:
            raise ValueError(
                f"expected {LEAST_ESTIMATES} or more estimates at times of the truth, found {len(fit.rows)}"
            )
        ids = used.track_id[fit.rows]
        roots = np.sqrt(fit.weights / fit.variance(ids))[:, None]
        jacobian = roots[:, :, None] * (fit.roots @ fit.jacobian)[:, :, columns]
        prior = (columns == 8) / RATE_STD**2
        matrix = np.einsum("nai,naj->ij", jacobian, jacobian) + np.diag(prior)
        # all columns of one size, those of the rotation together: what the estimates leave open then stays as it is
        sizes = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        sizes[columns < 3] = sizes[columns < 3].max(initial=1e-300)
        inverse = np.linalg.pinv(matrix / np.outer(sizes, sizes), rcond=1e-13, hermitian=True) / np.outer(sizes, sizes)
        vector = np.einsum("nai,na->i", jacobian, roots * fit.whitened) + prior * (1.0 - registration.rate)
        step, covariance = np.zeros(9), np.zeros((9, 9))
        step[columns], covariance[np.ix_(columns, columns)] = inverse @ vector, inverse
        registration = stepped(registration, step, fit.center, len(fit.rows))
        if np.abs(fit.jacobian @ step).max() <= TOLERANCE * fit.distance:
            break
    return Alignment(registration, fit.center, covariance, np.unique(ids), fit.distances, fit.misfit)


def residuals(registration: Registration, estimates: TrackedPlaces, truth: Truth, max_gap_s: float) -> Residuals:
    """Return how far estimates are from the nearest true objects."""
    rows, targets, velocities = _nearest(registration, estimates, truth, max_gap_s)
    used = estimates.take(rows)
    moved = registration.positions(used.position)
    center = moved.mean(axis=0) if len(rows) else np.zeros(3)
    jacobian = derivatives(moved - center, velocities, used.time_s - registration.at_s)
    covariances = estimates.safe_covariance[rows]
    roots = np.linalg.inv(np.linalg.cholesky(covariances)) @ (registration.rotation.T / registration.scale)
    precisions = 3.0 / np.trace(covariances, axis1=1, axis2=2)
    return Residuals(rows, center, targets - moved, jacobian, roots, precisions)


def _nearest(
    registration: Registration, estimates: TrackedPlaces, truth: Truth, max_gap_s: float
) -> tuple[Integers, Array, Array]:
    """Estimates (r,) that have true objects at their times, and position and velocity (r, 3) of the nearest."""
    aligned = align_truth(truth, registration.times(estimates.time_s), max_gap_s)
    starts = aligned.points.start
    counts = np.where(aligned.outside | aligned.gap, 0, np.diff(starts))
    rows = np.repeat(np.arange(len(counts)), counts)
    places = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts) + starts[:-1][rows]
    moved = registration.positions(estimates.position)
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
    scale = factor * before.scale
    if not np.finfo(np.float64).tiny < scale < np.inf:
        raise ValueError(f"expected estimates that a scale brings to the truth, before a scale of {scale:.3g}")
    return Registration(
        turn @ before.rotation, translation, scale, before.at_s, before.shift_s + float(step[7]), rate, estimates
    )
