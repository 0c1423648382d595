"""Do the rays of two cameras meet more often than chance, and as often as the configuration promises?

A detection of camera A has a partner in camera B if a detection of B, at the same true time, lies near its epipolar
line, by Sampson's distance in standard deviations (`stereophd.core.two_views.epipolar`), and both rays meet in front of
the cameras. The share of detections with a partner is compared with the share that the same cameras have when B's times
are shifted, which is what chance gives. No track and no filter is involved, so the figures show whether cameras and
clocks fit the log.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.two_views.epipolar import distances_in_front, essential_matrices, sampson_distances
from stereophd.pipeline.checks.log.sample import CameraSample

# Of the detections of both cameras of a pair; None: not computed.
Rays = tuple[Array | None, Array | None]

# Detections of A that are examined, time shifts that measure chance, and distances of all of them at most: where B has
# many detections, fewer of A are examined, but those with all their candidates.
MOST_DETECTIONS, SHIFTS, MOST_DISTANCES = 400, 8, 300_000
# Tolerances, in standard deviations of the distance.
TOLERANCES = (3.0, 8.0, 20.0)
# By how much detections are moved for distances of chance, as a share of the image, and the angle between successive
# directions. At other times alone the rays of objects that hardly move still meet.
OFFSETS, GOLDEN_ANGLE = (0.08, 0.25), 2.39996


def unchanged(camera: Camera, pixels: Array) -> Array:
    """Return the pixels as they are."""
    return pixels


@dataclass(frozen=True)
class Reading:
    """A camera, and how the pixels of the log are to be read."""

    camera: Camera
    # callable (Camera, (n, 2) array) -> (n, 2) array: From pixels of the log to pixels of the camera.
    read: Callable[[Camera, Array], Array] = unchanged

    def rays(self, pixels: Array) -> Array:
        """Return the rays (n, 3), third component 1, of pixels (n, 2) of the log; NaN where there are none."""
        return self.camera.rays(self.read(self.camera, pixels))


@dataclass(frozen=True)
class Candidates:
    """Detections of A, and the detections of B at their times and at shifted times."""

    # `a`, `b`: The cameras.
    a: int
    b: int
    detections: Integers  # (n,) of int: Indices of the detections of A
    times: Array  # (n,): True times of these, s
    pixels_a: Array  # (n, 2)
    pixels_b: Array  # At the same times, then at shifted ones; NaN where there are fewer than k

    def thinned(self, count: int, shifts: int = SHIFTS) -> "Candidates":
        """Return fewer of the detections, and fewer shifted times."""
        kept = np.unique(np.linspace(0, len(self.detections) - 1, min(count, len(self.detections))).astype(int))
        there = np.ascontiguousarray(self.pixels_b[: 1 + shifts, kept])
        return Candidates(self.a, self.b, self.detections[kept], self.times[kept], self.pixels_a[kept], there)

    def elsewhere(self, camera: Camera) -> "Candidates":
        """Return the detections of A, the given camera, at other places of the image, each in its own direction."""
        angle = GOLDEN_ANGLE * np.arange(len(self.pixels_a))
        size = np.array([camera.width, camera.height]) - 1.0
        away = np.linspace(*OFFSETS, 7)[np.arange(len(self.pixels_a)) % 7]
        moved = self.pixels_a + (away * np.array([np.cos(angle), np.sin(angle)])).T * size.max()
        # reflected at the borders
        return replace(self, pixels_a=size - np.abs(size - np.abs(moved)))


@dataclass(frozen=True)
class Meeting:
    """How many of A's detections have a partner in B."""

    # `share`, `chance`: Share with a partner, and at shifted times.
    share: float
    chance: float
    excess: float  # ``(share - chance) / (1 - chance)``: the share that meets for a reason
    score: float  # `share` minus `chance` in standard deviations of chance
    tolerance: float  # In standard deviations of the distance
    sharpness: float  # Mean of the excess over all tolerances: of rays that meet as often, the sharper ones meet better
    meets: Booleans  # (1 + s, n): Which of A's detections have one, at the same times and at shifted ones


