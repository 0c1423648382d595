"""Annealed calibration: tracking alternates with bundle adjustment, from several starts.

A start is a draw of the camera parameters from their prior. Each pass first tracks (PMB filter) with inflated detector
noise, so that detections of one object are associated although the cameras are still wrong. It then adjusts cameras and
trajectories to those detections, which improves the cameras. The inflation falls from pass to pass; in the last passes
the fitted trajectories choose their detections themselves. See docs/explanation/calibration.md.

A start succeeds only if the trajectories that two cameras share explain the detections. Of starts that do not agree the
best has the greatest sum of evidence (PMB filter at the true noise) and log-prior.
"""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.marginal import LEFT_OUT
from stereophd.core.calibration.adjustment.recording import Scans
from stereophd.core.calibration.adjustment.trajectories import STATED
from stereophd.core.calibration.annealing.fits import FITTED_PASSES, paired_fit, pairings_of, refitted, tracked_fit
from stereophd.core.calibration.annealing.task import PAIRING, SUCCEEDED, WIDE, Fit, Start, Task
from stereophd.core.calibration.annealing.tracking_scale import KEPT_WITHIN, depth_ratio
from stereophd.core.calibration.pairing.association import track_detections, with_cameras
from stereophd.core.calibration.pairing.choice import Pairing
from stereophd.core.calibration.pairing.refinement import MERGED
from stereophd.core.calibration.time_limit import TIME_OVER
from stereophd.core.calibration.unknowns.modes import Modes
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import collapse, enlarged
from stereophd.wording import percent

# Pairings of a start that are followed, and share of the best one's gain from which another is followed too.
MOST_PAIRINGS, AMBIGUOUS = 3, 0.9
# The detections that a start explains are as near as their noise allows up to this mean square of the residuals, in
# squared sigmas per coordinate; up to the second one the noise may be stated too small, and a warning reports it. A
# detection that the last adjustment left out counts no more than `LEFT_OUT`, wherever it lies.
NOISE_AS_STATED, MOST_RESIDUAL = 2.0, 9.0
# Two starts agree when their difference is within this many standard deviations by the mean of their covariances, root
# mean square over parameters.
AGREEMENT = 1.0
# Another start is a rival of the best if it is this near in evidence plus log-prior, and this far in the same measure.
RIVAL_SCORE, RIVAL_DISTANCE = 5.0, 5.0
# Least share of the particles of a full posterior that a mode gets.
LEAST_SHARE = 0.05


def paired(task: Task, number: int, values: Array, seed: np.random.SeedSequence) -> list[Pairing]:
    """Return the pairings that a start of values (m,) may follow, the best first; none where the time is over.

    The number is for the record; the seed is that of the further draws among which one-camera tracks are paired.
    """
    is_timely = task.limit.begin(f"start {number + 1} of at most {task.most_starts}: one-camera tracks are paired")
    return pairings_of(task, values, seed)[:MOST_PAIRINGS] if is_timely else []


def is_led_to(pairings: list[Pairing], pairing: Pairing | None, prior_std: Array) -> bool:
    """Whether a start would follow none of its pairings but this one: the same tracks, at the same cameras."""
    if pairing is None or not pairings or any(p.gain >= AMBIGUOUS * pairings[0].gain for p in pairings[1:]):
        return False
    is_near = (np.abs(pairings[0].values - pairing.values) < MERGED * prior_std).all()
    return bool(is_near) and set(pairings[0].chosen.tolist()) == set(pairing.chosen.tolist())


def followed_before(task: Task, starts: list[Start], number: int, pairings: list[Pairing]) -> Start | None:
    """Return what a start finds from pairings if one that explains the log has followed the best; None if none has.

    Where that one was ruled out, pairings that are far worse are left to none.
    """
    least, std = task.settings.min_tracked, task.parameters.prior_std
    same = (start for start in starts if start.explained >= least and is_led_to(pairings, start.pairing, std))
    return next((replace(start, number=number) for start in same), None)


