"""Noise, detection probability and clutter of each camera, estimated from settled tracks of a log.

A track that at least two cameras have seen predicts where the next camera will see it. With the predicted pixel H m and
its covariance C = H P H^T, the residual of its detection has the covariance S = C + R, which includes the state's own
uncertainty. Frames with a track in view and no detection of it show how probable a detection is. Detections that no
confirmed track ever claimed are clutter. Sums for all three accumulate, event by event, while a Poisson multi-Bernoulli
filter runs with the present values. A new run starts from the new values until they agree (a fixed point: at the true
values every expectation below holds).

Noise. Filter covariances scale nearly as the noise does, so S is taken as proportional to R between two runs:
with residuals e and weights w = p R / S (the probability p of the pair, and the information that it has on R),

    R_new / R = sum(w e^2 / S) / sum(w),

per axis of the distorted image. Its standard error treats C as known, which is on the safe side:
sqrt(2 sum(w^2)) / sum(w) for R_new / R, divided by the mean of R / S. Few residuals say little: the estimate is joined
with what the rays say (`stereophd.pipeline.detectors.ray_noise`), so that it cannot run away from pass to pass.

Probability of detection. sum(D) / sum(D + M), with D the probability that a track in view made a detection of
the frame, and M that it exists and made none, after a prior of five frames with 0.9. Frames count up to the last
detection of the track only: what comes after is the object's end, not misses.

Clutter. Detections of a camera that belong to no confirmed track (before its confirmation included), a frame. Those
that see nothing of a region are counted apart: clutter is that of the part of the image that sees it, as if it were all
of the image. Those that a tentative object claims together with others at the end are undecided: they are part of the
standard error.

Whether it is noise at all. At the true values the residuals e / sqrt(S) of a track in one camera are white. If those
of successive frames agree, errors last: of the pose, the clock or the lens, or of labels that were smoothed. No
white noise describes them; estimated as if they were, tracks become overconfident.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.moved import IN_VIEW
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.multi.association.likelihoods import pair_likelihoods
from stereophd.core.multi.base import Prediction

# A track whose alternatives are still undecided (the heaviest has less than this share) is not counted yet.
DECIDED_SHARE = 0.9
# Least share of the image that sees the region.
LEAST_VIEW = 1e-3
# A detection that is more probably a track's than not counts as its next residual.
LIKELY = 0.5
# Correlations from fewer residuals are not trusted.
FEWEST_RESIDUALS = 50.0
# The prior of a probability of detection: its mean, and the frames that it counts for.
USUAL_P_DETECT, PRIOR_FRAMES = 0.9, 5.0
# Spread of the logarithm of the noise between the two axes of a camera.
BETWEEN_AXES = 0.25
# Residuals over stated noise between which tracks confirm it (to within so many standard errors), the fewest of them
# that can, and the spread of what is known from the rays from which it needs no more of them.
CONFIRMED, CONFIRMED_ERRORS, FEWEST_TO_CONFIRM, KNOWN_SPREAD = (0.7, 1.4), 2.0, 8.0, 0.25
# Tracks that contradict the rays by this factor, and beyond three standard errors, are those of another error.
CONTRADICTED, CONTRADICTED_ERRORS = 1.5, 3.0


@dataclass
class DetectorSums:
    """Running sums of one camera, over events."""

    # `residuals`, `weights`, `squares`, `shares`: arrays (2,): Sums of w e^2 / S, of w, of w^2 and of w R / S along u
    # and v.
    residuals: Array = field(default_factory=lambda: np.zeros(2))
    weights: Array = field(default_factory=lambda: np.zeros(2))
    squares: Array = field(default_factory=lambda: np.zeros(2))
    shares: Array = field(default_factory=lambda: np.zeros(2))
    pairs: float = 0.0  # Expected number of detections behind them
    # `detected`, `missed`: Sums of D and M.
    detected: float = 0.0
    missed: float = 0.0
    # `frames`, `detections`, `attributed`: Frames, detections, and those of confirmed tracks.
    frames: int = 0
    detections: int = 0
    attributed: int = 0
    outside: int = 0  # Detections that see nothing of the region
    view: float = 1.0  # Share of the image that sees the region
    undecided: int = 0  # Detections that only objects claim which were still tentative at the end, not alone
    # `products`, `norms`: arrays (2,): Sums over successive frames of a track of r r', and of (r^2 + r'^2) / 2, for
    # residuals r = e / sqrt(S).
    products: Array = field(default_factory=lambda: np.zeros(2))
    norms: Array = field(default_factory=lambda: np.zeros(2))
    successions: int = 0  # Number of terms in these
    previous: dict[int, Array] = field(default_factory=dict)  # Label -> residual r (2,) of its last detection


@dataclass(frozen=True)
class NoisePrior:
    """Prior of the noise of a detector, before there are tracks: log-normal."""

    sigma_px: Array  # (2,): median along u and v
    spread: float  # standard deviation of the logarithm


@dataclass(frozen=True)
class DetectorEstimate:
    """A detector estimated from a run, and how well; what could not be estimated has no standard error."""

    detector: Detector
    sigma_error: Array  # (2,): Standard errors of sigma, px
    p_detect_error: float
    clutter_error: float | None
    # (2,) or None: Correlation of the residuals of successive frames along u and v: 0 of white noise.
    correlation: Array | None
    # `residuals`, `in_view`: Expected numbers of detections behind sigma, and of frames with a track in view behind
    # p_detect.
    residuals: float
    in_view: float
    frames: int
    outside_per_frame: float  # Detections that see nothing of the region
    # Root mean square of the residuals over what the noise stated in this run leads to expect; None without any.
    residual_ratio: float | None
    confirmed: bool  # Whether the tracks of this run agree with the noise that it stated, and with the rays


@dataclass(frozen=True)
class Sighting:
    """Evidence of a frame on the settled tracks in its view."""

    labels: Integers  # (k,) of int
    # `detected`, `missed`: arrays (k,): Probabilities that the track made a detection of the frame, and that it
    # exists and made none.
    detected: Array
    missed: Array


def observe(
    sums: DetectorSums,
    prediction: Prediction,
    event: Event,
    camera: Camera,
    space: Array,
    births_per_frame: float,
    settled: Integers,
    with_noise: bool = True,
) -> Sighting:
    """Add the residuals of a frame to the sums of its camera, and return which settled tracks it detected.

    Parameters
    ----------
    sums : DetectorSums
        Sums of the camera; the residuals are added.
    prediction : Prediction
        Before the update with the event.
    event : Event
    camera : Camera
        At the time of the event, with the present detector.
    space : array (30,)
        Its packed disparity space.
    births_per_frame : float
    settled : array of int
        Labels of tracks that are confirmed and were seen by at least two cameras.
    with_noise : bool
        Whether the noise is the detector's (a log may state that of each detection).
    """
    chosen, existence = _decided(prediction, settled)
    moved = prediction.moved
    means, covariances = moved.means[chosen], moved.covariances[chosen]
    readings = event.readings(space)
    owners, targets, densities = pair_likelihoods(
        means, covariances, np.ones(len(chosen), dtype=np.bool_), event.points, event.covariances, event.areas,
        readings,
    )  # fmt: skip
    detector = camera.detector
    expected = detector.p_detect * existence
    background = (detector.clutter_per_frame + detector.p_detect * births_per_frame) / (camera.width * camera.height)
    missed = np.maximum(1.0 - expected, 1e-9)
    odds = expected[owners] * densities / (missed[owners] * max(background, 1e-300))
    share, untouched, _, _ = association_marginals(owners, targets, odds, len(chosen), len(event.points))
    labels = prediction.mixture.labels[chosen]
    if with_noise and len(owners):
        read = None if readings is None else readings[targets]
        _add_residuals(
            sums, means[owners], covariances[owners], event.points[targets], read, share, camera, labels[owners]
        )
    return Sighting(labels, 1.0 - untouched, untouched * existence * (1.0 - detector.p_detect) / missed)


def _decided(prediction: Prediction, settled: Integers) -> tuple[Integers, Array]:
    """Return the components of settled tracks wholly in view, and the existence of each."""
    mixture = prediction.mixture
    rows = np.flatnonzero(np.isin(mixture.labels, settled))
    labels, member = np.unique(mixture.labels[rows], return_inverse=True)
    existence = np.bincount(member, weights=mixture.weights[rows], minlength=len(labels))
    good = mixture.weights[rows] > DECIDED_SHARE * existence[member]
    good &= (prediction.moved.status[rows] == IN_VIEW) & (prediction.moved.inside[rows] == 1.0)
    return rows[good], np.minimum(existence[member[good]], 1.0)


def _add_residuals(
    sums: DetectorSums,
    means: Array,
    covariances: Array,
    points: Array,
    readings: Array | None,
    share: Array,
    camera: Camera,
    labels: Integers,
) -> None:
    """Add pairs of components (p, d) and detections (p, 2), of these probabilities, in distorted pixels."""
    observation = np.zeros((len(points), 2, means.shape[1]))
    observation[:, 0, 0] = observation[:, 1, 1] = 1.0
    if readings is not None:
        observation[:, :, 2] = readings[:, 1:]
        if means.shape[1] == 6:
            observation[:, 0, 3] = observation[:, 1, 4] = readings[:, 0]
    predicted = np.einsum("pij,pj->pi", observation, means)
    spread = observation @ covariances @ np.swapaxes(observation, 1, 2)
    to_image = camera.distort_pixels(points)[1]
    residuals = np.einsum("pij,pj->pi", to_image, points - predicted)
    spread = to_image @ spread @ np.swapaxes(to_image, 1, 2)
    noise = np.asarray(camera.detector.sigma) ** 2
    total = np.stack([spread[:, 0, 0], spread[:, 1, 1]], axis=1) + noise
    weights = share[:, None] * noise / total
    sums.residuals += (weights * residuals**2 / total).sum(axis=0)
    sums.weights += weights.sum(axis=0)
    sums.squares += (weights**2).sum(axis=0)
    sums.shares += (weights * noise / total).sum(axis=0)
    sums.pairs += float(share.sum())
    for pair in np.flatnonzero(share > LIKELY):
        residual = residuals[pair] / np.sqrt(total[pair])
        before = sums.previous.get(int(labels[pair]))
        sums.previous[int(labels[pair])] = residual
        if before is not None:
            sums.products += residual * before
            sums.norms += (residual**2 + before**2) / 2.0
            sums.successions += 1


def estimate_detector(sums: DetectorSums, present: Detector, prior: NoisePrior) -> DetectorEstimate:
    """Return the detector estimated from the sums of a run with the `present` one, and from what was known before.

    The noise is the mean of its logarithm after both: of the prior, and of the residuals, weighted with their squared
    standard errors. Without residuals it is the prior's, and where they contradict it: wrong tracks would otherwise
    make the noise larger, which makes more of them wrong.
    """
    sigma, ratio = np.asarray(prior.sigma_px), None
    error = sigma * np.hypot(prior.spread, BETWEEN_AXES)
    confirmed = prior.spread < KNOWN_SPREAD
    if sums.pairs > 0.0 and (sums.residuals > 0.0).all() and (sums.weights > 0.0).all():
        measured = np.asarray(present.sigma) * np.sqrt(sums.residuals / sums.weights)
        relative = np.sqrt(2.0 * sums.squares) / sums.weights / (sums.shares / sums.weights) / 2.0
        spread = np.hypot(prior.spread, BETWEEN_AXES)
        weight = relative**-2 / (relative**-2 + spread**-2)
        sigma = np.exp((1.0 - weight) * np.log(prior.sigma_px) + weight * np.log(measured))
        error = sigma * np.sqrt(weight) * relative
        ratio = float(np.sqrt((sums.residuals / sums.weights).mean()))
        apart = abs(float(np.log(measured / prior.sigma_px).mean()))
        most = max(np.log(CONTRADICTED), CONTRADICTED_ERRORS * float(np.hypot(relative.min(), prior.spread)))
        agrees = apart < most
        if not agrees:
            sigma, error = np.asarray(prior.sigma_px), np.asarray(prior.sigma_px) * spread
        slack = CONFIRMED_ERRORS * float(relative.max())
        low, high = np.log(CONFIRMED[0]) - slack, np.log(CONFIRMED[1]) + slack
        confirmed = bool(agrees and low <= np.log(ratio) <= high) and (confirmed or sums.pairs >= FEWEST_TO_CONFIRM)
    in_view = sums.detected + sums.missed
    p_detect = (sums.detected + USUAL_P_DETECT * PRIOR_FRAMES) / (in_view + PRIOR_FRAMES)
    p_error = float(np.sqrt(p_detect * (1.0 - p_detect) / (in_view + PRIOR_FRAMES)))
    clutter, clutter_error = present.clutter_per_frame, None
    if sums.frames > 0:
        frames = sums.frames * max(sums.view, LEAST_VIEW)
        clutter = (max(sums.detections - sums.outside - sums.attributed, 0) + 0.5) / frames
        clutter_error = float(np.hypot(np.sqrt(clutter / frames), sums.undecided / frames))
    correlation = sums.products / sums.norms if sums.successions >= FEWEST_RESIDUALS else None
    return DetectorEstimate(
        Detector(sigma, p_detect, clutter), error, p_error, clutter_error, correlation,
        sums.pairs, in_view, sums.frames, sums.outside / max(sums.frames, 1), ratio, confirmed,
    )  # fmt: skip
