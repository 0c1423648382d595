"""Two cameras refined from a hypothesis: Gauss-Newton over pose, clock, focal lengths and lenses, pairing anew.

The unknowns of two cameras are the rotation, the direction of the translation, the offset and rate of the second clock,
and, under their priors, both focal lengths and first radial coefficients. At tolerances that fall, tracks are paired as
hypotheses are scored (`calibration.discovery.pair_search`), and the distances of the paired tracks minimised with a
Cauchy loss. The tolerance at which the tracks gain most is kept. Sampson's distance does not tell the four poses of an
essential matrix apart; the one with most points in front of both cameras is taken at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.discovery.essential import essential_of, poses_of
from stereophd.core.calibration.discovery.pair_search import Hypothesis, common_pieces, log_gains, total_gain
from stereophd.core.calibration.discovery.tracks import SlopeTracks
from stereophd.core.geometry.pose import rotation_from_vector, rotation_to_vector
from stereophd.core.geometry.rotations import cross_matrices
from stereophd.core.numerics.rows import ArrayRows
from stereophd.core.two_views.epipolar import SampsonDistances, nearest_depths, sampson_distances

# Gauss-Newton steps at a tolerance, at most, and squared length of a step, in deviations, after which there is none.
STEPS, CONVERGED = 10, 1e-3
# Choices of pairs at a tolerance, at most: an optimum is one only if it pairs the tracks whose distances are least.
CHOICES = 5
# Samples of all tracks of a camera together and of one track at least, and least of them that make a pair.
ALL_SAMPLES, SAMPLES, LEAST_SAMPLES = 1200, 48, 6
# Independent distances of a quadratic piece, at least.
CONSTRAINTS = 6.0
# Detections may be better than stated, by this factor.
LEAST_NOISE = 0.2
# Components: rotation vector (3), direction (2), offset, logarithms of rate and focal lengths, first lens coefficients.
SIZE, OFFSET, RATE, FOCAL, LENS = 11, 5, 6, 7, 9
# Prior deviation of a lens coefficient about the values of the grid, and of what has no prior.
LENS_STD, WIDE = 0.15, 1e3
# Rays at a smaller sine do not tell before which side of the cameras they meet.
LEAST_SINE = 0.01
# Step of the numerical derivatives, and frames on either side from which the velocity of a track is taken.
STEP, VELOCITY_FRAMES = 1e-6, 1.0


@dataclass(frozen=True)
class PairPrior:
    """Prior knowledge about two cameras: standard deviations, 0 for what is known exactly."""

    offset_is_known: bool
    rate_std: float
    focal_std: tuple[float, float]  # relative
    lens_unknown: tuple[bool, bool]

    def stds(self, step: float) -> Array:
        """Prior deviations (11,); that of the offset is the step of the search, s, about the hypothesis."""
        lenses = [LENS_STD if unknown else 0.0 for unknown in self.lens_unknown]
        offset = 0.0 if self.offset_is_known else step
        return np.array([WIDE] * 5 + [offset, self.rate_std, *self.focal_std, *lenses])


@dataclass(frozen=True)
class PairState:
    """Two cameras: x_b = R x_a + t with t of unit length; the clock of b, and factors of focal lengths, and lenses."""

    rotation: Array  # (3, 3)
    direction: Array  # (3,)
    # Time by the prior mean clock of a is pivot + offset + rate (time by that of b - pivot).
    offset_s: float
    rate: float
    pivot_s: float
    focal: Array  # (2,): factors on the focal lengths of the prior mean
    lenses: Array  # (2,): first radial coefficients besides the lenses of the prior mean

    def moved(self, step: Array) -> PairState:
        """Return the state after a step (11,)."""
        turn = rotation_from_vector(step[:3])
        across = np.linalg.svd(self.direction[None])[2][1:]
        direction = self.direction + step[3:5] @ across
        return PairState(
            turn @ self.rotation, direction / np.linalg.norm(direction), self.offset_s + float(step[OFFSET]),
            self.rate * float(np.exp(step[RATE])), self.pivot_s, self.focal * np.exp(step[FOCAL:LENS]),
            self.lenses + step[LENS:],
        )  # fmt: skip

    @property
    def essential(self) -> Array:
        """Essential matrix (3, 3)."""
        return essential_of(self.rotation, self.direction)

    def essential_derivatives(self) -> Array:
        """Derivatives (5, 9) of the essential matrix, row by row, by rotation and direction."""
        across = np.linalg.svd(self.direction[None])[2][1:]
        turns = essential_of(cross_matrices(np.eye(3)) @ self.rotation, self.direction)
        return np.concatenate([turns, essential_of(self.rotation, across)]).reshape(5, 9)

    def times_of_second(self, times: Array) -> Array:
        """Times on the clock of b of times on the clock of a."""
        return np.asarray(self.pivot_s + (times - self.pivot_s - self.offset_s) / self.rate)

    def rays(self, slopes: Array, side: int) -> Array:
        """Rays (n, 3) of slopes (n, 2) that the intrinsics of the prior mean made."""
        return np.column_stack(
            [straightened(slopes / self.focal[side], float(self.lenses[side])), np.ones(len(slopes))]
        )


@dataclass(frozen=True)
class PairFit:
    """Two cameras that tracks fit."""

    state: PairState
    tolerance: float  # px, where the gain is greatest
    gain: float
    pieces: float  # quadratic pieces of the paired tracks
    front: float  # share of the samples of the paired tracks that lie in front of both cameras
    stds: Array  # (11,): deviations of the components, 0 of what is held
    depths: Array  # (n, 2): depths of their samples before both cameras, in lengths of the baseline
    points: Array  # (n, 3): where they are, in the axes of a and in lengths of the baseline
    samples: Array  # (n, 3): track of a, time of a, track of b of these
    residual: float  # median distance of the paired samples over their noise
    parallax: float  # median angle between their rays, rad

    @property
    def gain_in_front(self) -> float:
        """Gain of the points in front of both cameras: those behind one of them are outliers of this pose."""
        return self.gain * self.front

    @property
    def rotation_std(self) -> float:
        """Largest deviation of the rotation, rad."""
        return float(self.stds[:3].max())

    @property
    def direction_std(self) -> float:
        """Larger deviation of the direction, rad."""
        return float(self.stds[3:OFFSET].max())


def straightened(slopes: Array, coefficient: float) -> Array:
    """Slopes (n, 2) without a radial distortion 1 + k1 r^2: a few fixed-point steps."""
    if coefficient == 0.0:
        return slopes
    out = slopes
    for _ in range(6):
        factor = 1.0 + coefficient * (out**2).sum(axis=1, keepdims=True)
        out = slopes / np.maximum(factor, 0.2)
    return np.asarray(out)


@dataclass(frozen=True)
class PairProblem:
    """The tracks of two cameras, and the prior knowledge about the cameras."""

    found: SlopeTracks
    cameras: tuple[int, int]
    prior: PairPrior
    step: float  # of the offsets of the hypotheses, s

    def start(self, hypothesis: Hypothesis, focal: Array, lenses: Array) -> PairState:
        """Return the state of a hypothesis, the factors of whose focal lengths and lenses are given."""
        times = self.found.tracks.log_times
        rotation, direction = poses_of(hypothesis.essential)[0]
        pivot = 0.5 * float(times.min() + times.max())
        return PairState(rotation, direction, hypothesis.offset_s, 1.0, pivot, focal, lenses)

    @property
    def focal_px(self) -> Array:
        """Focal lengths (2,) of the prior mean, px."""
        return self.found.focal[list(self.cameras)]

    @property
    def noise_px(self) -> float:
        """Mean noise of a distance, px."""
        return float(np.sqrt((self.found.sigma[list(self.cameras)] ** 2).mean()))

    def fitted(self, state: PairState, tolerances: tuple[float, ...]) -> PairFit | None:
        """Refine a state at tolerances that fall; the fit of the greatest gain, None where nothing pairs in front."""
        best: PairFit | None = None
        start = state
        for tolerance in tolerances:
            paired = self._paired(state, tolerance)
            for _ in range(CHOICES):
                if not len(paired.pairs):
                    break
                former = paired.pairs
                state, covariance = self._minimised(state, start, paired, tolerance)
                paired = self._paired(state, tolerance)
                if np.array_equal(paired.pairs, former):
                    break
            if len(paired.pairs) and (best is None or paired.gain >= best.gain):
                fit = self._judged(state, paired, covariance, tolerance)
                best = fit if len(fit.depths) else best
        return best

    def _rows(self, state: PairState) -> tuple[_Rows, Integers]:
        """Samples of all tracks of a, with all tracks of b at these times; how many there are of each track of a."""
        raw = self.found.tracks
        a, b = (self.found.of_camera(number) for number in self.cameras)
        share = self.found.durations[a] / self.found.durations[a].sum()
        entries = [
            np.unique(np.linspace(raw.first[track], raw.first[track + 1] - 1, max(SAMPLES, count)).astype(int))
            for track, count in zip(a, (ALL_SAMPLES * share).astype(int), strict=True)
        ]
        of_a = np.repeat(np.arange(len(a)), [len(part) for part in entries])
        entry = np.concatenate([np.empty(0, dtype=np.int64), *entries])
        times = state.times_of_second(raw.log_times[entry])
        begin, end = raw.log_times[raw.first[b]], raw.log_times[raw.first[b + 1] - 1]
        row, j = np.nonzero((times[:, None] >= begin) & (times[:, None] <= end))
        slopes, seen = raw.at(b[j], times[row])
        row, j, slopes = row[seen], j[seen], slopes[seen]
        rows = _Rows(entry[row], of_a[row], j, b[j], raw.pixels[entry[row]], slopes)
        return rows, np.bincount(of_a, minlength=len(a))

    def distances(self, state: PairState, a: Array, b: Array) -> SampsonDistances:
        """Return the distances (n,) of rays (n, 3), px."""
        return sampson_distances(state.essential, a, b, *(self.focal_px * state.focal))

    def _paired(self, state: PairState, tolerance: float) -> _Paired:
        """Pair tracks at a state: those that are each other's best partner."""
        rows, counts = self._rows(state)
        a, b = (self.found.of_camera(number) for number in self.cameras)
        shape = (len(a), len(b))
        pair = rows.i * len(b) + rows.j
        count = np.bincount(pair, minlength=len(a) * len(b)).reshape(shape)
        squared = self.distances(state, state.rays(rows.slopes_a, 0), state.rays(rows.slopes_b, 1)).signed ** 2
        gains = log_gains(squared, tolerance)
        mean = np.bincount(pair, weights=gains, minlength=len(a) * len(b)).reshape(shape) / np.maximum(count, 1)
        weight = common_pieces(self.found, a[:, None], b[None], count / counts[:, None], count >= LEAST_SAMPLES)
        table = mean * weight
        chosen = (table > 0.0) & ((table == table.max(axis=1, keepdims=True)) | (table == table.max(axis=0)))
        return _Paired(
            rows.take(np.flatnonzero(chosen.ravel()[pair])), np.argwhere(chosen), float(total_gain(table)),
            float(weight[chosen].sum()),
        )  # fmt: skip

    def _minimised(
        self, state: PairState, start: PairState, paired: _Paired, tolerance: float
    ) -> tuple[PairState, Array]:
        """Gauss-Newton steps with a Cauchy loss; the state, and its covariance (11, 11) at the noise that is left.

        Distances are worth fewer where those of one pair follow one another: a lens is off in one way along a curve.
        """
        rows = paired.rows
        stds = self.prior.stds(self.step)
        free = np.flatnonzero(stds > 0.0)
        covariance = np.zeros((SIZE, SIZE))
        for _ in range(STEPS):
            rows = self._at_clock(state, rows)
            distances, jacobian = self._linearised(state, rows, free)
            weights = 1.0 / (1.0 + (distances / tolerance) ** 2)
            spread = max(float(np.sqrt((weights * distances**2).sum() / weights.sum())), LEAST_NOISE * self.noise_px)
            spread *= np.sqrt(len(distances) / rows.independent(distances, weights, CONSTRAINTS * paired.pieces))
            prior = np.diag(stds[free] ** -2.0)
            precision = jacobian.T @ (weights[:, None] * jacobian) / spread**2 + prior
            pull = jacobian.T @ (weights * distances) / spread**2 + prior @ self._offsets(state, start)[free]
            step = np.zeros(SIZE)
            step[free] = -np.linalg.solve(precision, pull)
            size = float(np.linalg.norm(step[:5]))
            step *= min(1.0, 0.3 / max(size, 1e-12))
            state = state.moved(step)
            if step[free] @ precision @ step[free] < CONVERGED:
                break
        covariance[np.ix_(free, free)] = np.linalg.inv(precision)
        return state, covariance

    def _offsets(self, state: PairState, start: PairState) -> Array:
        """Components (11,) of a state from the prior mean; offset and lenses from those of the start."""
        lenses = state.lenses - start.lenses
        offset = state.offset_s - start.offset_s
        return np.array([0.0] * 5 + [offset, np.log(state.rate), *np.log(state.focal), *lenses])

    def _at_clock(self, state: PairState, rows: _Rows) -> _Rows:
        """Return the rows with the slopes of b at the times of a state; the former ones where b was not seen."""
        slopes, seen = self.found.tracks.at(
            rows.track_b, state.times_of_second(self.found.tracks.log_times[rows.entry])
        )
        return replace(rows, slopes_b=np.where(seen[:, None], slopes, rows.slopes_b))

    def _linearised(self, state: PairState, rows: _Rows, free: Integers) -> tuple[Array, Array]:
        """Distances (n,) and their derivatives (n, f); those by the clock from the velocities of the tracks of b."""
        rays = [state.rays(rows.slopes_a, 0), state.rays(rows.slopes_b, 1)]
        matrix, (distances, scale, line_a, line_b) = state.essential, self.distances(state, *rays)
        inner = [line[:, :2] / f**2 for line, f in zip((line_a, line_b), self.focal_px * state.focal, strict=True)]
        part = (distances * scale**2)[:, None]  # of the derivatives, by the distance's deviation
        jacobian = np.zeros((len(distances), SIZE))
        by_matrix = rays[1][:, :, None] * (scale[:, None] * rays[0])[:, None]
        by_matrix[:, :2] -= (part * inner[1])[:, :, None] * rays[0][:, None]
        by_matrix[:, :, :2] -= rays[1][:, :, None] * (part * inner[0])[:, None]
        jacobian[:, :OFFSET] = by_matrix.reshape(-1, 9) @ state.essential_derivatives().T
        by_ray = [
            scale[:, None] * line_a[:, :2] - part * (inner[1] @ matrix[:2, :2]),
            scale[:, None] * line_b[:, :2] - part * (inner[0] @ matrix[:2, :2].T),
        ]
        if (free == OFFSET).any() or (free == RATE).any():
            interval = VELOCITY_FRAMES * float(self.found.intervals[self.cameras[1]])
            times = self.found.tracks.log_times[rows.entry]
            at = state.times_of_second(times)
            later, seen_later = self.found.tracks.at(rows.track_b, at + interval)
            sooner, seen_sooner = self.found.tracks.at(rows.track_b, at - interval)
            change = (by_ray[1] * (state.rays(later, 1) - state.rays(sooner, 1))[:, :2]).sum(axis=1)
            clock = np.where(seen_later & seen_sooner, change / (2.0 * interval), 0.0) / state.rate
            jacobian[:, OFFSET] = -clock
            jacobian[:, RATE] = -clock * (times - state.pivot_s - state.offset_s)
        for k in free[free >= FOCAL].tolist():
            side = (k - FOCAL) % 2
            step = np.zeros(SIZE)
            step[k] = STEP
            moved = state.moved(step).rays(rows.slopes_b if side else rows.slopes_a, side)
            jacobian[:, k] = (by_ray[side] * (moved - rays[side])[:, :2]).sum(axis=1) / STEP
            if k < LENS:  # the deviation of the distance is in pixels of this focal length
                jacobian[:, k] += part[:, 0] * (inner[side] * (line_a, line_b)[side][:, :2]).sum(axis=1)
        return distances, jacobian[:, free]

    def _judged(self, state: PairState, paired: _Paired, covariance: Array, tolerance: float) -> PairFit:
        """Choose the pose with the most points in front of both cameras, and return how well the tracks fit it."""
        rows = paired.rows
        a, b = state.rays(rows.slopes_a, 0), state.rays(rows.slopes_b, 1)
        distances = np.abs(self.distances(state, a, b).signed)
        inlying = distances <= 3.0 * tolerance
        options = []
        for rotation, direction in poses_of(state.essential):
            # in the axes of a: b's centre is -R^T t
            depth_a, depth_b, sines = nearest_depths(a, b @ rotation, np.broadcast_to(-direction @ rotation, a.shape))
            telling = inlying & (sines > LEAST_SINE)
            in_front = (depth_a > 0.0) & (depth_b > 0.0)
            front = float(in_front[telling].mean()) if telling.any() else 0.0
            # rays that point the same way meet in front, however far
            meet = np.where(sines > LEAST_SINE, in_front, (a * (b @ rotation)).sum(axis=1) > 0.0)
            share = float(meet[inlying].mean()) if inlying.any() else 0.0
            options.append((share, front, rotation, direction, np.stack([depth_a, depth_b], axis=1), sines))
        _, front, rotation, direction, depths, sines = max(options, key=lambda option: option[0])
        good = inlying & (depths > 0.0).all(axis=1) & (sines > LEAST_SINE)
        tracks = [self.found.of_camera(number) for number in self.cameras]
        samples = np.column_stack([tracks[0][rows.i], self.found.tracks.log_times[rows.entry], tracks[1][rows.j]])
        return PairFit(
            replace(state, rotation=rotation, direction=direction), tolerance, paired.gain, paired.pieces, front,
            np.sqrt(np.maximum(np.diag(covariance), 0.0)),
            depths[good], a[good] * depths[good, :1], samples[good],
            float(np.median(distances)) / (0.6745 * self.noise_px),
            float(np.arcsin(np.clip(np.median(sines[inlying]), 0.0, 1.0))) if inlying.any() else 0.0,
        )  # fmt: skip