def run_start(task: Task, number: int, values: Array, pairings: list[Pairing]) -> Start:
    """Follow one start through all passes: from the pairings found, the best first, then from its own values (m,).

    A pairing nearly as good as the best is followed too, and the one of the greater evidence counts. Further pairings
    are tried only where none has succeeded so far, and the start's own values at the widest noise where none explains
    the log. The number is for the record.
    """
    tried: list[Start] = []
    for place, pairing in enumerate(pairings):
        if best_of(tried) is not None and pairing.gain < AMBIGUOUS * pairings[0].gain:
            break
        task.limit.begin(f"start {number + 1} of at most {task.most_starts}: cameras are fitted to {PAIRING} {place}")
        found = _follow(task, number, f"{PAIRING} {place}", values, paired_fit(task, pairing))
        tried = compared(task, [*tried, replace(found, pairing=pairing)])
    if not any(start.explained >= task.settings.min_tracked for start in tried):
        tried.append(_follow(task, number, WIDE, values, None))
    return best_of(tried) or max(tried, key=lambda one: one.explained)


def _follow(task: Task, number: int, origin: str, start: Array, fit: Fit | None) -> Start:
    """Follow a start from a fit of paired tracks, or from its values at the widest noise, through all passes.

    After a pairing the inflation begins at the residuals of its fit.
    """
    begun = Start(number, "", np.empty((0, len(start))), None, np.nan, np.nan, 0.0, origin)
    values, inflations = start, task.settings.inflation
    if fit is not None:
        begun, values = begun.with_pass(fit), fit.adjustment.values
        residual = np.sqrt(squared_residuals(fit).mean())
        inflations = tuple(f for f in inflations if f <= residual) or inflations[-1:]
    for number_of_pass, inflation in enumerate(inflations):
        step = f"pass {number_of_pass + 1} of {len(inflations)}, {inflation:g} times the noise"
        if not task.limit.begin(f"{_name_of(task, begun)}: {step}"):
            return replace(begun, fit=None, outcome=TIME_OVER)
        ratio, noise = 1.0, STATED
        if fit is not None:
            ratio, noise = depth_ratio(task, fit, KEPT_WITHIN), fit.adjustment.motion_noise
        fit = tracked_fit(task, values, inflation, ratio, noise)
        if fit is None:
            why = f"no track is shared by two cameras at {inflation:g} times the noise"
            return replace(begun, fit=None, outcome=why)
        begun, values = begun.with_pass(fit), fit.adjustment.values
    return _judged(task, begun)


def _name_of(task: Task, start: Start) -> str:
    """Return what progress calls a start."""
    return f"start {start.number + 1} of at most {task.most_starts}, from {start.origin}"


def _judged(task: Task, start: Start) -> Start:
    """Let the fitted trajectories of a start choose their detections themselves, and judge the fit."""
    for number_of_pass in range(FITTED_PASSES):
        step = f"fitted trajectories choose their detections, {number_of_pass + 1} of {FITTED_PASSES}"
        if not task.limit.begin(f"{_name_of(task, start)}: {step}") and number_of_pass:
            break  # judged as it is
        assert start.fit is not None
        again = refitted(task, start.fit)
        if again is None:
            return replace(start, outcome="the fitted trajectories are not shared by two cameras")
        start = start.with_pass(again)
    fit = start.fit
    assert fit is not None
    part, why = explained(task, fit), disagreement(task, fit)
    if why is not None:
        return replace(start, outcome=why, explained=part)
    prior = float(task.parameters.log_prior(fit.adjustment.values))
    return replace(start, outcome=SUCCEEDED, log_prior=prior, explained=part)


def evidence(task: Task, fit: Fit) -> float:
    """Log-likelihood of the log under the cameras of a fit, at the true noise.

    All fits are compared at one scale: that at which the median object has the depth that the filter's birth prior
    expects. At their own, which the prior of the cameras chooses, that prior would decide between them. Where the noise
    is stated too small, it is that of the residuals, camera by camera: broken tracks would lose to wrong cameras.
    """
    cameras = task.parameters.build(fit.adjustment.values)
    squares, seen = squared_residuals(fit), fit.observations.cameras
    if squares.mean() > NOISE_AS_STATED:
        of_camera = np.bincount(seen, squares, len(cameras)) / np.bincount(seen, minlength=len(cameras)).clip(1)
        task = task.with_noise(np.sqrt(np.maximum(of_camera, 1.0)))
    scaled = enlarged(cameras, task.reference, depth_ratio(task, fit))
    return track_detections(with_cameras(task.filter, scaled), task.tracked_scans(cameras), 1.0).log_likelihood


def explained(task: Task, fit: Fit) -> float:
    """Detections of shared trajectories, in parts of those that are not expected to be false."""
    return len(fit.detections) / real_detections(task.parameters, task.scans, task.followed)


