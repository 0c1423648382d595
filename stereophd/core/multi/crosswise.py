"""Two tracks that are paired crosswise: a test that exchanges the detections of one camera between them (ours).

Two objects in one epipolar plane of two cameras have two explanations: the detections of the one camera may be paired
with those of the other in two ways, and the wrong way gives two objects as well, at other depths. The tracks of the PMB
filter are independent. Once both have settled on the wrong way, no track alone can leave it: the alternative of each
needs detections that the other claims, and a product of two small marginals falls as fast as the joint odds rise.

The decision is therefore taken for both tracks together, from the detections that they claimed in the last events:
both are filtered once more from their first kept detection on, as they are and with the detections of one camera
exchanged. The detections are the same, and so is the prior of a new object, so that the difference of the
log-likelihoods is the logarithm of the odds of the two explanations (misses and clutter are the same in both). Where
the exchange is ahead by more than a threshold, the tracks take its Gaussians, and their kept detections are exchanged.

The cost is bounded: only pairs in one epipolar plane are tested, of which both crosswise intersections lie before the
cameras; a pair that is far from an exchange is left alone for a while; at most `MOST_TESTS` an event.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Rig
from stereophd.core.disparity.initial import initial_moments
from stereophd.core.disparity.moved import OUT_OF_VIEW, allocate_moved
from stereophd.core.disparity.sample_move import Look, move_components
from stereophd.core.disparity.trips import disparity_scale
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.motion.base import Motion
from stereophd.core.multi.association import kalman_updates, pair_likelihoods
from stereophd.core.multi.history import ClaimedRows, History
from stereophd.core.multi.mixture import UNLABELLED, GaussianMixture, empty_mixture
from stereophd.core.multi.settings import BirthPrior
from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.sorting import copy_gaussian, stable_order

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Fewest kept detections of each track in the camera whose detections are exchanged, and in all others together.
LEAST_DETECTIONS = 3
# Tracks whose epipolar planes are further apart than this many standard deviations of a pixel are not tested.
COPLANAR_SIGMAS = 6.0
# Crosswise intersections of a disparity this many standard deviations off the birth prior are no objects.
DISPARITY_SIGMAS = 4.0
MOST_TESTS = 2
# Events until a pair is tested again: at least the first, and one more for each nat that the exchange is behind.
SOONEST, LATEST = 2, 64
# A detection whose density is further below the peak of its own noise, nats, is another object's or clutter, and is
# left out: labels have claimed what does not fit before they settled.
MOST_SURPRISE = 15.0


class NewObjects(NamedTuple):
    """Prior of new objects: mean and standard deviation of the disparity (c,) for each camera; of velocities."""

    means: Array
    stds: Array
    velocity_std: float


@compiled
def crosswise_pairs(
    mixture: GaussianMixture, homes: Array, cameras: tuple[int, int], views: Array, prior: NewObjects, tolerance: float
) -> Integers:
    """Labels (n, 2) of pairs of reported tracks that two cameras may have paired crosswise.

    Parameters
    ----------
    mixture : GaussianMixture
        Tracks ordered by label and then by falling weight.
    homes, views : arrays (n, 30), (c, 30)
        Packed spaces of the components, and of all cameras.
    cameras : (int, int)
        The two cameras.
    prior : NewObjects
    tolerance : float
        Distance of two epipolar lines, px, up to which they may be one.
    """
    labels, first, second = mixture.labels, views[cameras[0]], views[cameras[1]]
    heads, places = _reported_places(mixture, homes)
    count = len(heads)
    # angle of the epipolar plane of each, and how far (rad) two planes may be apart
    across, up = _epipolar_axes(first, second)
    angles, widths, widest = np.empty(count), np.empty(count), 0.0
    for i in range(count):
        x = places[i, 0] - second[CENTER]
        y = places[i, 1] - second[CENTER + 1]
        z = places[i, 2] - second[CENTER + 2]
        along = across[0] * x + across[1] * y + across[2] * z
        high = up[0] * x + up[1] * y + up[2] * z
        depth = second[ROTATION + 6] * x + second[ROTATION + 7] * y + second[ROTATION + 8] * z
        angles[i] = math.atan2(high, along)
        widths[i] = tolerance * depth / (second[FX] * math.hypot(along, high)) if depth > 0.0 else 0.0
        widest = max(widest, widths[i])
    order = stable_order(angles)
    out = np.empty((count, 2), dtype=np.int64)
    found = 0
    for m in range(count):
        i = order[m]
        for n in range(m + 1, count):
            j = order[n]
            apart = angles[j] - angles[i]
            if apart > widest:
                break
            if apart <= min(widths[i], widths[j]) and (
                _meet(places[i], places[j], views, cameras[0], cameras[1], prior)
                and _meet(places[j], places[i], views, cameras[0], cameras[1], prior)
            ):
                if found == len(out):
                    out = _doubled(out)
                one, other = labels[heads[i]], labels[heads[j]]
                out[found, 0], out[found, 1] = min(one, other), max(one, other)
                found += 1
    return out[:found]


@compiled
def _epipolar_axes(first: Array, second: Array) -> tuple[Array, Array]:
    """Two axes (3,) that are orthogonal to the line from one camera to another, and to each other."""
    base, across, up = np.empty(3), np.empty(3), np.empty(3)
    for a in range(3):
        base[a] = second[CENTER + a] - first[CENTER + a]
    length = math.sqrt(base[0] ** 2 + base[1] ** 2 + base[2] ** 2)
    least = 0
    for a in range(3):
        base[a] = base[a] / length
        if abs(base[a]) < abs(base[least]):
            least = a
    for a in range(3):
        across[a] = -base[least] * base[a]
    across[least] += 1.0
    length = math.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2)
    for a in range(3):
        across[a] /= length
    up[0] = base[1] * across[2] - base[2] * across[1]
    up[1] = base[2] * across[0] - base[0] * across[2]
    up[2] = base[0] * across[1] - base[1] * across[0]
    return across, up


@compiled
def _doubled(rows: Integers) -> Integers:
    """Copy rows (n, 2) into an array with room for twice as many."""
    out = np.empty((2 * len(rows), 2), dtype=np.int64)
    for k in range(len(rows)):
        out[k, 0], out[k, 1] = rows[k, 0], rows[k, 1]
    return out


@compiled
def _reported_places(mixture: GaussianMixture, homes: Array) -> tuple[Integers, Array]:
    """Heaviest component of each reported track, and the place (n, 3) of its mean in the world."""
    labels = mixture.labels
    heads = np.empty(len(labels), dtype=np.int64)
    count = 0
    for k in range(len(labels)):
        new = labels[k] != UNLABELLED and (k == 0 or labels[k] != labels[k - 1])
        if new and mixture.reported[k] and mixture.means[k, 2] > 0.0:
            heads[count] = k
            count += 1
    places = np.empty((count, 3))
    for i in range(count):
        mean, home = mixture.means[heads[i]], homes[heads[i]]
        depth = disparity_scale(home) / mean[2]
        x, y = (mean[0] - home[CX]) / home[FX] * depth, (mean[1] - home[CY]) / home[FY] * depth
        for a in range(3):
            r0, r1, r2 = home[ROTATION + a], home[ROTATION + 3 + a], home[ROTATION + 6 + a]
            places[i, a] = home[CENTER + a] + r0 * x + r1 * y + r2 * depth
    return heads[:count], places


@compiled
def _meet(one: Array, other: Array, views: Array, a: int, b: int, prior: NewObjects) -> bool:
    """Whether the ray of camera a to one place and that of camera b to another meet where objects may be."""
    first, second = views[a], views[b]
    # alpha to_one - beta to_other = base, in the least-squares sense
    p, q, r, s, t, forward_a, forward_b = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        to_one, to_other = one[k] - first[CENTER + k], other[k] - second[CENTER + k]
        base = second[CENTER + k] - first[CENTER + k]
        p += to_one * to_one
        q += to_one * to_other
        r += to_other * to_other
        s += to_one * base
        t += to_other * base
        forward_a += first[ROTATION + 6 + k] * to_one
        forward_b += second[ROTATION + 6 + k] * to_other
    determinant = p * r - q * q
    if not determinant > 1e-12 * p * r:
        return False
    alpha, beta = (r * s - q * t) / determinant, (q * s - p * t) / determinant
    depth_a, depth_b = alpha * forward_a, beta * forward_b
    if not (depth_a > 0.0 and depth_b > 0.0):
        return False
    off_a = abs(disparity_scale(first) / depth_a - prior.means[a])
    off_b = abs(disparity_scale(second) / depth_b - prior.means[b])
    return bool(off_a <= DISPARITY_SIGMAS * prior.stds[a] and off_b <= DISPARITY_SIGMAS * prior.stds[b])


@compiled
def filter_again(
    points: Array,
    noises: Array,
    delays: Array | None,
    spaces: Array,
    motion: MotionArrays,
    look: Look,
    means: Array,
    covariances: Array,
    fits: NDArray[np.bool_],
) -> float:
    """Log-likelihood of the detections (n) of one track after its first, forwards or backwards in time.

    Parameters
    ----------
    points, noises, delays : arrays (n, 2), (n, 2, 2), (n,) or None
        As in `Event`.
    spaces : array (n, 30)
        Packed space of each.
    motion : MotionArrays
        Over the interval before each (the first is not used).
    look : Look
        Samples of the moves.
    means, covariances : arrays (n, d), (n, d, d)
        Of the track after each detection; the first is given, the others are filled in.
    fits : array (n,) of bool
        Filled in: whether each detection was taken for one of the track.

    Returns
    -------
    float
        Minus infinity where the track leaves the view of a camera that detected it.
    """
    count, size = len(points), means.shape[1]
    # component k: the track after detection k - 1, moved to that of detection k
    before, spreads, homes = np.empty((count, size)), np.empty((count, size, size)), np.empty_like(spaces)
    moved = allocate_moved(count, size)
    seen, one, unit = np.empty(1, dtype=np.bool_), np.zeros(1, dtype=np.int64), np.empty(1)
    seen[0], unit[0] = True, 1.0
    which, nowhere = np.empty(1, dtype=np.int64), np.empty(0)
    total = 0.0
    for k in range(1, count):
        copy_gaussian(means, covariances, k - 1, before, spreads, k)
        for a in range(spaces.shape[1]):
            homes[k, a] = spaces[k - 1, a]
        which[0] = k
        move_components(which, before, spreads, homes, motion, look, spaces[k], 0.0, nowhere, moved)
        if moved.status[k] == OUT_OF_VIEW:
            return -math.inf
        after, spread = moved.means[k : k + 1], moved.covariances[k : k + 1]
        point, noise = points[k : k + 1], noises[k : k + 1]
        delay = None if delays is None else delays[k : k + 1]
        _, _, density = pair_likelihoods(after, spread, seen, point, noise, unit, delay)
        likely = density[0] if len(density) > 0 else 0.0
        area = noises[k, 0, 0] * noises[k, 1, 1] - noises[k, 0, 1] * noises[k, 1, 0]
        least = math.exp(-MOST_SURPRISE) / (2.0 * math.pi * math.sqrt(area))
        total += math.log(likely + least)
        fits[k] = likely > least
        if fits[k]:
            after, spread = kalman_updates(after, spread, one, one, point, noise, delay)
        copy_gaussian(after, spread, 0, means, covariances, k)
    return total


@dataclass(frozen=True)
class CrosswiseTest:
    """The test, and what it takes of a filter.

    Attributes
    ----------
    rig : Rig
    motion : Motion
    samples : array (rows, s)
        Of the moves.
    birth : BirthPrior
    threshold : float
        Log-odds above which detections are exchanged.
    """

    rig: Rig
    motion: Motion
    samples: Array
    birth: BirthPrior
    threshold: float

    @cached_property
    def camera_pairs(self) -> list[tuple[int, int]]:
        """All pairs of cameras."""
        return list(combinations(range(len(self.rig.cameras)), 2))

    @cached_property
    def tolerances(self) -> list[float]:
        """Distance of epipolar lines, px, in each camera."""
        return [COPLANAR_SIGMAS * float(np.max(one.detector.sigma)) for one in self.rig.cameras]

    @cached_property
    def _prior_at_rest(self) -> NewObjects:
        return self.prior(self.rig.packed)

    def prior(self, views: Array) -> NewObjects:
        """Return the prior of new objects in each camera."""
        means, stds = np.array([self.birth.disparity_moments(view) for view in views]).T
        return NewObjects(means.copy(), stds.copy(), float(self.birth.velocity_std))

    def compile(self) -> None:
        """Compile the kernels of the test, with no tracks and with one detection."""
        views, none, one = self.rig.views(0.0), np.empty(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
        prior, homes = self.prior(views), self.rig.spaces(none, np.empty(0))
        crosswise_pairs(empty_mixture(self.motion.state_size), homes, (0, 0), views, prior, 1.0)
        self._filter_again(ClaimedRows(one, np.zeros(1), one, np.zeros((1, 2)), np.eye(2)[None], None), prior)

    def put_right(
        self, mixture: GaussianMixture, history: History, time_s: float, event: int
    ) -> tuple[GaussianMixture, History]:
        """Return a mixture after an event, and the history, with tracks exchanged that were paired crosswise."""
        if not self.camera_pairs or np.count_nonzero(mixture.reported) < 2:
            return mixture, history
        cameras = self.camera_pairs[event % len(self.camera_pairs)]
        views = self.rig.views(time_s)
        homes = self.rig.spaces(mixture.cameras, mixture.times)
        prior = self.prior(views) if self.rig.moving else self._prior_at_rest
        pairs = crosswise_pairs(mixture, homes, cameras, views, prior, self.tolerances[cameras[1]])
        if not len(pairs):
            return mixture, history
        camera = cameras[1]
        waiting = {tuple(row) for row in history.tests.pairs[history.tests.due > event].tolist()}
        todo = [pair for pair in pairs.tolist() if (*pair, camera) not in waiting]
        if not todo:
            return mixture, history
        tests = history.tests.after(event)
        for first, second in todo[:MOST_TESTS]:
            odds, exchanged = self.explain(history, first, second, camera, prior)
            if exchanged is not None:
                mixture = _replaced(mixture, first, second, exchanged)
                history = history.exchanged(first, second, camera)
            behind = abs(odds) if exchanged is not None else max(-odds, 0.0)
            tests = tests.add((first, second, camera), event + SOONEST + round(min(behind, LATEST)))
        return mixture, replace(history, tests=tests)

    def explain(
        self, history: History, first: int, second: int, camera: int, prior: NewObjects
    ) -> tuple[float, tuple[Track, Track] | None]:
        """Return by how many nats two tracks explain their detections better with those of a camera exchanged.

        With it both tracks after an exchange that is ahead by more than the threshold; 0 where too little is known.
        """
        rows = history.rows_of(first, second)
        there = rows.cameras == camera
        for label in (first, second):
            own = rows.labels == label
            if min(np.count_nonzero(own & there), np.count_nonzero(own & ~there)) < LEAST_DETECTIONS:
                return 0.0, None
        # backwards: what a label claimed last is most probably its own
        rows = rows.take(np.arange(len(rows.labels))[::-1])
        other = np.where(rows.cameras == camera, first + second - rows.labels, rows.labels)
        odds, paths = 0.0, []
        for label in (first, second):
            odds -= self._filter_again(rows.take(np.flatnonzero(rows.labels == label)), prior).log_likelihood
            path = rows.take(np.flatnonzero(other == label))
            again = self._filter_again(path, prior)
            odds += again.log_likelihood
            paths.append(path.take(np.flatnonzero(again.fits)[::-1]))
        if not odds > self.threshold:
            return (odds if math.isfinite(odds) else 0.0), None
        found = [self._filter_again(path, prior) for path in paths]
        return odds, (found[0], found[1])

    def _filter_again(self, rows: ClaimedRows, prior: NewObjects) -> Track:
        """Filter the detections of one track again, in the order of the rows."""
        spaces = self.rig.spaces(rows.cameras, rows.times)
        motion = self.motion.arrays(np.diff(rows.times, prepend=rows.times[0]))
        count, size = len(rows.times), self.motion.state_size
        means, covariances, fits = np.empty((count, size)), np.empty((count, size, size)), np.ones(count, dtype=bool)
        first = rows.cameras[0]
        born, spread = initial_moments(
            rows.points[:1], rows.noises[:1], spaces[0], float(prior.means[first]), float(prior.stds[first]),
            prior.velocity_std, size, rows.delays,
        )  # fmt: skip
        means[0], covariances[0] = born[0], spread[0]
        look = Look(self.samples, np.ones(self.samples.shape[1]), 2)
        value = filter_again(
            rows.points, rows.noises, rows.delays, spaces, motion, look, means, covariances, fits
        )  # fmt: skip
        return Track(value, fits, means[-1], covariances[-1], int(rows.cameras[-1]), float(rows.times[-1]))


class Track(NamedTuple):
    """A track filtered again: which detections fit it, and its Gaussian (d,), (d, d) where and when the last was."""

    log_likelihood: float
    fits: NDArray[np.bool_]
    mean: Array
    covariance: Array
    camera: int
    time_s: float


def _replaced(mixture: GaussianMixture, first: int, second: int, tracks: tuple[Track, Track]) -> GaussianMixture:
    """Return a mixture in which each of two labels has one Gaussian."""
    kept = np.ones(mixture.size, dtype=bool)
    heads = []
    for label in (first, second):
        found = np.flatnonzero(mixture.labels == label)
        kept[found[1:]] = False
        heads.append(int(found[0]))
    out = mixture.take(np.arange(mixture.size))
    for head, label, one in zip(heads, (first, second), tracks, strict=True):
        out.weights[head] = mixture.weights[mixture.labels == label].sum()
        out.means[head], out.covariances[head] = one.mean, one.covariance
        out.cameras[head], out.times[head] = one.camera, one.time_s
    return out.take(np.flatnonzero(kept))
