"""Two cameras from nothing: essential matrices over a grid of clock offsets, scored by the tracks that meet.

Tracks are compared on a grid of times. At every offset of the clocks hypotheses of E come from the eight-point method
on single pairs of curved tracks (and on all tracks joined, where one object is seen at a time), and from the five-point
method on two pairs of tracks. Each is scored by what its tracks gain: for a track the gain of its best partner, the
mean over its times of

    log((1 - e) N(distance; 0, tolerance) / density by chance + e),

times the number of quadratic pieces that the common part of the curves needs. Chance gains nothing, a short straight
track little, a long curved one much. At a tolerance that raw hypotheses need, wrong ones gain as much as the right
one; those of the greatest scores are refined together, and scored again at a narrower one.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.discovery.essential import constraint_rows, eight_point, five_point, nearest_essential
from stereophd.core.calibration.discovery.tracks import SlopeTracks
from stereophd.core.geometry.rotations import cross_matrices

# Share of detections whose distance is chance's, and the range of distances by chance.
OUTLIERS, CHANCE_RANGE_PX = 0.1, 200.0
# Tolerance, px, of the scores of hypotheses, and first and last one of the eight-point method.
TOLERANCE, FIRST_TOLERANCE, LAST_TOLERANCE = 20.0, 80.0, 10.0
# Samples of a track that are scored, and least of them that make a pair.
SAMPLES, LEAST_SAMPLES = 16, 4
# Times of a pair of tracks in the eight-point method, and how many it needs; pieces from which a track is curved.
PAIR_SAMPLES, LEAST_ROWS, CURVED = 96, 10, 3.0
# Eight-point hypotheses and five-point ones that are made at most, over all offsets, and pairs of tracks at one offset.
MOST_EIGHT, MOST_FIVE, MOST_PAIRS = 6000, 20_000, 64
# Right five-point hypotheses that an offset needs (its neighbours have them too); those of all offsets, at least.
RIGHT_FIVE, LEAST_FIVE = 6.0, 4000
# Solutions of the five-point method that are scored, those that fit their samples best; offsets, at most.
SCORED, MOST_OFFSETS = 3, 1600
# Hypotheses that are kept at offsets within some steps of one another, and the cosine of E from which two are alike.
MOST_NEAR, NEAR, ALIKE = 4, 3, 0.996
# One of so many hypotheses of an offset is refined, those of the greatest scores: steps take about as long as scores of
# all. The tolerances, px, of the steps, and the turn, rad, that a step is to stay below.
REFINED_OF, REFINED_TOLERANCES, LARGEST_TURN = 9, (20.0, 20.0, 10.0, 10.0, 5.0), 0.3
# Derivatives (3, 3, 3) of a small turn about each axis.
GENERATORS = cross_matrices(np.eye(3))
# Share of the shorter record of tracks that must overlap at an offset.
LEAST_OVERLAP = 0.25


@dataclass(frozen=True)
class Hypothesis:
    """An essential matrix of two cameras, x_b^T E x_a = 0, at an offset of the clock of b."""

    essential: Array  # (3, 3)
    offset_s: float
    score: float


@dataclass(frozen=True)
class _Grid:
    """Tracks of two cameras on a common grid of times: slopes (k, g, 2), NaN where a track was not seen."""

    step: float
    first: Array  # slopes of camera a
    second: Array  # of camera b
    shifts: Integers  # (m,): offsets of b's clock, in steps

    def of_second(self, tracks: Integers | slice, places: Integers, shift: int) -> Array:
        """Slopes (k, *places, 2) of tracks of b at places of the grid of a."""
        there = places - shift
        inside = (there >= 0) & (there < self.second.shape[1])
        return np.where(inside[..., None], self.second[tracks][:, np.where(inside, there, 0)], np.nan)


def make_grid(found: SlopeTracks, cameras: tuple[int, int], reach: float) -> _Grid:
    """Put the tracks of two cameras on one grid of times, with offsets of the second up to `reach`, s, if they overlap.

    The step lets a usual track move by half of the tolerance, but is no shorter than the slower camera's interval.
    """
    sides = [found.of_camera(number) for number in cameras]
    raw = found.tracks
    speeds = [
        found.focal[number] * np.linalg.norm(np.diff(raw.pixels[a:b], axis=0), axis=1) / np.diff(raw.log_times[a:b])
        for number, side in zip(cameras, sides, strict=True)
        for a, b in raw.spans(side)
    ]
    slowest = float(np.nanmax(found.intervals[list(cameras)]))
    usual = float(np.median(np.concatenate(speeds)))
    spans = [(raw.log_times[raw.first[side]].min(), raw.log_times[raw.first[side + 1] - 1].max()) for side in sides]
    lengths = [last - first for first, last in spans]
    least = LEAST_OVERLAP * min(lengths)
    low, high = spans[0][0] + least - spans[1][1], spans[0][1] - least - spans[1][0]
    low, high = max(low, -reach), min(high, reach)
    step = max(slowest, 0.5 * TOLERANCE / max(usual, 1e-12), (high - low) / MOST_OFFSETS)
    step = min(step, max(slowest, min(lengths) / 40.0))
    start = min(first for first, _ in spans)
    tables = [
        found.at(side, start + step * np.arange(math.ceil((last - start) / step) + 1))
        for side, (_, last) in zip(sides, spans, strict=True)
    ]
    shifts = np.arange(math.ceil(low / step), math.floor(high / step) + 1) if high >= low else np.zeros(1)
    return _Grid(step, tables[0], tables[1], shifts.astype(np.int64) if len(shifts) else np.zeros(1, dtype=np.int64))


def log_gains(squared: Array | NDArray[np.float32], tolerance: float) -> Array:
    """Gain of distances, px^2, by their logarithmic density over that by chance; that of an outlier where NaN."""
    density = np.exp(-0.5 * squared / tolerance**2) / (math.sqrt(2.0 * math.pi) * tolerance)
    return np.asarray(np.log((1.0 - OUTLIERS) * CHANCE_RANGE_PX * np.fmax(density, 0.0) + OUTLIERS))


def total_gain(table: Array) -> Array:
    """Sum over the tracks of both cameras of the gain of the best partner, halved: (...,) of a table (..., i, j)."""
    gains = np.maximum(table, 0.0)
    return np.asarray(0.5 * (gains.max(axis=-1).sum(axis=-1) + gains.max(axis=-2).sum(axis=-1)))


@dataclass(frozen=True)
class _Compared:
    """Samples of pairs of tracks at one offset."""

    rows: NDArray[np.float32]  # (9, n): of the constraints on E, times the focal length
    pair: Integers  # (n,): pair of each, i * tracks of b + j
    begin: Integers  # (p,): the first sample of each pair
    count: Integers  # (i, j): samples of a pair
    weight: Array  # (i, j): quadratic pieces of the common part
    focal: float

    def distances(self, essential: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Signed distances (h, n), px, of essential matrices (h, 3, 3), and what divides their constraints."""
        a, b = self.rows[6:], self.rows[2::3]
        line_b = (essential[:, :2].reshape(-1, 3) @ a).reshape(len(essential), 2, -1)
        line_a = (np.swapaxes(essential[:, :, :2], 1, 2).reshape(-1, 3) @ b).reshape(len(essential), 2, -1)
        scale = np.sqrt((line_a**2).sum(axis=1) + (line_b**2).sum(axis=1)) / self.focal + np.float32(1e-12)
        return essential.reshape(-1, 9) @ self.rows / scale, scale

    def table(self, distances: NDArray[np.float32], tolerance: float) -> Array:
        """Gains (h, i, j) of pairs of tracks."""
        out = np.zeros((len(distances), self.count.size))
        index = self.pair[self.begin]
        gains = np.add.reduceat(log_gains(distances**2, tolerance), self.begin, axis=1)
        out[:, index] = gains * (self.weight / np.maximum(self.count, 1)).ravel()[index]
        return out.reshape(len(distances), *self.count.shape)

    @cached_property
    def products(self) -> NDArray[np.float32]:
        """Products (n, 81) of all constraints of a sample with each other."""
        return (self.rows.T[:, :, None] * self.rows.T[:, None]).reshape(-1, 81)

    def scores(self, essential: Array, tolerance: float) -> Array:
        """Scores (h,) of essential matrices (h, 3, 3)."""
        if not len(self.pair) or not len(essential):
            return np.zeros(len(essential))
        chunk = max(1, 500_000 // len(self.pair))
        parts = [essential[low : low + chunk].astype(np.float32) for low in range(0, len(essential), chunk)]
        return np.concatenate([total_gain(self.table(self.distances(part)[0], tolerance)) for part in parts])

    def refined(self, essential: Array, tolerance: float) -> Array:
        """Essential matrices (h, 3, 3) after a Gauss-Newton step (Cauchy weights) on pairs that are best partners."""
        if not len(self.pair) or not len(essential):
            return essential
        distances, scale = self.distances(essential.astype(np.float32))
        table = self.table(distances, tolerance)
        best = (table == table.max(axis=1, keepdims=True)) | (table == table.max(axis=2, keepdims=True))
        chosen = ((table > 0.0) & best).reshape(len(table), -1)[:, self.pair]
        weights = chosen / (1.0 + (distances / tolerance) ** 2) / (tolerance * scale) ** 2
        turned = np.concatenate([GENERATORS @ essential[:, None], essential[:, None] @ GENERATORS], axis=1)
        turned = turned.reshape(-1, 6, 9)
        normal = (weights @ self.products).reshape(-1, 9, 9)
        precision = turned @ normal @ np.swapaxes(turned, 1, 2) + np.eye(6) * LARGEST_TURN**-2
        step = -np.linalg.solve(precision, turned @ normal @ essential.reshape(-1, 9, 1))
        return nearest_essential(essential + (step * turned).sum(axis=1).reshape(-1, 3, 3))


@dataclass(frozen=True)
class PairSearch:
    """The search for two cameras: their tracks, the grid, and the focal length that turns slopes into pixels."""

    found: SlopeTracks
    cameras: tuple[int, int]
    grid: _Grid

    @property
    def focal(self) -> float:
        """Mean focal length of both cameras, px."""
        return float(self.found.focal[list(self.cameras)].mean())

    def hypotheses(self, most: int, rng: np.random.Generator) -> list[Hypothesis]:
        """Return the hypotheses of the greatest scores, the best first."""
        tracks = [len(self.grid.first), len(self.grid.second)]
        # a track has one right partner among all of the other camera
        every = max(LEAST_FIVE, int(RIGHT_FIVE * max(tracks) ** 2) * len(self.grid.shifts))
        five = max(min(MOST_FIVE, every) // len(self.grid.shifts), 1) if min(tracks) > 1 else 0
        eight = self._eight_point(self._singles())
        scored: list[tuple[int, Hypothesis]] = []
        for place, shift in enumerate(self.grid.shifts.tolist()):
            parts = [np.empty((0, 3, 3)), eight[:, place], *([self._five_point(shift, five, rng)] if five else [])]
            essential = np.concatenate(parts)
            essential = essential[np.isfinite(essential).all(axis=(1, 2))]
            scored += [
                (shift, Hypothesis(matrix, shift * self.grid.step, float(score)))
                for matrix, score in zip(*self._best(essential, shift), strict=True)
            ]
        kept: list[tuple[int, Hypothesis]] = []
        for shift, hypothesis in sorted(scored, key=lambda entry: -entry[1].score):
            if len(kept) < most and sum(abs(shift - other) <= NEAR for other, _ in kept) < MOST_NEAR:
                kept.append((shift, hypothesis))
        return [hypothesis for _, hypothesis in kept]

    def _singles(self) -> list[tuple[Array, Array]]:
        """Slopes (g, 2) of tracks of a and of b that may be one curved object; the first are all tracks joined."""
        a, b = (self.found.of_camera(number) for number in self.cameras)
        joined = [_joined(self.grid.first, self.found.pieces[a]), _joined(self.grid.second, self.found.pieces[b])]
        out = [(joined[0], joined[1])]
        most = max(MOST_EIGHT // len(self.grid.shifts), 3)
        pieces = np.minimum(self.found.pieces[a][:, None], self.found.pieces[b][None])
        for k in np.argsort(-pieces, axis=None, kind="stable")[:most]:
            i, j = divmod(int(k), len(b))
            if pieces[i, j] >= CURVED:
                out.append((self.grid.first[i], self.grid.second[j]))
        return out

    def _eight_point(self, singles: list[tuple[Array, Array]]) -> Array:
        """Essential matrices (s, m, 3, 3) of pairs of tracks at every offset; NaN where they hardly overlap."""
        out = np.full((len(singles), len(self.grid.shifts), 3, 3), np.nan)
        tolerances = (FIRST_TOLERANCE / self.focal, LAST_TOLERANCE / self.focal)
        for k, (first, second) in enumerate(singles):
            seen = np.flatnonzero(np.isfinite(first[:, 0]))
            if len(seen) < LEAST_ROWS:
                continue
            places = seen[np.unique(np.linspace(0, len(seen) - 1, PAIR_SAMPLES).astype(int))]
            there = places - self.grid.shifts[:, None]
            inside = (there >= 0) & (there < len(second))
            slopes = np.where(inside[..., None], second[np.where(inside, there, 0)], np.nan)
            valid = np.isfinite(slopes[..., 0])
            usable = np.flatnonzero(valid.sum(axis=1) >= LEAST_ROWS)
            if not len(usable):
                continue
            rows = constraint_rows(np.broadcast_to(first[places], slopes.shape), np.nan_to_num(slopes))
            out[k, usable] = eight_point(rows[usable], valid[usable].astype(float), tolerances)
        return out

    def _five_point(self, shift: int, most: int, rng: np.random.Generator) -> Array:
        """Essential matrices (s, 3, 3) of two pairs of tracks each, at one offset."""
        places, valid, slopes = self._samples(shift)
        counts = valid.sum(axis=2)  # (i, j)
        pieces = np.minimum.outer(*(self.found.pieces[self.found.of_camera(number)] for number in self.cameras))
        weight = np.where(counts >= LEAST_SAMPLES, pieces * counts, 0.0)
        pairs = [divmod(int(k), counts.shape[1]) for k in np.argsort(-weight, axis=None, kind="stable")[:MOST_PAIRS]]
        pairs = [pair for pair in pairs if weight[pair] > 0.0]
        chosen = [(p, q) for p, q in combinations(range(len(pairs)), 2)
                  if pairs[p][0] != pairs[q][0] and pairs[p][1] != pairs[q][1]]  # fmt: skip
        if not chosen:
            return np.empty((0, 3, 3))
        if len(chosen) > most:
            chosen = [chosen[k] for k in np.sort(rng.choice(len(chosen), most, replace=False))]
        normal = np.empty((len(pairs), 9, 9))
        for k, (i, j) in enumerate(pairs):
            rows = constraint_rows(self.grid.first[i, places[i][valid[i, j]]], slopes[j, i, valid[i, j]])
            normal[k] = rows.T @ rows / len(rows)
        index = np.array(chosen)
        both = normal[index[:, 0]] + normal[index[:, 1]]
        _, vectors = np.linalg.eigh(both)
        essential, space = five_point(np.swapaxes(vectors[:, :, :4], 1, 2))
        flat = essential.reshape(-1, 9)
        cost = np.einsum("si,sij,sj->s", flat, both[space], flat)
        order = np.lexsort((cost, space))
        rank = np.arange(len(order)) - np.searchsorted(space[order], space[order])
        return nearest_essential(essential[order[rank < SCORED]])

    @cached_property
    def _places(self) -> Integers:
        """Places (i, s) of samples of the tracks of a."""
        return np.stack([_spread(track) for track in self.grid.first])

    def _samples(self, shift: int) -> tuple[Integers, Booleans, Array]:
        """Places (i, s) of samples of the tracks of a, whether b's tracks have them (i, j, s), and how (j, i, s, 2)."""
        slopes = self.grid.of_second(slice(None), self._places, shift)
        here = np.isfinite(np.take_along_axis(self.grid.first[..., 0], self._places, axis=1))
        return self._places, np.isfinite(slopes[..., 0]).transpose(1, 0, 2) & here[:, None], slopes

    def compared(self, shift: int) -> _Compared:
        """Return the samples of all pairs of tracks at an offset."""
        places, valid, slopes = self._samples(shift)
        i, j, s = np.nonzero(valid)
        count, pair = valid.sum(axis=2), i * valid.shape[1] + j
        # single precision is enough for a tolerance of pixels
        rows = constraint_rows(self.grid.first[i, places[i, s]], slopes[j, i, s]).astype(np.float32).T
        return _Compared(
            self.focal * rows, pair, np.flatnonzero(np.diff(pair, prepend=-1)), count, self._weights(count), self.focal
        )

    def _best(self, essential: Array, shift: int) -> tuple[Array, Array]:
        """Refine the essential matrices (h, 3, 3) of the greatest scores at an offset: the best, and their scores."""
        at = self.compared(shift)
        most = max(len(essential) // REFINED_OF, MOST_NEAR)
        essential = essential[np.argsort(-at.scores(essential, TOLERANCE), kind="stable")[:most]]
        for tolerance in REFINED_TOLERANCES:
            essential = at.refined(essential, tolerance)
        scores = at.scores(essential, REFINED_TOLERANCES[-1])
        unit = essential.reshape(-1, 9) / math.sqrt(2.0)
        kept: list[int] = []
        for k in np.argsort(-scores, kind="stable").tolist():
            if len(kept) < MOST_NEAR and np.abs(unit[kept] @ unit[k]).max(initial=0.0) < ALIKE:
                kept.append(k)
        return essential[kept], scores[kept]

    def _weights(self, count: Integers) -> Array:
        """Quadratic pieces (i, j) of the common part of two tracks, from the number of their common samples (i, j)."""
        a, b = (self.found.of_camera(number) for number in self.cameras)
        return common_pieces(self.found, a[:, None], b[None], count / SAMPLES, count >= LEAST_SAMPLES)


def common_pieces(found: SlopeTracks, a: Integers, b: Integers, share: Array, enough: Booleans) -> Array:
    """Quadratic pieces of the common part of tracks, which is a share of a; zero where it is not enough."""
    common = share * found.durations[a]
    of_b = np.minimum(common / found.durations[b], 1.0)
    return np.where(enough, np.minimum(found.pieces[a] * share, found.pieces[b] * of_b), 0.0)


def _spread(track: Array) -> Integers:
    """`SAMPLES` places of the grid (g, 2) at which a track was seen, some of them twice if it is short."""
    seen = np.flatnonzero(np.isfinite(track[:, 0]))
    if not len(seen):
        return np.zeros(SAMPLES, dtype=np.int64)
    return np.asarray(seen[np.linspace(0, len(seen) - 1, SAMPLES).astype(int)])


def _joined(table: Array, pieces: Array) -> Array:
    """Slopes (g, 2) of the track of the most pieces at each time."""
    out = np.full(table.shape[1:], np.nan)
    for track in np.argsort(pieces, kind="stable"):
        seen = np.isfinite(table[track, :, 0])
        out[seen] = table[track, seen]
    return out