def candidates(
    samples: list[CameraSample],
    a: int,
    b: int,
    most: int = MOST_DETECTIONS,
    shifts: int = SHIFTS,
    most_distances: int = MOST_DISTANCES,
    places: Callable[[CameraSample, Array], Array] | None = None,
    among: Integers | None = None,
) -> Candidates | None:
    """Return detections of A with those of B at the same and at shifted times; None if their periods share nothing.

    `places` says where B's detections are at a time, by default `pixels_at`. Detections are taken `among` these of A,
    by default all, as far as both periods have their times.
    """
    first, second = samples[a], samples[b]
    if len(first.pixels) == 0 or len(second.times) < 2:
        return None
    low, high = max(first.times[0], second.times[0]), min(first.times[-1], second.times[-1])
    times = first.times[first.frame_of]
    usable = np.arange(len(times)) if among is None else among
    usable = usable[(times[usable] >= low) & (times[usable] <= high)]
    if len(usable) < 2 or high <= low:
        return None
    most = min(most, max(1, most_distances // ((1 + shifts) * max(1, int(np.diff(second.first).max())))))
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, min(most, len(usable))).astype(int))]
    at, length = times[chosen] + first.camera.row_delays(first.pixels[chosen, 1]), high - low
    shifted = [at] + [low + (at - low + length * (k + 1) / (shifts + 1)) % length for k in range(shifts)]
    there = (places or pixels_at)(second, np.concatenate(shifted)).reshape(1 + shifts, len(chosen), -1, 2)
    most_there = max(1, int(np.isfinite(there[..., 0]).sum(axis=2).max()))
    return Candidates(a, b, chosen, at, first.pixels[chosen], there[:, :, :most_there])


def pixels_at(sample: CameraSample, times: Array) -> Array:
    """Return the detections (n, k, 2) of a camera at times (n,), s: between frames, along the one-camera tracks.

    A detection without a track counts for the nearer of the two frames. NaN where a time has fewer than k.
    """
    now, later = sample.alone
    interval, passed = sample.around(times)
    width = max(now.shape[1], later.shape[1])
    alone = np.where(passed[:, None, None] <= 0.5, _wide(now, width)[interval], _wide(later, width)[interval])
    return np.concatenate([pixels_along(sample, times, interval, 1), alone], axis=1)


def pixels_along(sample: CameraSample, times: Array, before: Integers, steps: int) -> Array:
    """Return the detections (n, k, 2) at times (n,), s, on the lines of one-camera tracks over so many frames.

    `before` (n,) are the frames from which these lines go. On a rolling shutter a track is where it is read at these
    times, not where the frames have it. NaN where a time has fewer than k.
    """
    start, end = (table[before] for table in sample.carried(steps))
    span = sample.times[before + steps] - sample.times[before]
    velocities = (end - start) / np.where(span > 0.0, span, np.inf)[:, None, None]
    moved = start + np.clip(times - sample.times[before], 0.0, span)[:, None, None] * velocities
    return np.asarray(moved - sample.camera.row_delays(moved[:, :, 1])[:, :, None] * velocities)


def _wide(table: Array, width: int) -> Array:
    """Return a table (f, k, 2) with this many columns, the new ones NaN."""
    if table.shape[1] == width:
        return table
    return np.pad(table, ((0, 0), (0, width - table.shape[1]), (0, 0)), constant_values=np.nan)


def distances(found: Candidates, first: Reading, second: Reading, known: Rays = (None, None)) -> tuple[Array, Array]:
    """Return distances in standard deviations, with their sign, and depths before A, both (1 + s, n, k).

    Infinite where the rays do not meet in front of both cameras. `known`: those that have been computed (see
    `rays_of`).
    """
    rays_a, rays_b = rays_of(found, first, second, known)
    one, other, (scales_a, scales_b) = first.camera, second.camera, _scales(first.camera, second.camera)
    turn, between = one.pose.rotation @ other.pose.rotation.T, one.pose.rotation @ (other.pose.center - one.pose.center)
    rays_b = np.ascontiguousarray(rays_b)
    return distances_in_front(_essential(one, other), rays_a, rays_b, scales_a, scales_b, turn, between)


