"""Noise of the detectors from the rays alone: by how much the rays of one object miss each other.

The signed distances of the detections of two cameras from meeting, in pixels, are those of one object (half-normal,
with the noise of both cameras) or of two objects. These are as at other times, when the same rays meet by chance, or as
neighbours are: a group that stays together (a rigid board, a flock, objects at rest) gives every partner the same
neighbours all the time. By how much a ray misses two detections of one frame differs by their distance across it,
whatever the noise, so neighbours are measured and not modelled. The likelihood of this mixture over the noise of a pair
needs neither a track, a depth nor a first guess, and holds from a tenth of a pixel to a hundred. At most one detection
of the other camera is of the same object, which bounds the share of the first kind, and neighbours come with a partner,
which bounds their number: without these bounds any difference between the densities would pass for objects of large
noise, and large noise for neighbours.

The likelihoods of all pairs are joined in the noise of the cameras. A prior says what detectors are like: log-normal,
90 % between 0.3 and 10 px, and the cameras of one log resemble each other. A camera with little data takes its value
from the others, and without any data the answer is the prior's median.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.pipeline.checks.geometry.rays import (
    Candidates,
    Reading,
    candidates,
    distances,
    pairs_of,
    pixels_at,
    pixels_near,
    rays_of,
    signed_of_rays,
)
from stereophd.pipeline.checks.log.sample import CameraSample
from stereophd.pipeline.detectors.statistics import USUAL_P_DETECT, NoisePrior

# The prior: the noise of one detector, px, the spread of its logarithm, and that between the cameras of one log.
USUAL_NOISE_PX, NOISE_SPREAD, BETWEEN_CAMERAS = 1.7, 1.07, 0.4
# False detections of a frame to begin with: no detector is free of them, and births need some to compete with.
LEAST_CLUTTER = 0.02
# Frames of each camera that are looked at.
SAMPLE_FRAMES = 1500
# Noises that are tried, px, and borders between classes of distances, px.
NOISES = np.geomspace(0.03, 300.0, 90)
BORDERS = np.concatenate([[0.0], np.geomspace(0.01, 10_000.0, 110)])
# Detections of a pair that are examined at most, and distances of them all, those of chance included, of one pair and
# of all pairs; times that measure chance, by the detections of a frame; and distances between detections of a frame.
MOST_DETECTIONS, MOST_DISTANCES, MOST_OF_ALL = 1000, 1_500_000, 8_000_000
SHIFTS, FEW_SHIFTS, CROWD, MOST_STEPS = 8, 2, 50, 40
# Error of the density of distances of different objects, as a share of it: where these are many, they tell no more.
BACKGROUND_ERROR = 0.02
# Rounds of the share of partners, and of the cameras in turn.
SHARE_ROUNDS, CAMERA_ROUNDS, SETTLED = 40, 20, 1e-3
# Detections that have a partner, at most.
MOST_PARTNERS = 0.95
# Log-likelihood that one pair of cameras may weigh: detections of one object are not independent, and the chance of a
# single pair may look like noise of another size.
MOST_EVIDENCE = 20.0
# Evidence of partners in nearer frames over that along tracks, from which tracks are wrong.
CLEARER = 1.5
# Distances of chance, number and share, below which their density counts as even.
EVEN_COUNT, EVEN_SHARE = 50, 0.001
# Share of the detections among neighbours that has a partner within the noise, at least. Without that bound large noise
# would pass for neighbours.
LEAST_PARTNERS = 0.25

# Where the detections of a camera are at times (n,): pixels (n, k, 2).
Places = Callable[[CameraSample, Array], Array]


@dataclass(frozen=True)
class RayNoise:
    """Noise of the detectors of a log."""

    sigma_px: Array  # (cameras,): posterior mean of its logarithm
    relative_error: Array  # (cameras,): standard deviation of that logarithm
    partners: float  # detections that met one of another camera beyond chance


@dataclass(frozen=True)
class _PairEvidence:
    """The evidence of one pair of cameras about the standard deviation of distances between rays of one object."""

    cameras: tuple[int, int]
    shares: Array  # (2,): of that variance, by the squared noise of either camera
    likelihoods: Array  # (noises,): logarithm, of this standard deviation, px; the largest is 0
    partners: float
    gain: float  # Log-likelihood of the best of them over that without partners

    def of_camera(self, camera: int, logs: Array) -> Array:
        """Return the log-likelihood (noises,) of the noise of one camera, with the logarithms of the others' noise."""
        own = self.cameras.index(camera)
        variance = self.shares[own] * NOISES**2 + self.shares[1 - own] * np.exp(2.0 * logs[self.cameras[1 - own]])
        return np.asarray(np.interp(0.5 * np.log(variance), np.log(NOISES), self.likelihoods))

    def of_all(self) -> Array:
        """Return the log-likelihood (noises,) of a noise that both cameras have."""
        variance = self.shares.sum() * NOISES**2
        return np.asarray(np.interp(0.5 * np.log(variance), np.log(NOISES), self.likelihoods))