@dataclass(frozen=True)
class _Rows(ArrayRows):
    """Samples of tracks of a with tracks of b: entries (n,), tracks i and j of each camera, slopes (n, 2) of both."""

    entry: Integers
    i: Integers
    j: Integers
    track_b: Integers
    slopes_a: Array
    slopes_b: Array

    def independent(self, distances: Array, weights: Array, least: float) -> float:
        """Return how many independent distances all of them are worth, by the correlation of successive ones."""
        successive = (np.diff(self.i) == 0) & (np.diff(self.j) == 0)
        scaled = np.sqrt(weights) * distances
        correlation = float((scaled[1:] * scaled[:-1])[successive].sum() / max(float((scaled**2).sum()), 1e-300))
        correlation = min(max(correlation, 0.0), 0.99)
        return min(max(len(distances) * (1.0 - correlation) / (1.0 + correlation), least), float(len(distances)))


@dataclass(frozen=True)
class _Paired:
    """Samples of the tracks that are paired, the pairs (p, 2), their gain, and the pieces that they have in common."""

    rows: _Rows
    pairs: Integers
    gain: float
    pieces: float


def distance_of(one: PairState, other: PairState) -> tuple[float, float]:
    """Angles, rad, between the rotations and between the directions of two states."""
    turn = float(np.linalg.norm(rotation_to_vector(one.rotation @ other.rotation.T)))
    cosine = float(np.clip(one.direction @ other.direction, -1.0, 1.0))
    return turn, float(np.arccos(cosine))
