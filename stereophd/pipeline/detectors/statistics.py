"""Noise, detection probability and clutter of each camera, estimated from settled tracks of a log.

A track that at least two cameras have seen predicts where the next camera will see it. With the predicted pixel H m and
its covariance C = H P H^T, the residual of its detection has the covariance S = C + R, which includes the state's own
uncertainty. Frames with a track in view and no detection of it show how probable a detection is. What probably belongs
to no confirmed track is clutter. Sums for all three accumulate, event by event, while a Poisson multi-Bernoulli filter
runs with the present values. A new run starts from the new values until they agree (a fixed point: at the true values
every expectation below holds).

Noise. With residuals e of a Gaussian of a track and weights w = p R / S (the probability p that it made the detection,
and the share of R in S), the derivative of the log-likelihood by log R is sum(w (e^2 / S - 1)) / 2 per axis of the
distorted image, with C known. A run moves R towards

    R_new / R = sum(w e^2 / S) / sum(w),

which is right where C scales with R, with a weight of 2 sum(w) of log(sigma) against the prior: what rays and
displacements say (`stereophd.pipeline.detectors.ray_noise`), of both axes together. Where the runs end, the derivatives
of both cancel to first order, whatever the part of C is. The standard error is that of the prior and of the information
of the residuals, 2 sum(w R / S) of log(sigma).

Probability of detection. sum(D) / sum(D + M), with D the probability that a track in view made a detection of the
frame, for which it competes with all others, and M that it exists and made none, after a prior of five frames with 0.9.
Frames count up to the last detection of the track only: what comes after is the object's end, not misses. The error is
that of single frames, or of whole tracks where these differ by more, as where some lose detections to others (clusters;
K.-Y. Liang and S. L. Zeger, Biometrika 73, 1986).

Clutter. Detections of a camera that belong to no confirmed track (before its confirmation included), a frame. To a
settled one they belong with the probability D, because what is false and near it is not all its own; the variance of
their number is at most sum(D (1 - D)), for tracks compete, and part of the standard error. Those that see nothing of
a region are counted apart: clutter is that of the part of the image that sees it, as if it were all of the image. Those
that a tentative object claims together with others at the end are undecided: they are part of the standard error, as is
the number by which tracks claim more than there are.

Whether it is noise at all. At the true values the residuals e / sqrt(S) of a track in one camera are white. If those
of successive frames agree, errors last: of the pose, the clock or the lens, or of labels that were smoothed. No
white noise describes them; estimated as if they were, tracks become overconfident.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.moved import IN_VIEW, OUT_OF_VIEW
from stereophd.core.geometry.camera import BOX_NOISE, Camera, Detector
from stereophd.core.multi.association.attribution import Claims, join_claims
from stereophd.core.multi.base import Prediction

# A track whose alternatives are still undecided (the heaviest has less than this share) is not counted yet.
DECIDED_SHARE = 0.9
# Least share of the image that sees the region.
LEAST_VIEW = 1e-3
# A detection that is more probably a track's than not counts as its next residual.
LIKELY = 0.5
# Correlations from fewer residuals are not trusted.
FEWEST_RESIDUALS = 50.0
# Correlation of successive residuals from which they cannot pass for white noise.
LASTING = 0.3
# The prior of a probability of detection: its mean, and the frames that it counts for.
USUAL_P_DETECT, PRIOR_FRAMES = 0.9, 5.0
# Smallest noise of a box, as a part of its height, and the largest correlation of its errors.
LEAST_PART, MOST_LASTING = 1e-3, 0.9
# Spread of the logarithm of the noise between the axes of a camera, or the values of a box, and between the cameras of
# one log.
BETWEEN_AXES, BETWEEN_CAMERAS = 0.25, 0.4
# Residuals over stated noise between which tracks confirm it (to within so many standard errors).
CONFIRMED, CONFIRMED_ERRORS = (0.7, 1.4), 2.0
# Tracks that contradict the rays by this factor, and beyond three standard errors, are those of another error.
CONTRADICTED, CONTRADICTED_ERRORS = 1.5, 3.0
# Spread of what rays show; beyond it is what is only usual.
KNOWN_SPREAD = 0.25


@dataclass
class DetectorSums:
    """Running sums of one camera, over events."""

    # `residuals`, `weights`, `shares`: arrays (k,): Sums of w e^2 / S, of w and of w R / S along u and v, or of the
    # values of a box.
    residuals: Array = field(default_factory=lambda: np.zeros(1))
    weights: Array = field(default_factory=lambda: np.zeros(1))
    shares: Array = field(default_factory=lambda: np.zeros(1))
    pairs: float = 0.0  # Expected number of detections behind them
    looks: list[Array] = field(default_factory=list)  # Sums (2,) of D and M of each track
    # `frames`, `detections`, `attributed`: Frames, detections, and expected number of those of confirmed tracks.
    frames: int = 0
    detections: int = 0
    attributed: float = 0.0
    doubtful: float = 0.0  # Variance of that number
    outside: int = 0  # Detections that see nothing of the region
    view: float = 1.0  # Share of the image that sees the region
    undecided: int = 0  # Detections that only objects claim which were still tentative at the end, not alone
    # `products`, `norms`: arrays (k,): Sums over successive frames of a track of r r', and of (r^2 + r'^2) / 2, for
    # residuals r = e / sqrt(S).
    products: Array = field(default_factory=lambda: np.zeros(1))
    norms: Array = field(default_factory=lambda: np.zeros(1))
    successions: int = 0  # Number of terms in these
    previous: dict[int, Array] = field(default_factory=dict)  # Label -> residual r (k,) of its last detection

    def add(self, residuals: Array, total: Array, noise: Array, share: Array, labels: Integers) -> None:
        """Add the residuals (p, k) of pairs of tracks and detections.

        `total` and `noise` (p, k) are their variances and the part that is the detector's, `share` (p,) the
        probability of each pair.
        """
        weights = share[:, None] * noise / total
        self.residuals = self.residuals + (weights * residuals**2 / total).sum(axis=0)
        self.weights = self.weights + weights.sum(axis=0)
        self.shares = self.shares + (weights * noise / total).sum(axis=0)
        self.pairs += float(share.sum())
        for pair in np.flatnonzero(share > LIKELY):
            residual = residuals[pair] / np.sqrt(total[pair])
            before = self.previous.get(int(labels[pair]))
            self.previous[int(labels[pair])] = residual
            if before is not None:
                self.products = self.products + residual * before
                self.norms = self.norms + (residual**2 + before**2) / 2.0
                self.successions += 1

    @property
    def correlation(self) -> Array | None:
        """Correlation (k,) of the residuals of successive frames; None for few."""
        return self.products / self.norms if self.successions >= FEWEST_RESIDUALS else None

    @property
    def lasts(self) -> bool:
        """Whether residuals are no white noise, beyond two standard errors: they say little of it then."""
        correlation = self.correlation
        return correlation is not None and bool(np.abs(correlation).max() - 2.0 / self.successions**0.5 > LASTING)

    def with_noise_of(self, others: Sequence[Self]) -> Self:
        """Return the sums with those of all the others in place of what tells the noise."""
        names = "residuals", "weights", "shares", "pairs", "products", "norms", "successions"
        return replace(self, **{name: sum(getattr(each, name) for each in others) for name in names})


@dataclass(frozen=True)
class NoisePrior:
    """Prior of the noise of a detector, before there are tracks: log-normal.

    The noise of boxes is in proportion to their height: the cameras of a log share one, unlike that of points.
    """

    noise: Array  # median: (2,) along u and v, px, or (4,) of the values of a box, as `Detector.box_noise`
    spread: float  # standard deviation of the logarithm

    @property
    def boxes(self) -> bool:
        """Whether it is that of boxes."""
        return len(self.noise) == len(BOX_NOISE)

    def of(self, detector: Detector) -> Array:
        """Return the noise of a detector that this is the prior of."""
        return np.asarray(detector.box_noise if self.boxes else detector.sigma)

    def put(self, detector: Detector, noise: Array) -> Detector:
        """Return a detector with another noise of this kind."""
        if not self.boxes:
            return Detector(noise, detector.p_detect, detector.clutter_per_frame, detector.box_noise)
        values = tuple(np.clip(noise, LEAST_PART, 1.0).tolist())
        return Detector(detector.sigma, detector.p_detect, detector.clutter_per_frame, values)


@dataclass(frozen=True)
class DetectorEstimate:
    """A detector estimated from a run, and how well; what could not be estimated has no standard error."""

    detector: Detector
    noise: Array  # as in `NoisePrior`
    noise_error: Array  # Its standard errors
    p_detect_error: float
    clutter_error: float | None
    # Correlation of the residuals of successive frames, for each component of the noise: 0 of white noise.
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

    def lasting(self, prior: NoisePrior) -> Self:
        """Return the estimate for a filter that takes errors for white where those of boxes last, as gaits do.

        The mean of many frames with errors of correlation r errs by as much as with white ones of (1 + r) / (1 - r)
        times the variance.
        """
        if not prior.boxes or self.correlation is None:
            return self
        lasting = np.clip(self.correlation, 0.0, MOST_LASTING)
        factor = np.sqrt((1.0 + lasting) / (1.0 - lasting))
        noise, error = self.noise * factor, self.noise_error * factor
        return replace(self, noise=noise, noise_error=error, detector=prior.put(self.detector, noise))


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
    claims: Claims | None,
    camera: Camera,
    space: Array,
    settled: Integers,
    with_noise: bool = True,
) -> Sighting:
    """Add the residuals of a frame to the sums of its camera, and return which settled tracks it detected.

    The prediction is that before the update, which found the claims, the camera that at the time of the event, with the
    present detector, and `space` (30,) its packed disparity space. Settled are labels of tracks that are confirmed and
    were seen by at least two cameras. `with_noise` says whether the noise is the detector's: a log may state that of
    each detection.
    """
    chosen, existence = _decided(prediction, settled)
    labels, readings = prediction.mixture.labels[chosen], event.readings(space)
    owners, targets, share = of_labels(claims, labels)
    if with_noise and len(owners):
        read = readings[targets] if len(readings) else readings
        _add_residuals(sums, prediction, chosen[owners], event.points[targets], read, share, camera)
    detected, p_detect = np.minimum(np.bincount(owners, share, len(chosen)), 1.0), camera.detector.p_detect
    missed = (1.0 - detected) * existence * (1.0 - p_detect) / np.maximum(1.0 - p_detect * existence, 1e-9)
    return Sighting(labels, detected, missed)


def of_labels(claims: Claims | None, labels: Integers) -> tuple[Integers, Integers, Array]:
    """Return the claims of some labels (k,): which of them (p,) claims which detection (p,), as probably as (p,)."""
    assert claims is not None
    names, detections, probabilities = join_claims(claims, 0.0)
    order, known = np.argsort(labels), np.isin(names, labels)
    return order[np.searchsorted(labels, names[known], sorter=order)], detections[known], probabilities[known]


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
    prediction: Prediction,
    owners: Integers,
    points: Array,
    read: Array,
    share: Array,
    camera: Camera,
) -> None:
    """Add pairs of components (p,) and detections (p, 2), in distorted pixels.

    The component's label made the detection with the probability `share` (p,). What another component of the label made
    is far from this one: the residual counts as probably as this one made it.
    """
    mixture, moved = prediction.mixture, prediction.moved
    alike = (mixture.labels == mixture.labels[owners][:, None]) & (moved.status != OUT_OF_VIEW)
    (pairs, rows), size = np.nonzero(alike), moved.means.shape[1]
    observation = np.tile(np.eye(2, size), (len(rows), 1, 1))
    if len(read):
        observation[:, :, 2] = read[pairs, 1:]
        observation += read[pairs, :1, None] * np.eye(2, size, 3)
    predicted = np.einsum("pij,pj->pi", observation, moved.means[rows])
    spread = observation @ moved.covariances[rows] @ np.swapaxes(observation, 1, 2)
    to_image = camera.distort_pixels(points)[1][pairs]
    residuals = np.einsum("pij,pj->pi", to_image, points[pairs] - predicted)
    noise = np.asarray(camera.detector.sigma) ** 2
    total = to_image @ spread @ np.swapaxes(to_image, 1, 2) + np.diag(noise)
    squares, own = np.einsum("pi,pij,pj->p", residuals, np.linalg.inv(total), residuals), rows == owners[pairs]
    odds = mixture.weights[rows] * moved.fraction[rows] / np.sqrt(np.linalg.det(total))
    odds *= np.exp(0.5 * np.minimum(squares[own][pairs] - squares, 1000.0))  # beyond that none is left in any case
    share, variances = share * odds[own] / np.bincount(pairs, odds), np.diagonal(total[own], axis1=1, axis2=2)
    sums.add(residuals[own], variances, np.broadcast_to(noise, variances.shape), share, mixture.labels[owners])


def estimate_detector(sums: DetectorSums, present: Detector, prior: NoisePrior) -> DetectorEstimate:
    """Return the detector estimated from the sums of a run with the `present` one, and from what was known before.

    Runs from one estimate to the next end at the most probable noise after both, prior and residuals. Without residuals
    it is the prior's, and where they contradict it: wrong tracks would otherwise make the noise larger, which makes
    more of them wrong.
    """
    noise, ratio, confirmed = np.asarray(prior.noise), None, False
    error = noise * np.hypot(prior.spread, BETWEEN_AXES)
    if sums.pairs > 0.0 and (sums.residuals > 0.0).all() and (sums.weights > 0.0).all():
        ratios = np.sqrt(sums.residuals / sums.weights)
        measured, ratio = np.log(prior.of(present) * ratios / noise), float(np.sqrt((ratios**2).mean()))
        pull, told = 2.0 * sums.weights, 2.0 * sums.shares
        slack = CONFIRMED_ERRORS / np.sqrt(told.min())
        confirmed = bool(np.log(CONFIRMED[0]) - slack <= np.log(ratio) <= np.log(CONFIRMED[1]) + slack)
        errors = CONTRADICTED_ERRORS * np.hypot(1.0 / np.sqrt(told.max()), prior.spread)
        # tracks follow errors that last, which rays show; what is only usual stands against larger noise alone
        apart = abs(measured.mean()) if prior.spread < KNOWN_SPREAD else measured.mean()
        if apart < max(np.log(CONTRADICTED), errors) and (prior.boxes or not sums.lasts):
            known = np.linalg.inv(prior.spread**2 + BETWEEN_AXES**2 * np.eye(len(noise)))
            noise = noise * np.exp(np.linalg.solve(known + np.diag(pull), pull * measured))
            error = noise * np.sqrt(np.diag(np.linalg.inv(known + np.diag(told))))
        else:
            ratio, confirmed = float(np.exp(measured.mean())), False
    looks = np.array(sums.looks).reshape(-1, 2)
    in_view = float(looks.sum())
    count = in_view + PRIOR_FRAMES
    p_detect = (float(looks[:, 0].sum()) + USUAL_P_DETECT * PRIOR_FRAMES) / count
    apart = float(((looks @ [1.0 - p_detect, -p_detect]) ** 2).sum())
    p_error = float(np.sqrt(max(p_detect * (1.0 - p_detect) * count, apart)) / count)
    clutter, clutter_error = present.clutter_per_frame, None
    if sums.frames > 0:
        frames = sums.frames * max(sums.view, LEAST_VIEW)
        left = sums.detections - sums.outside - sums.attributed  # below 0 where several tracks count one as theirs
        clutter = (max(left, 0) + 0.5) / frames
        doubtful = sums.doubtful + sums.undecided**2 + min(left, 0) ** 2
        clutter_error = float(np.sqrt(clutter / frames + doubtful / frames**2))
    return DetectorEstimate(
        prior.put(Detector(present.sigma, p_detect, clutter, present.box_noise), noise), noise, error, p_error,
        clutter_error, sums.correlation, sums.pairs, in_view, sums.frames, sums.outside / max(sums.frames, 1), ratio,
        confirmed,
    )  # fmt: skip