def rays_of(found: Candidates, first: Reading, second: Reading, known: Rays = (None, None)) -> tuple[Array, Array]:
    """Return the rays (n, 3) of A's detections and (1 + s, n, k, 3) of B's, each in its camera's frame."""
    rays_a, rays_b = known
    if rays_a is None:
        rays_a = first.rays(found.pixels_a)
    if rays_b is None:
        rays_b = second.rays(found.pixels_b.reshape(-1, 2)).reshape(*found.pixels_b.shape[:3], 3)
    return rays_a, rays_b


def signed_distances(first: Camera, second: Camera, pixels_a: Array, pixels_b: Array) -> Array:
    """Return the distances (n,) of the rays of pixels (n, 2) and (n, 2) in standard deviations, with their sign."""
    return signed_of_rays(first, second, first.rays(pixels_a), second.rays(pixels_b))


def signed_of_rays(first: Camera, second: Camera, rays_a: Array, rays_b: Array) -> Array:
    """Return the distances (...,) of rays (..., 3) in standard deviations, with their sign."""
    return sampson_distances(_essential(first, second), rays_a, rays_b, *_scales(first, second)).signed


def _essential(first: Camera, second: Camera) -> Array:
    return essential_matrices(first.pose.rotation, first.pose.center, second.pose.rotation, second.pose.center)


def _scales(first: Camera, second: Camera) -> list[Array]:
    """Noise's worth of a unit of slope, of both cameras."""
    return [np.array([camera.fx, camera.fy]) / camera.detector.sigma for camera in (first, second)]


def nearest(found: Candidates, first: Reading, second: Reading, known: Rays = (None, None)) -> Array:
    """Return the distances (1 + s, n) from the nearest ray of B, in standard deviations (`known`: see `distances`)."""
    return np.asarray(np.abs(distances(found, first, second, known)[0]).min(axis=2))


def meeting(least: Array, tolerances: tuple[float, ...] = TOLERANCES) -> Meeting:
    """Return how often the rays of `nearest` meet, at the tolerance with the highest score."""
    count = len(least[0])
    meets = least <= np.array(tolerances)[:, None, None]
    shares = meets.mean(axis=2)
    chances, stds = shares[:, 1:].mean(axis=1), shares[:, 1:].std(axis=1, ddof=1)
    excesses = (shares[:, 0] - chances) / np.maximum(1.0 - chances, 1e-9)
    spreads = np.hypot(stds, np.sqrt(np.maximum(chances * (1.0 - chances), 0.25 / count) / count))
    scores = (shares[:, 0] - chances) / np.maximum(spreads, 1e-9)
    best = int(np.argmax(scores))
    share, chance, excess, score = np.stack([shares[:, 0], chances, excesses, scores])[:, best].tolist()
    return Meeting(share, chance, excess, score, tolerances[best], float(excesses.mean()), meets[best])


def expected_excess(found: Candidates, samples: list[CameraSample], depths: tuple[float, float]) -> float:
    """Return the excess that the configuration promises: objects among A's detections, in view of B and detected there.

    Objects are expected between the two depths before A, length.
    """
    first, second = samples[found.a], samples[found.b]
    rate = first.detections_per_frame
    objects = float(np.clip(1.0 - first.camera.detector.clutter_per_frame / max(rate, 1e-9), 0.0, 1.0))
    rays = Reading(first.camera).rays(found.pixels_a)
    directions = rays @ first.camera.pose.rotation
    seen = [
        second.camera.in_view(first.camera.pose.center + depth * directions)
        for depth in np.geomspace(*depths, 9).tolist()
    ]
    return objects * float(np.mean(seen)) * second.camera.detector.p_detect


