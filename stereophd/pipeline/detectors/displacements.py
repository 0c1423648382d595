"""Noise and motion from the displacements between frames of one camera, in crowds too.

Detections of one object in two frames lie apart by the noise of both and by its motion. In a crowd most pairs of
detections are of different objects. The pairs of one frame show how many of these lie at which distance, and the rest
is of one object, although it is not known which pairs these are (`mixture`). Over more frames the motion grows, because
velocities last, and the noise does not: this separates the two.

The result for a camera is a table of likelihoods of its noise and of the speed across the line of sight over the depth,
which is the same for all cameras but for a factor. One object is in many pairs. Where they stand out, several steps
repeat the information of one step; where strangers hide them, each step adds information.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from stereophd.core.arrays import Array
from stereophd.pipeline.checks.log.sample import LEAST_DIFFERENCES, MOST_BY_CHANCE, VARIANCE_ERROR, CameraSample
from stereophd.pipeline.detectors.mixture import BORDERS, NOISES, DistanceKind, Mixture, classes, unmix
from stereophd.pipeline.detectors.statistics import BETWEEN_CAMERAS, NoisePrior

# Frames from one detection to the other, and pairs of detections of a camera for each, at most.
STEPS, MOST_PAIRS = (1, 2, 3, 4), 4_000_000
# Detections of a frame from which its pairs are as good as those of other objects.
CROWD = 50
# The density of pairs of one frame is that of strangers nearly as it is, and a detection mostly has a successor.
DISPLACEMENTS = DistanceKind(2, 0.02, 0.003, 0.03, 1.0)
# Speeds over the depth that are tried, 1/s, their prior (log-normal), and the error of a spread for so few speeds.
TURNS = np.geomspace(1e-4, 1e2, 90)
USUAL_TURN, TURN_SPREAD, FEW_SPEEDS = 0.2, 1.5, 0.1
PRIOR = -0.5 * (np.log(TURNS / USUAL_TURN) / TURN_SPREAD) ** 2
# Frames of the steps of third differences; acceleration over speed, 1/s, which is known as little; and by how much
# births are wider than that speed.
SWERVES, USUAL_RATIO, WIDER = (1, 2, 4, 8, 16), 0.6, 2.0
# Log-likelihood that the displacements of a camera may weigh: errors that last do not show in them.
MOST_EVIDENCE = 15.0


def likelihoods_of_displacements(sample: CameraSample) -> Array:
    """Return the log-likelihood (noises, turns) of the noise of a camera and of the speed over the depth."""
    found = [_displacements(sample, steps) for steps in STEPS if steps < len(sample.times)]
    told = np.zeros((len(NOISES), len(TURNS)))
    for square, mixture in found:
        spread = 0.5 * np.log(2.0 * NOISES[:, None] ** 2 + (TURNS * sample.camera.fx) ** 2 * square)
        weight = 1.0 / (1.0 + (len(found) - 1.0) * mixture.clear)
        told += weight * np.interp(spread, np.log(NOISES), _blurred(mixture.likelihoods, NOISES, FEW_SPEEDS))
    return _blurred(np.logaddexp(told - told.max(), -MOST_EVIDENCE), TURNS, BETWEEN_CAMERAS)


def usual_motion(samples: Sequence[CameraSample], priors: Mapping[str, NoisePrior]) -> tuple[float, float]:
    """Return speed, 1/s, and white acceleration, 1/s^2, across the line of sight over the depth, of one component.

    They are posterior medians. The noise is that of the cameras, to within the spread of its prior where there is one.
    """
    noises, medians, usual = [], list[float](), USUAL_TURN
    for sample in samples:
        sigma, prior = float(sample.camera.detector.sigma.mean()), priors.get(sample.camera.name)
        spread = FEW_SPEEDS if prior is None else np.hypot(prior.spread, FEW_SPEEDS)
        noises.append(-0.5 * (np.log(NOISES / sigma) / spread) ** 2)
    for likelihoods in (likelihoods_of_displacements, likelihoods_of_swerves):
        told = -0.5 * (np.log(TURNS / usual) / TURN_SPREAD) ** 2
        for sample, noise in zip(samples, noises, strict=True):
            told = told + np.logaddexp.reduce(likelihoods(sample) + noise[:, None], axis=0)
        summed = np.exp(told - told.max()).cumsum()
        medians.append(float(TURNS[np.searchsorted(summed, 0.5 * summed[-1])]))
        usual = USUAL_RATIO * medians[0]
    return medians[0], medians[1]


def likelihoods_of_swerves(sample: CameraSample) -> Array:
    """Return the log-likelihood (noises, turns) of the noise of a camera and of the acceleration over the depth.

    Third differences over steps of the time h, which a steady acceleration does not change, have the variance
    20 s^2 + q h^3, with the noise s of a detection and the spectral density q of white acceleration.
    """
    told = np.zeros((len(NOISES), len(TURNS)))
    for step in SWERVES if sample.linking[1] <= MOST_BY_CHANCE else ():
        differences = sample.third_differences(step)
        if len(differences) < LEAST_DIFFERENCES or not (shown := float(np.median(np.abs(differences)) / 0.6745)):
            break
        density = (TURNS * sample.camera.fx) ** 2
        spread = 0.5 * np.log(20.0 * NOISES[:, None] ** 2 + density * (step * sample.interval_s) ** 3)
        error = np.hypot(0.5 * VARIANCE_ERROR * np.sqrt(step / len(differences)), FEW_SPEEDS)
        told -= 0.5 * ((np.log(shown) - spread) / error) ** 2
    return _blurred(told, TURNS, BETWEEN_CAMERAS)


def _displacements(sample: CameraSample, steps: int) -> tuple[float, Mixture]:
    """Return the mean square of the time that so many frames take, s^2, and what displacements over them tell."""
    counts, frames = np.diff(sample.first), np.arange(len(sample.times) - steps)
    pairs = int((counts[frames] * (counts[frames] + counts[frames + steps])).sum())
    frames = frames[:: 1 + pairs // MOST_PAIRS]
    together, apart = [np.empty(0)], [np.empty(0)]
    pairs_among = cache(np.triu_indices)  # frames have as many detections again and again
    for k in frames.tolist():
        now, later = (sample.pixels[sample.first[i] : sample.first[i + 1]] for i in (k, k + steps))
        together.append(np.linalg.norm(now[:, None] - later, axis=2).ravel())
        apart.append(np.linalg.norm(now[:, None] - now, axis=2)[pairs_among(len(now), 1)])
    count, strangers = int(counts[frames].sum()), classes(np.concatenate(apart))
    # and what one false detection anywhere in the image adds; pairs of few objects stay the same and show little
    reach = float(np.sqrt(sample.camera.width * sample.camera.height / np.pi))
    density = DISPLACEMENTS.background(strangers + count * np.diff(np.minimum(BORDERS / reach, 1.0) ** 2))
    known = float(strangers.sum())
    error = 1.0 / np.sqrt(max(known / (1.0 + CROWD * len(frames) / max(count, 1)), 1.0))
    kind = replace(DISPLACEMENTS, level=DISPLACEMENTS.level + error, even=DISPLACEMENTS.even + error)
    found = unmix(kind, classes(np.concatenate(together)), [density], known + count, count)
    return float(((sample.times[frames + steps] - sample.times[frames]) ** 2).mean()), found


def _blurred(likelihoods: Array, values: Array, spread: float) -> Array:
    """Return log-likelihoods (..., n) of values (n,) whose logarithms have this standard deviation besides."""
    apart = -0.5 * (np.log(values[:, None] / values) / spread) ** 2
    apart = apart - np.logaddexp.reduce(apart, axis=0)
    return np.asarray(np.logaddexp.reduce(likelihoods[..., :, None] + apart, axis=-2))
