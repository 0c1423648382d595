"""Noise of the detectors from the rays alone: by how much the rays of one object miss each other.

The distances of the detections of two cameras from meeting, in pixels, are those of one object (half-normal, with the
noise of both cameras) or of two. The density of the latter is measured, in two ways: from rays that are moved
elsewhere, at the same and at other times, as those of false detections are, and from the rays that one camera would
have of the other's detections, as those of objects that both see. By these, neighbours that stay together (a rigid
board, a flock, objects at rest) are no partners. The likelihood of a noise (`mixture`) needs neither a depth nor a
first guess, and holds from a tenth of a pixel to a hundred. In a crowd rays say little: there displacements between
frames tell more (`displacements`).

Where cameras take their frames at different times, objects move between them, and that movement is no noise. Its size
is unknown, and is integrated out. What it may be is shown by the same pair without the frame that is nearest: there it
counts for several times as much, and the noise does not.

The likelihoods of all pairs, those of displacements, and the noise about one-camera tracks, which that of the rays of
right cameras resembles, are joined in the noise of the cameras and one speed. The prior of a detector's noise is
log-normal, 68 % between 0.4 and 8 px, and the cameras of one log resemble each other. The answer is the mean of draws
from the posterior of all cameras together, and its error their spread: a pair tells only the sum of two variances. A
camera with little data takes its value from the others, and without any data the answer is the prior's median.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.numerics.random_streams import RAY_NOISE_SEED
from stereophd.core.two_views.epipolar import nearest_depths
from stereophd.pipeline.checks.geometry import rays
from stereophd.pipeline.checks.log.sample import CameraSample
from stereophd.pipeline.detectors.displacements import PRIOR, likelihoods_of_displacements
from stereophd.pipeline.detectors.mixture import MOST_EVIDENCE, NOISES, DistanceKind, classes, unmix
from stereophd.pipeline.detectors.statistics import BETWEEN_CAMERAS, USUAL_P_DETECT, NoisePrior

# The prior: the noise of one detector, px, and the spread of its logarithm.
USUAL_NOISE_PX, NOISE_SPREAD = 1.7, 1.5
# Share of the detections that are false, and their number in a frame at least, to begin with: where noise or motion
# outrun one-camera tracks nothing shows it, and with too many no track is found that would show there are fewer.
USUAL_FALSE, LEAST_CLUTTER = 0.1, 0.02
# Detections of a pair that are examined at most, and distances of them all, those of chance included, of one pair and
# of all pairs; times that measure chance, by the detections of a frame; and detections of a frame that others are
# compared with.
MOST_DETECTIONS, MOST_DISTANCES, MOST_OF_ALL = 1000, 1_500_000, 8_000_000
SHIFTS, FEW_SHIFTS, CROWD, OWNERS = 8, 2, 50, 4
# Distances of rays, and shares of their density that are distances of neighbours.
RAYS, SHARES = DistanceKind(1, 0.3, 0.01, 0.5, 0.0), (0.0, 0.5, 1.0)
# Draws from the posterior.
DRAWS, LEAST_DRAWS = 3000, 50
# Spread of the logarithm of the noise of rays over that about one-camera tracks: errors that last, and links of chance.
LASTING_SPREAD = 0.7
# Evidence of partners in nearer frames over that along tracks, from which tracks are wrong.
CLEARER = 1.5


@dataclass(frozen=True)
class _PairEvidence:
    """The evidence of one pair of cameras about the standard deviation of distances between rays of one object."""

    shares: Array  # (2,): of that variance, by the squared noise of either camera
    motion: Array  # (powers,): in proportion to the variance that motion between frames adds to it; 0 within frames
    likelihoods: Array  # (noises,): logarithm, of this standard deviation, px; the largest is 0
    gain: float  # Log-likelihood of the best of them over that without partners

    def of_spread(self, variance: Array) -> Array:
        """Return the log-likelihood (...,) of variances (...,) of distances, px^2."""
        return np.asarray(np.interp(0.5 * np.log(variance), np.log(NOISES), self.likelihoods))


def noise_from_rays(samples: Sequence[CameraSample], are_placed: bool = True) -> tuple[Array, Array]:
    """Return the noise (cameras,) of two or more cameras, px, and the standard deviations of its logarithm.

    They follow from how their rays miss each other's, each camera alone, and the prior; the detectors that are stated
    are not used. Rays of cameras that are not placed right (`are_placed`) tell nothing.
    """
    unit = [sample.with_camera(sample.camera.with_noise(1.0)) for sample in samples]
    pairs = rays.pairs_of(len(unit)) if are_placed else []
    most = min(MOST_DISTANCES, MOST_OF_ALL // max(len(pairs), 1))
    evidence = {(a, b): pair for a, b in pairs if (pair := _evidence(unit, a, b, most)) is not None}
    # pairs share detections: an object that n cameras see has 2 n - 3 independent distances, and n (n - 1) / 2 pairs
    independent = min(1.0, (2 * len(samples) - 3) / max(len(pairs), 1))
    # the fewer the objects, the less shows how far apart different ones are
    crowds = [sample.detections_per_frame / (sample.detections_per_frame + CROWD) for sample in samples]
    links = [
        share * likelihoods_of_displacements(sample) + _told_by_tracks(sample)[:, None]
        for share, sample in zip(crowds, samples, strict=True)
    ]
    of_both = {
        cameras: independent * pair.of_spread(pair.shares[0] * NOISES[:, None] ** 2 + pair.shares[1] * NOISES**2)
        for cameras, pair in evidence.items()
    }
    logs = _draws(of_both, links)
    spacing = float(np.log(NOISES[1] / NOISES[0]))
    return np.exp(logs.mean(axis=0)), np.sqrt(logs.var(axis=0) + spacing**2 / 12.0)


def _told_by_tracks(sample: CameraSample) -> Array:
    """Return the log-likelihood (noises,) of the noise of a camera, from that about its one-camera tracks."""
    measured = sample.measured_noise_px
    return np.zeros(len(NOISES)) if measured is None else -0.5 * (np.log(NOISES / measured) / LASTING_SPREAD) ** 2


def _draws(likelihoods: dict[tuple[int, int], Array], links: Sequence[Array]) -> Array:
    """Return draws (d, cameras) of the logarithm of the noise of all cameras: of two at a time, given the others.

    `likelihoods` are those of two cameras (noises, noises), `links` of a camera and of the speed (noises, turns).
    """
    count, turn = len(links), int(PRIOR.argmax())
    rng, logs, usual = np.random.default_rng(RAY_NOISE_SEED), np.log(NOISES), float(np.log(USUAL_NOISE_PX))
    of_either = likelihoods | {(b, a): table.T for (a, b), table in likelihoods.items()}
    state, draws, pairs = [int(np.abs(logs - usual).argmin())] * count, [], rays.pairs_of(count)
    precision = NOISE_SPREAD**-2 + (count - 2) * BETWEEN_CAMERAS**-2
    inverse = np.linalg.inv(np.full((2, 2), 1.0 / precision) + BETWEEN_CAMERAS**2 * np.eye(2))

    @lru_cache  # few states are probable, which come again and again
    def of_two(a: int, b: int, turn: int, others: tuple[tuple[int, int], ...]) -> Array:
        mean = (usual * NOISE_SPREAD**-2 + logs[[s for _, s in others]].sum() * BETWEEN_CAMERAS**-2) / precision
        apart = logs - mean
        alone = 0.5 * inverse[0, 0] * apart**2
        shared = {c: sum(of_either[c, k][:, s] for k, s in others if (c, k) in of_either) for c in (a, b)}
        first, second = (links[c][:, turn] + shared[c] - alone for c in (a, b))
        both = likelihoods.get((a, b), 0.0) - inverse[0, 1] * apart[:, None] * apart
        return _summed(both + first[:, None] + second)

    for _ in range(max(LEAST_DRAWS, DRAWS // len(pairs))):
        for a, b in pairs:
            others = tuple((k, s) for k, s in enumerate(state) if k not in (a, b))
            state[a], state[b] = divmod(_drawn(rng, of_two(a, b, turn, others)), len(logs))
        turn = _drawn(rng, _summed(PRIOR + np.sum([table[k] for table, k in zip(links, state, strict=True)], axis=0)))
        draws.append(logs[state])
    return np.array(draws[len(draws) // 5 :])


def _summed(likelihoods: Array) -> Array:
    return np.asarray(np.exp(likelihoods - likelihoods.max()).cumsum())


def _drawn(rng: np.random.Generator, summed: Array) -> int:
    """Return the index of a draw, from sums of probabilities up to each, in proportion."""
    return int(np.searchsorted(summed, rng.random() * summed[-1]))


def are_compared(samples: Sequence[CameraSample]) -> bool:
    """Whether cameras can be compared: two at least have detections, and none moves."""
    stand_still = all(sample.camera.pose.is_static for sample in samples)
    return stand_still and sum(len(sample.pixels) > 0 for sample in samples) > 1


def starting_detectors(
    cameras: Sequence[Camera], estimated: Collection[str], samples: Sequence[CameraSample], are_placed: bool = True
) -> tuple[tuple[Camera, ...], dict[str, NoisePrior]]:
    """Return cameras with detectors to begin a first tracking run with, and what is known of their noise by then.

    The detectors of the cameras of `estimated` names are those that are replaced. Where poses are not known or wrong
    (not `are_placed`), and where no cameras can be compared, each camera alone shows its noise, and what is false where
    one-camera tracks hold. Without detections, and of one camera, the noise is as the detectors have it.
    """
    noise, spreads = np.array([camera.detector.sigma for camera in cameras]), np.full(len(cameras), NOISE_SPREAD)
    are_placed &= are_compared(samples)
    if len(samples) > 1 and any(len(sample.pixels) for sample in samples):
        noise, spreads = noise_from_rays(samples, are_placed)
    used, priors = [], {}
    for k, camera in enumerate(cameras):
        if camera.name in estimated:
            prior = priors[camera.name] = NoisePrior(np.array(np.broadcast_to(noise[k], 2)), float(spreads[k]))
            # no other tracks correct it where cameras are not placed
            shows = not are_placed and samples[k].measured_noise_px is not None
            false = samples[k].isolated_per_frame if shows else USUAL_FALSE * samples[k].detections_per_frame
            camera = replace(camera, detector=Detector(prior.noise, USUAL_P_DETECT, max(false, LEAST_CLUTTER)))
        used.append(camera)
    return tuple(used), priors


def _evidence(samples: list[CameraSample], a: int, b: int, most: int) -> _PairEvidence | None:
    """Return what a pair of cameras with a noise of 1 px says, of so many distances; None where they share no frames.

    Between frames, detections are where one-camera tracks lead, or where the nearer frame has them: tracks are wrong in
    a crowd, and frames where objects move by more than their noise. Frames count if they show far more partners.
    """
    nearest = _read(samples, a, b, most, 0)
    if nearest is None or not nearest.motion.any():
        return nearest
    steps, found = 1, _read(samples, a, b, most, 1)
    if found is None or nearest.gain > CLEARER * max(found.gain, MOST_EVIDENCE):
        steps, found = 0, nearest
    farther = _read(samples, a, b, most, 2 * steps, farther=True)
    return None if farther is None else _without_motion(found, farther)


def _frames(sample: CameraSample, times: Array, steps: int, farther: bool) -> Integers:
    """Return the frames from which lines over so many steps lead to times (n,), s, or those of the next farther lines.

    These go from the frame before the nearest one to that after it, or stay on the other side of the nearest one.
    """
    frame, passed = sample.around(times)
    nearest = frame + (passed > 0.5)
    if not farther:
        return frame if steps else nearest
    away = nearest - 1 if steps else nearest + np.where(sample.times[nearest] > times, 1, -1)
    return np.asarray(away.clip(0, len(sample.times) - 1 - steps))


def _without_motion(found: _PairEvidence, farther: _PairEvidence) -> _PairEvidence:
    """Return what a pair says with the motion between the frames of B integrated out.

    Farther from B's frames motion counts for more: what that shows of it, given the noise, is its prior. Any size is as
    probable before, and so are both powers of time by which it grows.
    """
    noise, motion, shares = NOISES[:, None] ** 2, NOISES**2, found.motion / farther.motion
    shown = farther.of_spread(noise + motion)
    shown = shown - np.logaddexp.reduce(shown, axis=1)[:, None]
    told = shown + found.of_spread(noise + shares[:, None, None] * motion)
    likelihoods = np.logaddexp.reduce(np.logaddexp.reduce(told, axis=2), axis=0)
    return replace(found, likelihoods=likelihoods - likelihoods.max())


def _read(
    samples: list[CameraSample], a: int, b: int, most: int, steps: int, farther: bool = False
) -> _PairEvidence | None:
    """Return what a pair of cameras says with B's detections on lines over so many steps (see `_frames`)."""
    if len(samples[b].times) <= steps:
        return None

    def places(sample: CameraSample, times: Array) -> Array:
        return rays.pixels_along(sample, times, _frames(sample, times, steps, farther), steps)

    shifts = SHIFTS if samples[b].detections_per_frame < CROWD else FEW_SHIFTS
    pair = rays.candidates(samples, a, b, MOST_DETECTIONS, shifts, most, places)
    if pair is None:
        return None
    first, second = rays.Reading(samples[a].camera), rays.Reading(samples[b].camera)
    known = rays.rays_of(pair, first, second)
    missed = rays.distances(pair, first, second, known)[0][0]
    by_chance = rays.distances(pair.elsewhere(first.camera), first, second, (None, known[1]))[0][1:]
    neighbours = _neighbours(first.camera, second.camera, known[0], known[1][0], np.isfinite(missed))
    with np.errstate(invalid="ignore", divide="ignore"):
        by_a = rays.distances(pair, first, rays.Reading(second.camera.with_noise(1e-6)), known)[0][0]
        shares = (missed / by_a) ** 2
    usable = np.isfinite(missed) & np.isfinite(shares)
    if not usable.any():
        return None
    share_a = float(shares[usable].mean())
    before = _frames(samples[b], pair.times, steps, farther)
    since, span = pair.times - samples[b].times[before], samples[b].times[before + steps] - samples[b].times[before]
    late = 0.5 * samples[b].camera.readout_s  # rows are read after the time of their frame
    if steps:
        # means of two frames; what objects turn by between them grows with the third power of time or the fourth
        part = np.clip(since / np.maximum(span, 1e-12), 0.0, 1.0) - late / np.maximum(span, 1e-12)
        kept = float((part**2 + (1.0 - part) ** 2).mean())
        motion = np.array([((part * (1.0 - part)) ** 2 * span**power).mean() for power in (3, 4)])
    else:
        kept, motion = 1.0, np.array([((since - late) ** 2).mean()])
    apart = classes(by_chance)
    chance, near = RAYS.background(apart), RAYS.background(neighbours)
    foreign = [share * near + (1.0 - share) * chance for share in SHARES]
    found = unmix(RAYS, classes(missed), foreign, float(apart.sum()), len(pair.detections))
    shares = np.array([share_a, (1.0 - share_a) * kept])
    return _PairEvidence(shares, motion, found.likelihoods, found.gain)


def _neighbours(first: Camera, second: Camera, rays_a: Array, rays_b: Array, met: Booleans) -> Array:
    """Return the numbers (classes,) of distances of the detections of a frame of B from rays that A has of others.

    Of every ray (n, 3) of A a few of the detections (n, k, 3) that it can meet are seen where it passes them nearest.
    """
    pose_a, pose_b = first.pose, second.pose
    found = classes(np.empty(0))
    for column in np.linspace(0, rays_b.shape[1], OWNERS, endpoint=False).astype(int):
        owner = (column + np.arange(len(rays_a))) % rays_b.shape[1]
        rows = np.flatnonzero(met[np.arange(len(rays_a)), owner])
        owner = owner[rows]
        direction = rays_b[rows, owner] @ pose_b.rotation
        depth = nearest_depths(rays_a[rows] @ pose_a.rotation, direction, pose_b.center - pose_a.center)[1]
        seen = (pose_b.center + depth[:, None] * direction - pose_a.center) @ pose_a.rotation.T
        apart = rays.signed_of_rays(first, second, (seen / seen[:, 2:])[:, None], rays_b[rows])
        apart[~met[rows]] = np.nan
        apart[np.arange(len(rows)), owner] = np.nan
        found += classes(apart)
    return found
