"""Annealed calibration: tracking and bundle adjustment in turn, from several starts.

A start is a draw of the camera parameters from their prior. Tracking (PMB filter) with the detector's noise
inflated tells which detections may belong together although the cameras are still wrong; the adjustment of cameras
and trajectories to those detections improves the cameras; the inflation falls from pass to pass, and in the last
passes the fitted trajectories choose their detections themselves. See docs/calibration.md.

A start succeeds only where the trajectories that two cameras share explain what was detected; the best of those is
the one of the greatest evidence (PMB filter at the true noise) plus log-prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from stereophd.calibration import kernels
from stereophd.calibration.adjustment import Adjustment, Loss, Observations, Problem, adjust
from stereophd.calibration.association import (
    Scans,
    fitted_detections,
    keep,
    shared,
    track_detections,
    with_cameras,
)
from stereophd.calibration.pairing import (
    DRAWS,
    TrackPairs,
    best_pairing,
    make_pairs,
    meeting_points,
    one_camera_tracks,
    paired_objects,
)
from stereophd.calibration.parameters import ParameterSet
from stereophd.calibration.scale import ScaleMeasurement, log_scale
from stereophd.calibration.tempered import Modes
from stereophd.calibration.trajectories import Knots, fit_states, interpolation, knot_spacing, place_knots, positions
from stereophd.multi.pmb import PmbFilter

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Loss while tracks may still be mixed up (Cauchy at 2 sigma), and once they are fitted: detections beyond 3.7 sigma
# are rather false ones (at that distance a normal density is down to this part of its peak).
ANNEALED_LOSS = Loss(kernels.CAUCHY, 2.0)
FITTED_LOSS = Loss(kernels.FLOOR, 1e-3)
# Where one-camera tracks could be paired the cameras are nearly right: inflation begins here.
PAIRED_INFLATION = 3.5
# Passes in which fitted trajectories choose their detections.
FITTED_PASSES = 3
# A start's values must be this probable under the prior, and the detections it explains this near to their noise:
# mean squared residual of accepted detections, in squared sigmas per coordinate.
LEAST_PRIOR_PROBABILITY = 1e-6
MOST_RESIDUAL = 2.0
# Two starts agree when their difference is within this many standard deviations, root mean square over parameters.
AGREEMENT = 1.0

# Least share of the particles of a full posterior that a mode gets.
LEAST_SHARE = 0.05
# Steps in which the length of a path is measured, and the part of their distance to which two objects keep it.
SPEED_STEPS = 200
RIGID = 0.02

SUCCEEDED = "succeeded"


@dataclass(frozen=True)
class AnnealedSettings:
    """Parameters of the method; see `stereophd.config_calibration.AnnealedConfig`."""

    starts: int = 8
    agreeing_starts: int = 2
    inflation: tuple[float, ...] = (7.0, 5.0, 3.5, 2.0, 1.4, 1.0)
    min_detections: int = 16
    min_tracked: float = 0.5


@dataclass(frozen=True)
class Task:
    """What a start needs.

    Attributes
    ----------
    parameters : ParameterSet
    reference : int
        Index of the reference camera.
    filter : PmbFilter
        Template; its cameras are replaced.
    scans : Scans
        All events.
    tracking : Scans
        Those that are tracked: all, or a part of a long log.
    tracks : tuple of (int, array)
        One-camera tracks among those events: camera and detections.
    pairs : TrackPairs
        Which of them may be one object.
    scale : ScaleMeasurement or None
    settings : AnnealedSettings
    """

    parameters: ParameterSet
    reference: int
    filter: PmbFilter
    scans: Scans
    tracking: Scans
    tracks: tuple[tuple[int, Integers], ...]
    pairs: TrackPairs
    scale: ScaleMeasurement | None
    settings: AnnealedSettings

    @staticmethod
    def of(
        parameters: ParameterSet,
        reference: int,
        multi_filter: PmbFilter,
        scans: Scans,
        tracking: Scans,
        scale: ScaleMeasurement | None,
        settings: AnnealedSettings,
    ) -> Task:
        """Prepare what all starts share: the tracks that each camera has by itself."""
        tracks = one_camera_tracks(multi_filter, tracking, settings.min_detections)
        pairs = make_pairs(parameters, tracking, tracks)
        return Task(parameters, reference, multi_filter, scans, tracking, tuple(tracks), pairs, scale, settings)


@dataclass(frozen=True)
class Fit:
    """Cameras and trajectories after an adjustment, with the detections they were adjusted to."""

    adjustment: Adjustment
    knots: Knots
    observations: Observations
    detections: Integers


@dataclass(frozen=True)
class Start:
    """Outcome of one start.

    Attributes
    ----------
    number : int
    outcome : str
        `SUCCEEDED`, or why not.
    start : array (m,)
        Values it began with.
    passes : array (p, m)
        Values after every pass.
    fit : Fit or None
        The last one.
    log_evidence, log_prior : float
        At the last values; NaN where the start failed.
    explained : float
        Detections of shared trajectories, in parts of those not expected to be false.
    """

    number: int
    outcome: str
    start: Array
    passes: Array
    fit: Fit | None
    log_evidence: float
    log_prior: float
    explained: float

    @property
    def succeeded(self) -> bool:
        """Whether the start found cameras that agree with the data."""
        return self.outcome == SUCCEEDED

    @property
    def score(self) -> float:
        """Evidence plus log-prior."""
        return self.log_evidence + self.log_prior


def run_start(task: Task, number: int, values: Array, seed: np.random.SeedSequence) -> Start:
    """Follow one start through all passes.

    Parameters
    ----------
    task : Task
    number : int
        Which start, for the record.
    values : array (m,)
        Where it begins.
    seed : SeedSequence
        Of the further draws among which one-camera tracks are paired.
    """
    history: list[Array] = []

    def failed(why: str, fit: Fit | None = None, part: float = 0.0) -> Start:
        return Start(number, why, start, np.array(history).reshape(-1, len(start)), fit, np.nan, np.nan, part)

    start = values
    inflations = task.settings.inflation
    fit = paired_fit(task, values, seed)
    if fit is not None:
        values = fit.adjustment.values
        history.append(values)
        inflations = tuple(f for f in inflations if f <= PAIRED_INFLATION) or inflations[-1:]
    for inflation in inflations:
        fit = tracked_fit(task, values, inflation)
        if fit is None:
            return failed(f"no track is shared by two cameras at {inflation:g} times the noise")
        values = fit.adjustment.values
        history.append(values)
    assert fit is not None
    for number_of_pass in range(FITTED_PASSES):
        scans = task.tracking if number_of_pass == 0 else task.scans
        again = refitted(task, fit, scans)
        if again is None:
            return failed("the fitted trajectories are not shared by two cameras", fit)
        fit = again
        history.append(fit.adjustment.values)
    values = fit.adjustment.values
    part = explained(task, fit)
    why = _disagreement(task, fit, part)
    if why is not None:
        return failed(why, fit, part)
    evidence = track_detections(
        with_cameras(task.filter, task.parameters.build(values)), task.tracking, 1.0
    ).log_likelihood
    prior = float(task.parameters.log_prior(values))
    return Start(number, SUCCEEDED, start, np.array(history), fit, evidence, prior, part)


def paired_fit(task: Task, values: Array, seed: np.random.SeedSequence) -> Fit | None:
    """Pair one-camera tracks, and adjust to the pairs; None if there are none. See `calibration.pairing`."""
    if not len(task.pairs.cameras):
        return None
    draws = task.parameters.sample(np.random.default_rng(seed), DRAWS)
    draws[0] = values
    pairing = best_pairing(task.parameters, task.pairs, draws)
    if pairing is None:
        return None
    objects = paired_objects(task.pairs, pairing, len(task.tracks))
    detections = np.concatenate([rows for (_, rows), o in zip(task.tracks, objects, strict=True) if o >= 0])
    of_object = np.concatenate([np.full(len(rows), o) for (_, rows), o in zip(task.tracks, objects, strict=True)])
    of_object = of_object[of_object >= 0]
    order = np.lexsort((detections, of_object))
    trajectories, detections = of_object[order], detections[order]
    rows, points = meeting_points(task.parameters, task.pairs, pairing)
    met = objects[task.pairs.tracks[task.pairs.pair[rows], 0]]
    observations = task.tracking.observations(trajectories, detections)
    nearest = np.array([points[met == j].mean(axis=0) for j in range(int(trajectories.max()) + 1)])
    knots = _knots(task, observations, nearest[trajectories], pairing.values)
    knot, weights = interpolation(knots, met, task.pairs.times[rows])
    states = fit_states(knots, knot, weights, points, np.full(len(rows), 1.0))
    problem = Problem(task.parameters, task.reference, knots, observations, ANNEALED_LOSS, task.scale)
    return Fit(adjust(problem, pairing.values, states), knots, observations, detections)


def tracked_fit(task: Task, values: Array, inflation: float) -> Fit | None:
    """Track with the cameras of `values` and inflated noise, and adjust to the shared tracks, if any."""
    cameras = task.parameters.build(values)
    scans = task.tracking
    found = track_detections(with_cameras(task.filter, cameras), scans, inflation)
    if not len(found):
        return None
    chosen = shared(found.tracks, scans.cameras[scans.event_of[found.detections]], task.settings.min_detections)
    if not len(chosen):
        return None
    rows, tracks = keep(found.tracks, chosen)
    observations = scans.observations(tracks, found.detections[rows], inflation)
    knots = _knots(task, observations, found.positions[rows], values)
    knot, weights = interpolation(knots, tracks, observations.times)
    precision = 1.0 / np.maximum(found.variances[rows], 1e-12)
    states = fit_states(knots, knot, weights, found.positions[rows], precision)
    problem = Problem(task.parameters, task.reference, knots, observations, ANNEALED_LOSS, task.scale)
    return Fit(adjust(problem, values, states), knots, observations, found.detections[rows])


def refitted(task: Task, fit: Fit, scans: Scans) -> Fit | None:
    """Let fitted trajectories choose their detections anew, and adjust again."""
    counts = np.bincount(fit.observations.trajectories, minlength=fit.knots.count)
    cameras = task.parameters.build(fit.adjustment.values)
    states = fit.adjustment.states
    noise = _noise(task, fit)
    std = float(task.filter.motion.acceleration_std.max())
    # over this time a random acceleration moves an object by its detection's noise
    padding = np.inf if std == 0.0 else (np.sqrt(3.0) * noise / std) ** (2.0 / 3.0)
    trajectories, detections = fitted_detections(cameras, scans, fit.knots, states, padding, counts)
    of_camera = scans.cameras[scans.event_of[detections]]
    chosen = shared(trajectories, of_camera, task.settings.min_detections)
    if not len(chosen):
        return None
    rows, numbers = keep(trajectories, chosen)
    observations = scans.observations(numbers, detections[rows])
    return _adjusted_to(task, fit, observations, trajectories[rows], detections[rows], task.scale)


def _knots(task: Task, observations: Observations, points: Array, values: Array) -> Knots:
    """Knots of trajectories with the given detections, near the given positions."""
    spans = []
    for j in range(int(observations.trajectories.max()) + 1):
        times = observations.times[observations.trajectories == j]
        spans.append((float(times.min()), float(times.max())))
    noise = _length_of_noise(task, observations, points, values)
    spacing = knot_spacing(task.filter.motion.acceleration_std, noise)
    return place_knots(spans, spacing, task.filter.motion)


def _length_of_noise(task: Task, observations: Observations, points: Array, values: Array) -> float:
    """Median over detections of their noise at the depth of the object, length."""
    depth = np.empty(len(points))
    focal = np.empty(len(points))
    for number, camera in enumerate(task.parameters.build(values)):
        here = observations.cameras == number
        depth[here] = np.abs((points[here] - camera.pose.center) @ camera.pose.rotation[2])
        focal[here] = camera.fx
    sigma = 1.0 / np.sqrt(observations.precisions[:, 0, 0])
    return float(np.median(sigma * depth / focal))


def _noise(task: Task, fit: Fit) -> float:
    knot, weights = interpolation(fit.knots, fit.observations.trajectories, fit.observations.times)
    points = positions(fit.adjustment.states, knot, weights)
    return _length_of_noise(task, fit.observations, points, fit.adjustment.values)


def explained(task: Task, fit: Fit) -> float:
    """Detections of shared trajectories, in parts of those that are not expected to be false."""
    return len(fit.detections) / real_detections(task.parameters, task.scans)


def real_detections(parameters: ParameterSet, scans: Scans) -> float:
    """How many detections are not expected to be false; at least two standard deviations of the false ones."""
    frames = np.bincount(scans.cameras, minlength=len(parameters.cameras))
    clutter = sum(
        camera.detector.clutter_per_frame * count for camera, count in zip(parameters.cameras, frames, strict=True)
    )
    total = len(scans.points)
    return float(max(total - clutter, 2.0 * np.sqrt(max(clutter, 1.0))))


def _disagreement(task: Task, fit: Fit, part: float) -> str | None:
    """Why a fit does not agree with the data or the prior; None if it does."""
    if part < task.settings.min_tracked:
        return f"shared tracks explain only {100 * part:.0f} % of the detections that are not expected to be false"
    residual = float(np.minimum(fit.adjustment.distances, kernels.BEHIND).mean()) / 2.0
    if residual > MOST_RESIDUAL:
        return f"residuals are {np.sqrt(residual):.1f} times the detector's noise"
    parameters = task.parameters
    distance = float((((fit.adjustment.values - parameters.prior_mean) / parameters.prior_std) ** 2).sum())
    if chi2.sf(distance, parameters.size) < LEAST_PRIOR_PROBABILITY:
        return f"the cameras lie {np.sqrt(distance):.1f} standard deviations from the prior"
    return None


def agree(one: Start, other: Start) -> bool:
    """Whether two starts found the same cameras, beside their uncertainty."""
    assert one.fit is not None
    assert other.fit is not None
    difference = one.fit.adjustment.values - other.fit.adjustment.values
    precision = np.linalg.inv(one.fit.adjustment.covariance)
    return float(difference @ precision @ difference) <= AGREEMENT**2 * len(difference)


def best_of(starts: list[Start]) -> Start | None:
    """The successful start of the greatest evidence plus log-prior, if any; the earlier of equal ones."""
    return max((s for s in starts if s.succeeded), key=lambda s: s.score, default=None)


def enough(starts: list[Start], agreeing: int) -> bool:
    """Whether so many starts agree on the best that no more are needed."""
    best = best_of(starts)
    return best is not None and sum(s.succeeded and agree(best, s) for s in starts) >= agreeing


def start_values(parameters: ParameterSet, seed: np.random.SeedSequence, count: int) -> Array:
    """Values (count, m) to start from: the prior mean, and draws from the prior."""
    draws = parameters.sample(np.random.default_rng(seed), count)
    draws[0] = parameters.prior_mean
    return draws


def distinct_modes(starts: list[Start]) -> Modes:
    """Modes of the posterior among the successful starts: optima, Laplace covariances, shares by evidence."""
    found: list[Start] = []
    for start in sorted((s for s in starts if s.succeeded), key=lambda s: -s.score):
        if not any(agree(mode, start) for mode in found):
            found.append(start)
    fits = [mode.fit.adjustment for mode in found if mode.fit is not None]
    # a mode that the evidence hardly supports still gets a twentieth: the sampler decides
    share = np.exp(np.array([mode.score for mode in found]) - found[0].score)
    share = np.maximum(share / share.sum(), LEAST_SHARE)
    return Modes(np.stack([f.values for f in fits]), np.stack([f.covariance for f in fits]), share / share.sum())


def fit_until(task: Task, fit: Fit, time_s: float) -> Fit | None:
    """Adjust to the detections until a time only, with the association of the whole run; None without any."""
    rows = np.flatnonzero(fit.observations.times <= time_s)
    trajectories, numbers = np.unique(fit.observations.trajectories[rows], return_inverse=True)
    if not len(trajectories):
        return None
    observations = task.scans.observations(numbers.astype(np.int64), fit.detections[rows])
    return _adjusted_to(task, fit, observations, fit.observations.trajectories[rows], fit.detections[rows], task.scale)


def rescaled(task: Task, fit: Fit, kind: str, value: float, std: float) -> Fit | None:
    """Adjust again, with the speed of all objects or the distance of two known.

    Speeds and distances in units of the scene's scale do not depend on it, so each says what the scale is:
    log s + log(known / found). The speeds of k objects do so independently.

    Parameters
    ----------
    task, fit : Task, Fit
    kind : str
        ``speed`` (mean speed of every object) or ``length`` (distance of the two that keep it best).
    value, std : float
        What is known.

    Returns
    -------
    Fit or None
        None if no two objects keep their distance.
    """
    logarithm, _ = log_scale(task.parameters, task.reference, fit.adjustment.values)
    if kind == "speed":
        found = mean_speeds(fit)
    else:
        distance = rigid_distance(fit)
        if distance is None:
            return None
        found = np.array([distance])
    target = logarithm + float(np.log(value / found).mean())
    measurement = ScaleMeasurement("log_scale", target, std / value / np.sqrt(len(found)))
    return _adjusted_to(task, fit, fit.observations, fit.observations.trajectories, fit.detections, measurement)


def mean_speeds(fit: Fit) -> Array:
    """Mean speed of every trajectory, length/s."""
    out = []
    for j, (start, end) in enumerate(fit.knots.spans):
        times = np.linspace(start, end, SPEED_STEPS + 1)
        path = positions(fit.adjustment.states, *interpolation(fit.knots, np.full(len(times), j), times))
        out.append(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) / max(end - start, 1e-300))
    return np.array(out)


def rigid_distance(fit: Fit) -> float | None:
    """Mean distance of the two trajectories that keep it best, length; None if none do to `RIGID` of it."""
    best, kept = RIGID, None
    for i in range(fit.knots.count):
        for j in range(i):
            start, end = max(fit.knots.spans[[i, j], 0]), min(fit.knots.spans[[i, j], 1])
            if end <= start:
                continue
            times = np.linspace(start, end, SPEED_STEPS)
            paths = [
                positions(fit.adjustment.states, *interpolation(fit.knots, np.full(len(times), k), times))
                for k in (i, j)
            ]
            distances = np.linalg.norm(paths[0] - paths[1], axis=1)
            if distances.std() < best * distances.mean():
                best, kept = float(distances.std() / distances.mean()), float(distances.mean())
    return kept


def _adjusted_to(
    task: Task,
    fit: Fit,
    observations: Observations,
    of_fit: Integers,
    detections: Integers,
    scale: ScaleMeasurement | None,
) -> Fit:
    """Adjust to observations, starting from a fit; `of_fit` are their trajectories there."""
    points = positions(fit.adjustment.states, *interpolation(fit.knots, of_fit, observations.times))
    knots = _knots(task, observations, points, fit.adjustment.values)
    knot, weights = interpolation(knots, observations.trajectories, observations.times)
    noise = _length_of_noise(task, observations, points, fit.adjustment.values)
    states = fit_states(knots, knot, weights, points, np.full(len(points), noise**-2))
    problem = Problem(task.parameters, task.reference, knots, observations, FITTED_LOSS, scale)
    return Fit(adjust(problem, fit.adjustment.values, states), knots, observations, detections)
