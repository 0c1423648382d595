"""Adjustments of cameras and trajectories to detections: to paired tracks, to the tracks of a filter, to fits."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment import normal_equations
from stereophd.core.calibration.adjustment.linearisation import Linearisation
from stereophd.core.calibration.adjustment.marginal import MarginalPosterior, marginal_optimum
from stereophd.core.calibration.adjustment.problem import SQUARED, Loss, Observations, Problem, true_times
from stereophd.core.calibration.adjustment.solver import KNOTS_NEAR, Adjustment, adjust, settled_knots
from stereophd.core.calibration.adjustment.trajectories import (
    STATED,
    Knots,
    MotionNoise,
    fit_states,
    interpolation,
    knot_spacing,
    least_noise,
    place_knots,
    positions,
)
from stereophd.core.calibration.annealing.membership import chosen_detections
from stereophd.core.calibration.annealing.rejected import collapsed, lone
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.pairing.association import shared, track_detections, with_cameras
from stereophd.core.calibration.pairing.choice import Pairing
from stereophd.core.calibration.pairing.refinement import meeting_points
from stereophd.core.calibration.pairing.search import DRAWS, distinct_pairings, paired_objects
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import view_of
from stereophd.core.calibration.unknowns.scale import enlarged, reduced

# Loss while tracks may still be mixed up (Cauchy at 2 sigma), and once they are fitted: detections beyond 3.7 sigma
# are rather false ones (at that distance a normal density is down to this part of its peak).
ANNEALED_LOSS = Loss(normal_equations.CAUCHY, 2.0)
FITTED_LOSS = Loss(normal_equations.FLOOR, 1e-3)
# Iterations of an adjustment that others follow.
ANNEALED_ITERATIONS = 30
# Steps of the knots, whatever the loss says, before an adjustment.
SETTLING_STEPS = 3
# Step, in posterior standard deviations, at which the search for a joint or marginal optimum of a pass has settled.
SETTLED_IN_PASSES = 1.0
# Times at which the history holds the posterior, and the part of the log until each of that until the next one: the
# deviations of what detections determine fall by as much from each to the next.
HISTORY_TIMES, HISTORY_PART = 9, np.sqrt(0.5)
# Passes in which fitted trajectories choose their detections.
FITTED_PASSES = 2
# Frames by which a trajectory may go on before its first detection and after its last one, in a pass.
PADDED_FRAMES = 2.0


@dataclass(frozen=True)
class HistoryRow:
    """Posterior of the parameters given the log up to a time."""

    time_s: float
    mean: Array
    covariance: Array


def pairings_of(task: Task, values: Array, seed: np.random.SeedSequence) -> list[Pairing]:
    """Pair one-camera tracks: at `values` (m,), and at draws from the prior; distinct pairings, the best first."""
    if not len(task.pairs.cameras):
        return []
    draws = task.parameters.sample(np.random.default_rng(seed), DRAWS)
    draws[0] = values
    return distinct_pairings(task.parameters, task.pairs, draws)


def paired_fit(task: Task, pairing: Pairing) -> Fit:
    """Adjust cameras and trajectories to paired one-camera tracks, while both last. See `calibration.pairing`."""
    objects, cameras = paired_objects(task.pairs, pairing, len(task.tracks)), task.parameters.build(pairing.values)
    rows, times, points = meeting_points(task.parameters, task.pairs, pairing)
    of_row, entries = task.pairs.pair[rows], task.pairs.entries[rows]
    detections = np.concatenate([detections for _, detections in task.tracks])
    of_track = np.repeat(np.arange(len(task.tracks)), np.diff(task.pairs.raw.first))
    seen = task.observations(cameras, of_track, detections).times
    # where two objects pass, a track of one camera may go on with the other: a pair is of one object while both last
    is_common = np.zeros(len(detections), dtype=np.bool_)
    for pair in np.unique(of_row):
        at = seen[entries[of_row == pair]]
        is_common |= np.isin(of_track, task.pairs.tracks[pair]) & (seen >= at.min()) & (seen <= at.max())
    order = np.lexsort((detections[is_common], objects[of_track[is_common]]))
    detections, of_track = detections[is_common][order], of_track[is_common][order]
    numbers, trajectories = np.unique(objects[of_track], return_inverse=True)
    met = np.searchsorted(numbers, objects[task.pairs.tracks[of_row, 0]])
    observations = task.observations(cameras, trajectories, detections)
    nearest = np.array([points[met == j].mean(axis=0) for j in range(len(numbers))])
    knots = _knots(task, observations, nearest[trajectories], pairing.values)
    states = fit_states(knots, *interpolation(knots, met, times), points, np.full(len(rows), 1.0))
    problem = Problem(task.parameters, task.reference, knots, observations, ANNEALED_LOSS, task.scale)
    return confirmed_fit(task, problem, pairing.values, states, detections)


def tracked_fit(task: Task, values: Array, inflation: float, ratio: float = 1.0, noise: Array = STATED) -> Fit | None:
    """Track with the cameras of `values` and inflated noise, and adjust to the shared tracks, if any.

    The filter gets the cameras enlarged by `ratio` (`annealing.tracking_scale`). The noise (6,) of the motion is looked
    for from the given one on.
    """
    cameras = task.parameters.build(values)
    scans = task.tracked_scans(cameras)
    found = track_detections(with_cameras(task.filter, enlarged(cameras, task.reference, ratio)), scans, inflation)
    rows = shared(found.tracks, scans.cameras[scans.event_of[found.detections]], task.settings.min_detections)
    if not rows.any():
        return None
    _, tracks = np.unique(found.tracks[rows], return_inverse=True)
    detections = scans.source[found.detections[rows]]
    points = reduced(found.positions[rows], cameras, task.reference, ratio)
    observations = task.observations(cameras, tracks, detections, inflation)
    knots = _knots(task, observations, points, values, noise)
    precision = ratio**2 / np.maximum(found.variances[rows], 1e-12)
    states = fit_states(knots, *interpolation(knots, tracks, observations.times), points, precision)
    problem = Problem(task.parameters, task.reference, knots, observations, ANNEALED_LOSS, task.scale)
    return confirmed_fit(task, problem, values, states, detections, noise)


def refitted(task: Task, fit: Fit, still: bool = False) -> Fit | None:
    """Let fitted trajectories choose their detections anew, among all, and adjust again.

    `still`: the cameras stay, and the trajectories follow every detection at the weight of its noise alone
    (`adjustment.noise`).
    """
    cameras = task.parameters.build(fit.adjustment.values)
    scans, seen = task.all_scans(cameras), fit.observations
    points = positions(fit.adjustment.states, *interpolation(fit.knots, seen.trajectories, seen.times))
    noise = _length_of_noise(task, seen, points, fit.adjustment.values)
    # over this time the noise of the motion moves an object by its detection's noise; a frame or two are looked at
    periods = task.recording.periods(len(cameras))
    padding = max(task.filter.motion.straying_time(noise), PADDED_FRAMES * float(periods.max()))
    problem = problem_of(task, fit)
    trajectories, detections = chosen_detections(problem, fit.adjustment, fit.detections, scans, padding)
    p_detect = np.array([camera.detector.p_detect for camera in cameras])
    several = ~lone(trajectories, scans.event_of[detections], scans.cameras, p_detect)
    trajectories, detections = trajectories[several], detections[several]
    rows = shared(trajectories, scans.cameras[scans.event_of[detections]], task.settings.min_detections)
    if not rows.any():
        return None
    of_log = scans.source[detections[rows]]
    fit = replace(fit, held=np.ones(task.parameters.size, dtype=np.bool_) if still else None)
    observations = task.observations(cameras, trajectories[rows], of_log)
    if still:
        observations = replace(observations, weights=None)
    return adjusted_to(task, fit, observations, of_log)


def fit_from(task: Task, values: Array) -> Fit | None:
    """Fit cameras and trajectories to what is tracked with the cameras of `values`; None if nothing is shared."""
    fit = tracked_fit(task, values, 1.0)
    for _ in range(FITTED_PASSES):
        if fit is not None:
            fit = refitted(task, fit)
    return fit


def history_of(task: Task, answer: Fit, result: Fit) -> tuple[HistoryRow, ...]:
    """Return the posterior over time, of the log so far, and the result as the last row.

    A row is the marginal posterior given the detections until a time, with the association of the answer. It is
    searched from the row after it, beside whose optimum that of less of the log lies. None is without any detection of
    an object that two cameras see.
    """
    start, end = task.recording.times[[0, -1]].tolist()
    times = task.history_times
    if times is None:
        times = start + (end - start) * HISTORY_PART ** np.arange(HISTORY_TIMES - 1, 0, -1)
    rows = [HistoryRow(end, result.adjustment.values, result.adjustment.covariance)]
    for time_s in times[::-1].tolist():
        part = part_of(task, answer, np.flatnonzero(answer.observations.times <= time_s))
        if part is None or not task.limit.begin(f"the history of the answer, {len(rows)} of {len(times) + 1}"):
            break
        with suppress(LinAlgError):
            problem, begun = _begun(task, part, part.observations)
            begun = replace(begun, distances=part.adjustment.distances)
            answer = _fit(task, problem, marginal_optimum(problem, begun, SETTLED_IN_PASSES), part.detections)
            rows.append(HistoryRow(time_s, answer.adjustment.values, answer.adjustment.covariance))
    return tuple(reversed(rows))


def part_of(task: Task, fit: Fit, rows: NDArray[np.intp]) -> Fit | None:
    """Return a fit with some of its detections, of objects that two cameras see; None if there is none.

    Trajectories of which one camera alone is left hold no information about the cameras, and collapse into it. The
    trajectories keep their numbers.
    """
    rows = rows[shared(fit.observations.trajectories[rows], fit.observations.cameras[rows], 1)]
    if not len(rows):
        return None
    cameras = task.parameters.build(fit.adjustment.values)
    observations = task.observations(cameras, fit.observations.trajectories[rows], fit.detections[rows])
    if fit.observations.weights is None:
        observations = replace(observations, weights=None)
    adjustment = replace(fit.adjustment, distances=fit.adjustment.distances[rows])
    return replace(fit, adjustment=adjustment, observations=observations, detections=fit.detections[rows])


def adjusted_to(task: Task, fit: Fit, observations: Observations, detections: Integers) -> Fit:
    """Adjust to observations of trajectories of a fit, starting from it; those that have some are numbered anew.

    To the optimum of the marginal posterior, or, where all values are held, to the joint one. What the fit held is held
    again. The search begins at the noise of the motion of the fit, which stays in joint ones. Stretches that a joint
    optimum has put into their camera (`annealing.rejected`) are left out, and the others are adjusted to again: after
    the search, or before it where they let no knots settle.
    """
    problem, begun = _begun(task, fit, observations)
    searched = None
    if fit.held is None or not fit.held.all():
        standing = None if _can_settle(problem, begun) else _standing(task, _fit(task, problem, begun, detections))
        if standing is not None:
            return standing
        with suppress(LinAlgError):  # the joint optimum is found with damping
            searched = marginal_optimum(problem, begun, SETTLED_IN_PASSES)
    if searched is None:
        searched = replace(adjust(problem, begun.values, begun.states), motion_noise=begun.motion_noise)
    found = _fit(task, problem, searched, detections)
    return _standing(task, found) or found


def _begun(task: Task, fit: Fit, observations: Observations) -> tuple[Problem, Adjustment]:
    """Return the problem of observations, and where the search begins that starts from a fit, as in `adjusted_to`."""
    values, noise = fit.adjustment.values, fit.adjustment.motion_noise
    points = positions(fit.adjustment.states, *interpolation(fit.knots, observations.trajectories, observations.times))
    _, trajectories = np.unique(observations.trajectories, return_inverse=True)
    observations = replace(observations, trajectories=trajectories)
    knots = _knots(task, observations, points, values, noise)
    if fit.held is not None and fit.held.all():
        knots = replace(knots, noise_std=fit.knots.noise_std)
    interpolated = interpolation(knots, trajectories, observations.times)
    length = _length_of_noise(task, observations, points, values)
    states = fit_states(knots, *interpolated, points, np.full(len(points), length**-2))
    problem = Problem(task.parameters, task.reference, knots, observations, FITTED_LOSS, task.scale, fit.held)
    return problem, _at(problem, values, _settled(problem, values, states), noise)


def _standing(task: Task, fit: Fit) -> Fit | None:
    """Adjust to what has not collapsed into its camera; None if nothing has, or no object of two cameras is left."""
    seen = fit.observations
    points = positions(fit.adjustment.states, *interpolation(fit.knots, seen.trajectories, seen.times))
    still = np.zeros_like(points)
    distances = [
        np.linalg.norm(view_of(camera, points, still, seen.times, seen.log_times, seen.rows).points, axis=1)
        for camera in task.parameters.build(fit.adjustment.values)
    ]
    gone = collapsed(seen.trajectories, seen.times, seen.cameras, np.stack(distances, axis=1))
    part = part_of(task, fit, np.flatnonzero(~gone)) if gone.any() else None
    return part and adjusted_to(task, part, part.observations, part.detections)


def problem_of(task: Task, fit: Fit) -> Problem:
    """Return the problem that a fit solves, with all values free, at the noise of the motion that was found."""
    return Problem(task.parameters, task.reference, fit.knots, fit.observations, FITTED_LOSS, task.scale)


def stated_problem(task: Task, fit: Fit) -> Problem:
    """Return the problem that a fit solves, with all values free, at the noise of the motion that is stated."""
    return problem_of(task, replace(fit, knots=replace(fit.knots, noise_std=least_noise(task.filter.motion))))


def at_values(task: Task, fit: Fit, values: Array, states: Array, covariance: Array) -> Fit:
    """Return a fit at other values (m,) of a covariance (m, m), and at other knots (k, 2, 3)."""
    seen = replace(fit.observations, times=true_times(task.parameters.build(values), fit.observations))
    distances = Linearisation.of(problem_of(task, fit)).at(values, states).distances
    adjustment = replace(fit.adjustment, values=values, states=states, covariance=covariance, distances=distances)
    return replace(fit, adjustment=adjustment, observations=seen, held=None)


def marginal_fit(task: Task, fit: Fit) -> Fit:
    """Move a fit to the maximum of the marginal posterior.

    Nothing is held. The noise of the motion beside what is stated is looked for from that of the fit. Where the normal
    equations are singular, the fit is returned, not converged.
    """
    problem = stated_problem(task, fit)
    try:
        return _fit(task, problem, marginal_optimum(problem, fit.adjustment), fit.detections)
    except LinAlgError:
        return replace(fit, adjustment=replace(fit.adjustment, converged=False), held=None)


def readjusted(task: Task, fit: Fit, still: bool = False) -> Fit:
    """Adjust a fit to its detections with the noise and the unknowns of a task; `still`: the cameras stay."""
    cameras = task.parameters.build(fit.adjustment.values)
    observations = task.observations(cameras, fit.observations.trajectories, fit.detections)
    fit = replace(fit, held=np.ones(task.parameters.size, dtype=np.bool_) if still else None)
    return adjusted_to(task, fit, observations, fit.detections)


def confirmed_fit(
    task: Task, problem: Problem, values: Array, states: Array, detections: Integers, noise: Array = STATED
) -> Fit:
    """Adjust to the detections of a pass, where the cameras may be far off.

    The joint optimum is found from afar. Where objects move by less than is stated, or manoeuvre, it may lie anywhere:
    of one object before two cameras for ten minutes focal lengths grew tenfold. It counts if the prior allows it, and
    the marginal posterior is greater there than at the values (m,) that it began with, at the noise of the motion (6,)
    that shows. Else the optimum of that is looked for from these.
    """
    states = _settled(problem, values, states)
    begun = _at(problem, values, states, noise)
    agrees = task.parameters.prior_disagreement(values) is None  # a search that goes on from outside may come back
    joint = adjust(problem, values, states, ANNEALED_ITERATIONS, SETTLED_IN_PASSES, within_prior_only=agrees)
    weights = np.maximum(problem.weights(begun.distances), problem.weights(joint.distances))
    still = replace(problem.weighted(weights), held=np.ones(len(values), dtype=np.bool_))
    posterior = MarginalPosterior(Linearisation.of(still))
    with suppress(LinAlgError):  # where nothing can be compared, or found, the joint optimum stays
        first = posterior.with_shown_motion(values, states, noise)
        noise = posterior.parted(first.unknowns)[1]
        last = None
        if task.parameters.prior_disagreement(joint.values) is None:
            with suppress(LinAlgError):
                last = posterior.with_shown_motion(joint.values, joint.states, noise)
        if last is None or last.objective > first.objective:
            begun = replace(begun, states=first.states, motion_noise=noise)
            return _fit(task, problem, marginal_optimum(problem, begun, SETTLED_IN_PASSES), detections)
        noise = posterior.parted(last.unknowns)[1]
    return _fit(task, problem, replace(joint, motion_noise=noise), detections)


def _settled(problem: Problem, values: Array, states: Array) -> Array:
    """Return knots (k, 2, 3) that reach out for their detections, whatever the loss says.

    It would leave out at once what lies beyond the last detection so far, or nearly all where the knots begin at points
    whose depths rays hardly show. Knots that cannot settle stay as they are.
    """
    with suppress(LinAlgError):
        squares = Linearisation.of(replace(problem, loss=SQUARED))
        states, *_ = settled_knots(squares, values, states, most=SETTLING_STEPS)
    return states


def _can_settle(problem: Problem, begun: Adjustment) -> bool:
    """Whether the knots at the beginning of a search find their minimum, to a standard deviation."""
    weighted = Linearisation.of(problem.weighted(problem.weights(begun.distances)))
    with suppress(LinAlgError):
        return settled_knots(weighted, begun.values, begun.states)[1] <= KNOTS_NEAR
    return False


def _at(problem: Problem, values: Array, states: Array, noise: Array) -> Adjustment:
    """Return values (m,), knots (k, 2, 3) and a noise of the motion (6,) as an adjustment that has not begun."""
    linearisation = Linearisation.of(problem)
    there = linearisation.summed(linearisation.residuals(values, states, by_values=False))
    prior = np.diag(problem.parameters.prior_std**2)
    return Adjustment(values, states, prior, there.cost, there.distances, False, noise)


def _fit(task: Task, problem: Problem, found: Adjustment, detections: Integers) -> Fit:
    """Return the fit of an adjustment, its detections timed by the cameras found."""
    cameras, observations = task.parameters.build(found.values), problem.observations
    if not task.parameters.only_moves:
        observations = replace(observations, times=true_times(cameras, observations))
    noise_std = MotionNoise.of(found.motion_noise, least_noise(task.filter.motion)).std
    return Fit(found, replace(problem.knots, noise_std=noise_std), observations, detections, problem.held)


def _knots(task: Task, observations: Observations, points: Array, values: Array, noise: Array = STATED) -> Knots:
    """Knots of trajectories with the given detections, near the given positions, at a noise (6,) of the motion."""
    seen = observations.trajectories
    detected = [observations.times[seen == j] for j in range(int(seen.max()) + 1)]
    length = _length_of_noise(task, observations, points, values)
    factor = float(MotionNoise.of(noise, np.ones(3)).std.max())
    return place_knots(detected, knot_spacing(task.filter.motion, length / factor), task.filter.motion)


def _length_of_noise(task: Task, observations: Observations, points: Array, values: Array) -> float:
    """Median over detections of their noise at the depth of the object, length, in the camera where it is least."""
    depth = np.empty(len(points))
    focal = np.empty(len(points))
    for number, camera in enumerate(task.parameters.build(values)):
        here = observations.cameras == number
        depth[here] = np.abs((points[here] - camera.pose.center) @ camera.pose.rotation[2])
        focal[here] = camera.fx
    lengths = depth / (focal * np.sqrt(observations.precisions[:, 0, 0]))
    return min(float(np.median(lengths[observations.cameras == c])) for c in np.unique(observations.cameras))