# A pair below this share of what the configuration promises, or below this score, is suspicious.
SUSPICIOUS_SHARE, SUSPICIOUS_SCORE = 0.7, 4.0
# From this score on rays meet beyond doubt.
LEAST_SCORE = 6.0
# Above this share of partners by chance, shifted times show nothing.
MOST_CHANCE = 0.6
# Rays that meet within one standard deviation over those that meet within three (0.68 if all is right), below which
# something is slightly wrong, and the tolerance at which alternatives are then compared.
SHARP_SHARE = 0.55
SHARP = (1.0,)
# Below this expected excess the fields of view of a pair hardly overlap, and the pair cannot be checked.
LEAST_EXPECTED = 0.15
# Pairs of cameras that are examined at most: all of 25 cameras.
MOST_PAIRS = 300


@dataclass(frozen=True)
class Geometry:
    """How often the rays of each pair of cameras meet."""

    samples: list[CameraSample]
    pairs: tuple[Candidates, ...]
    given: tuple[Meeting, ...]  # How well rays meet for every pair, with the cameras as stated
    expected: tuple[float, ...]  # Excess that the configuration promises, pair by pair

    @property
    def views(self) -> list[Reading]:
        """The cameras as stated."""
        return [Reading(sample.camera) for sample in self.samples]

    @cached_property
    def rays(self) -> list[tuple[Array, Array]]:
        """The rays of every pair, with the cameras as stated (see `rays_of`)."""
        views = self.views
        return [rays_of(pair, views[pair.a], views[pair.b]) for pair in self.pairs]

    @cached_property
    def given_at(self) -> Callable[[int, float], Meeting]:
        """How well rays of a pair, by its number, meet at one tolerance, with the cameras as stated."""
        pairs, rays, views = self.pairs, self.rays, self.views  # with self in it, it would keep itself alive
        least = cache(lambda k: nearest(p := pairs[k], views[p.a], views[p.b], rays[k]))
        return cache(lambda k, tolerance: meeting(least(k), (tolerance,)))

    @cached_property
    def is_suspicious(self) -> bool:
        """Whether fewer rays of a pair meet than the configuration promises, or no more than by chance.

        Wrong poses may promise nothing, so a pair that meets by chance only is suspicious in any case.
        """
        for k, (found, expected) in enumerate(zip(self.given, self.expected, strict=True)):
            # those of slow objects meet by chance at a wide tolerance, whatever their clocks
            met = self.given_at(k, TOLERANCES[0]) if found.chance > MOST_CHANCE else found
            is_few = expected >= LEAST_EXPECTED and met.excess < SUSPICIOUS_SHARE * expected
            if min(met.chance, met.share) <= MOST_CHANCE and (is_few or met.score < SUSPICIOUS_SCORE):
                return True
        return False

    def is_blurred(self) -> bool:
        """Whether rays meet, but by less than the noise of the detections allows: something is slightly off."""
        met = [k for k, given in enumerate(self.given) if given.score >= LEAST_SCORE]
        tight, wide = ([self.given_at(k, tolerance).excess for k in met] for tolerance in (SHARP[0], TOLERANCES[0]))
        return any(t < SHARP_SHARE * w for t, w in zip(tight, wide, strict=True))


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Return the pairs of cameras that are examined: all, or of many cameras each with those next to it in their order.

    The time of the checks would grow with the square of the number of cameras.
    """
    if count * (count - 1) // 2 <= MOST_PAIRS:
        return list(combinations(range(count), 2))
    steps = range(1, max(1, MOST_PAIRS // count) + 1)
    return sorted({(min(a, b), max(a, b)) for step in steps for a in range(count) for b in [(a + step) % count]})


def measure(samples: list[CameraSample], depths: tuple[float, float]) -> Geometry:
    """Measure how often rays of every pair of cameras meet; objects are expected between the two depths, length."""
    most = MOST_DETECTIONS if len(samples) < 4 else MOST_DETECTIONS // 2
    found = (candidates(samples, a, b, most) for a, b in pairs_of(len(samples)))
    pairs = tuple(pair for pair in found if pair is not None)
    expected = tuple(expected_excess(pair, samples, depths) for pair in pairs)
    views = [Reading(sample.camera) for sample in samples]
    given = tuple(meeting(nearest(pair, views[pair.a], views[pair.b])) for pair in pairs)
    return Geometry(samples, pairs, given, expected)