def noise_from_rays(samples: Sequence[CameraSample]) -> RayNoise:
    """Return the noise of every camera, from how its rays miss those of the others, and the prior.

    Parameters
    ----------
    samples : sequence of CameraSample
        Frames of every camera; the stated detectors are not used.
    """
    unit = [replace(sample, camera=with_noise(sample.camera, 1.0)) for sample in samples]
    pairs = pairs_of(len(unit))
    most = min(MOST_DISTANCES, MOST_OF_ALL // max(len(pairs), 1))
    evidence = [pair for a, b in pairs if (pair := _evidence(unit, a, b, most)) is not None]
    usual = float(np.log(USUAL_NOISE_PX))
    # pairs share detections: an object that n cameras see has 2 n - 3 independent distances, and n (n - 1) / 2 pairs
    independent = min(1.0, (2 * len(samples) - 3) / max(len(pairs), 1))
    start = sum((independent * pair.of_all() for pair in evidence), _prior(usual, NOISE_SPREAD))
    values = np.full(len(samples), _posterior(start)[0])
    spreads = np.full(len(samples), NOISE_SPREAD)
    for _ in range(CAMERA_ROUNDS):
        before = values.copy()
        for camera in range(len(samples)):
            others = np.delete(values, camera)
            precision = NOISE_SPREAD**-2 + len(others) * BETWEEN_CAMERAS**-2
            mean = (usual * NOISE_SPREAD**-2 + others.sum() * BETWEEN_CAMERAS**-2) / precision
            total = _prior(mean, float(np.sqrt(BETWEEN_CAMERAS**2 + 1.0 / precision)))
            for pair in evidence:
                if camera in pair.cameras:
                    total = total + independent * pair.of_camera(camera, values)
            values[camera], spreads[camera] = _posterior(total)
        if np.abs(values - before).max() < SETTLED:
            break
    return RayNoise(np.exp(values), spreads, sum(pair.partners for pair in evidence))


def starting_detectors(
    cameras: Sequence[Camera], estimated: Collection[str], samples: Sequence[CameraSample]
) -> tuple[tuple[Camera, ...], dict[str, NoisePrior]]:
    """Return cameras with detectors to begin a first tracking run with, and what is known of their noise by then.

    Where the rays cannot be compared (one camera, cameras that move), the noise is as the detectors have it.

    Parameters
    ----------
    cameras : sequence of Camera
    estimated : collection of str
        Names of the cameras whose detectors are estimated.
    samples : sequence of CameraSample
        Frames of all cameras.
    """
    resting = len(cameras) > 1 and all(camera.pose.is_static for camera in cameras)
    noise = noise_from_rays(samples) if resting else RayNoise(np.empty(0), np.empty(0), 0.0)
    used, priors = [], {}
    for k, camera in enumerate(cameras):
        given = camera.detector
        if camera.name in estimated:
            sigma, spread = np.asarray(given.sigma), NOISE_SPREAD
            if noise.partners > 0.0:
                sigma, spread = np.full(2, noise.sigma_px[k]), float(noise.relative_error[k])
            priors[camera.name] = NoisePrior(sigma, spread)
            clutter = max(samples[k].isolated_per_frame, LEAST_CLUTTER)
            camera = replace(camera, detector=Detector(sigma, USUAL_P_DETECT, clutter))
        used.append(camera)
    return tuple(used), priors


def with_noise(camera: Camera, sigma_px: float) -> Camera:
    """Return a camera with another noise of its detector, px."""
    detector = camera.detector
    return replace(camera, detector=Detector((sigma_px, sigma_px), detector.p_detect, detector.clutter_per_frame))


def _prior(mean: float, spread: float) -> Array:
    """Logarithm of a log-normal density at the noises that are tried."""
    return np.asarray(-0.5 * ((np.log(NOISES) - mean) / spread) ** 2)


def _posterior(total: Array) -> tuple[float, float]:
    """Return the mean and the standard deviation of the logarithm of the noise."""
    weights = np.exp(total - total.max())
    weights /= weights.sum()
    logs = np.log(NOISES)
    mean = float(weights @ logs)
    return mean, float(np.sqrt(weights @ (logs - mean) ** 2))


def _evidence(samples: list[CameraSample], a: int, b: int, most: int) -> _PairEvidence | None:
    """Return what a pair of cameras with a noise of 1 px says, of so many distances; None where they share no frames.

    Between frames, detections are where one-camera tracks lead, or where the nearer frame has them: tracks are wrong in
    a crowd, and frames where objects move by more than their noise. Frames count if they show far more partners.
    """
    tracked, nearest = (_read(samples, a, b, most, places) for places in (pixels_at, pixels_near))
    if tracked is None or nearest is None:
        return tracked
    return nearest if nearest.gain > CLEARER * max(tracked.gain, MOST_EVIDENCE) else tracked


def _read(samples: list[CameraSample], a: int, b: int, most: int, places: Places) -> _PairEvidence | None:
    """Return what a pair of cameras says by one way to place detections between frames."""
    shifts = SHIFTS if samples[b].detections_per_frame < CROWD else FEW_SHIFTS
    pair = candidates(samples, a, b, MOST_DETECTIONS, shifts, most, places)
    if pair is None:
        return None
    first, second = Reading(samples[a].camera), Reading(samples[b].camera)
    known = rays_of(pair, first, second)
    missed = distances(pair, first, second, known)[0][0]
    by_chance = distances(pair.elsewhere(first.camera), first, second, (None, known[1]))[0][1:]
    signed = signed_of_rays(first.camera, second.camera, known[0][:, None], known[1][0])
    signed[~np.isfinite(missed)] = np.nan
    steps = np.unique(np.linspace(1, max(signed.shape[1] - 1, 1), MOST_STEPS).astype(int)).tolist()
    neighbours = sum((_classes(np.abs(signed[:, k:] - signed[:, :-k])) for k in steps), np.zeros(len(BORDERS) - 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        by_a = distances(pair, first, Reading(with_noise(second.camera, 1e-6)), known)[0][0]
        shares = (missed / by_a) ** 2
    usable = np.isfinite(missed) & np.isfinite(shares)
    if not usable.any():
        return None
    share_a = float(shares[usable].mean())
    kept = _kept(pair, samples[b]) if places is pixels_at else 1.0
    found = _mixture(_classes(missed), neighbours, _classes(by_chance), len(pair.detections))
    return _PairEvidence((a, b), np.array([share_a, (1.0 - share_a) * kept]), *found)


def _kept(pair: Candidates, second: CameraSample) -> float:
    """Return the share of B's noise that is left in its places at A's times: between frames they are means."""
    interval = (np.searchsorted(second.times, pair.times, side="right") - 1).clip(0, len(second.times) - 2)
    span = np.maximum(second.times[interval + 1] - second.times[interval], 1e-12)
    weight = np.clip((pair.times - second.times[interval]) / span, 0.0, 1.0)
    return float((weight**2 + (1.0 - weight) ** 2).mean())


def _classes(missed: Array) -> Array:
    """Return the numbers of distances between the borders."""
    return np.histogram(missed[np.isfinite(missed)], BORDERS)[0].astype(np.float64)


def _mixture(together: Array, neighbours: Array, apart: Array, count: int) -> tuple[Array, float, float]:
    """Return the log-likelihood (noises,) of the noise of partners among distances, their number, and its gain.

    Parameters
    ----------
    together, neighbours, apart : arrays (classes,)
        Numbers of distances at the same time, between the detections of a frame, and at other times.
    count : int
        Detections that have at most one partner each.
    """
    own = _half_normal(NOISES)
    others = np.stack([_background(neighbours), _background(apart)])
    total = max(float(together.sum()), 1.0)
    most = MOST_PARTNERS * min(count, total)
    most_neighbours = max(total / count - 1.0, 0.0) / LEAST_PARTNERS
    # the error of the density in a class is that of all distances as small
    weights = 1.0 / (1.0 + BACKGROUND_ERROR**2 * np.cumsum(together))
    # begun near the answer: where partners are few, rounds change their number slowly
    excess = (weights * (together - total * others[1]) * own).sum(axis=1) / (weights * own**2).sum(axis=1)
    partners = np.clip(excess, 0.01 * most, most)
    rates = np.stack([0.1 * np.minimum(total, most_neighbours * partners), np.full(len(NOISES), total)], axis=1)
    for _ in range(SHARE_ROUNDS):
        ratio = weights * together / (partners[:, None] * own + rates @ others)
        rates = rates * (ratio @ others.T) / (others @ weights)
        partners = np.minimum(partners * (ratio * own).sum(axis=1) / (own @ weights), most)
        rates[:, 0] = np.minimum(rates[:, 0], most_neighbours * partners)
    expected = partners[:, None] * own + rates @ others
    likelihoods = (weights * (together * np.log(expected) - expected)).sum(axis=1)
    best = int(likelihoods.argmax())
    alone = float((weights * together).sum() / (weights * others[1]).sum()) * others[1]
    gain = float(likelihoods[best] - (weights * (together * np.log(alone) - alone)).sum())
    return np.logaddexp(likelihoods - likelihoods[best], -MOST_EVIDENCE), float(partners[best]), gain


def _background(apart: Array) -> Array:
    """Return the probability (classes,) of each class of distances of different objects.

    It is even near 0, as far as it takes for enough distances.
    """
    widths = np.diff(BORDERS)
    near = np.cumsum(apart) <= max(EVEN_COUNT, EVEN_SHARE * apart.sum())
    smooth = np.where(near, apart[near].sum() * widths / max(float(widths[near].sum()), 1e-300), apart)
    return np.asarray((smooth + widths / widths.sum()) / (smooth.sum() + 1.0))


def _half_normal(spreads: Array) -> Array:
    """Return the probability (s, classes) of each class of distances of these standard deviations (s,), px."""
    from scipy.special import erf  # costly to import

    below = erf(BORDERS / (np.sqrt(2.0) * spreads[:, None]))
    return np.asarray(np.maximum(np.diff(below, axis=1), 1e-300))