def real_detections(parameters: ParameterSet, scans: Scans, followed: float) -> float:
    """How many detections are not expected to be false.

    Those beyond the clutter that the detectors state, but no more than the share `followed` that tracks of one camera
    alone follow: there may be more clutter than stated. At least two standard deviations of the number of detections,
    were all of them false.
    """
    frames = np.bincount(scans.cameras, minlength=len(parameters.cameras))
    clutter = sum(
        camera.detector.clutter_per_frame * count for camera, count in zip(parameters.cameras, frames, strict=True)
    )
    total = len(scans.points)
    return float(max(min(total - clutter, followed * total), 2.0 * np.sqrt(max(total, 1))))


def squared_residuals(fit: Fit) -> Array:
    """Squared residuals (n,) of the detections of a fit, in squared sigmas per coordinate."""
    return np.asarray(np.minimum(fit.adjustment.distances, LEFT_OUT) / 2.0)


def disagreement(task: Task, fit: Fit, most_residual: float = MOST_RESIDUAL) -> str | None:
    """Why a fit does not agree with the data or the prior; None if it does."""
    part = explained(task, fit)
    if part < task.settings.min_tracked:
        return f"shared tracks explain only {percent(part)} of the detections that are not expected to be false"
    residual = float(squared_residuals(fit).mean())
    if residual > most_residual:
        return f"residuals are {np.sqrt(residual):.1f} times the detector's noise"
    values = fit.adjustment.values
    return task.parameters.prior_disagreement(values) or collapse(task.parameters, task.reference, values)


def agree(one: Start, other: Start, within: float = AGREEMENT) -> bool:
    """Whether two starts found the same cameras, within the given number of standard deviations (root mean square).

    Both covariances measure the difference. A start that follows fewer detections, or in more pieces, leaves more open
    than the best, and lies as far from it as that allows.
    """
    assert one.fit is not None
    assert other.fit is not None
    difference = one.fit.adjustment.values - other.fit.adjustment.values
    covariance = 0.5 * (one.fit.adjustment.covariance + other.fit.adjustment.covariance)
    return float(difference @ np.linalg.solve(covariance, difference)) <= within**2 * len(difference)


def compared(task: Task, starts: list[Start]) -> list[Start]:
    """Return starts with their evidence where some that succeeded do not agree; without it no other would be chosen."""
    succeeded = [start for start in starts if start.succeeded]
    if all(agree(succeeded[0], other) for other in succeeded[1:]):
        return starts
    return [
        start if start.fit is None or not start.succeeded or not np.isnan(start.log_evidence)
        else replace(start, log_evidence=evidence(task, start.fit)) for start in starts
    ]  # fmt: skip


def best_of(starts: list[Start]) -> Start | None:
    """The successful start of the greatest evidence plus log-prior, if any; the first where none has evidence."""
    return max((s for s in starts if s.succeeded), key=lambda s: s.score, default=None)


def agreeing_with_best(starts: list[Start]) -> int:
    """How many successful starts found the cameras of the best, itself included; 0 if none succeeded."""
    best = best_of(starts)
    return 0 if best is None else sum(s.succeeded and agree(best, s) for s in starts)


def start_values(parameters: ParameterSet, seed: np.random.SeedSequence, count: int) -> Array:
    """Values (count, m) to start from: the prior mean, and draws from the prior."""
    draws = parameters.sample(np.random.default_rng(seed), count)
    draws[0] = parameters.prior_mean
    return draws


def distinct(starts: list[Start]) -> list[Start]:
    """Successful starts that do not agree with one another, the best of each kind, best first."""
    found: list[Start] = []
    for start in sorted((s for s in starts if s.succeeded), key=lambda s: -s.score):
        if not any(agree(other, start) for other in found):
            found.append(start)
    return found


def modes_of(fits: list[Fit], scores: list[float]) -> Modes:
    """Modes of the posterior: optima, Laplace covariances, shares by evidence plus log-prior."""
    # a mode that the evidence hardly supports still gets a twentieth: the sampler decides
    share = np.exp(np.array(scores) - max(scores)) if len(scores) > 1 else np.ones(1)
    share = np.maximum(share / share.sum(), LEAST_SHARE)
    means = np.stack([fit.adjustment.values for fit in fits])
    return Modes(means, np.stack([fit.adjustment.covariance for fit in fits]), share / share.sum())


def rival_of(starts: list[Start]) -> Start | None:
    """A start that agrees with the data about as well as the best, at other cameras; None if there is none."""
    best, *others = distinct(starts)
    for start in others:
        if start.score >= best.score - RIVAL_SCORE and not agree(best, start, RIVAL_DISTANCE):
            return start
    return None
