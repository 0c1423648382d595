"""Method annealed, from the starts to the result: what is stated is the answer of a model that was doubted first.

`calibrated` is the whole of it. The best start is brought to the known scale. The answer is then stated (trajectories
integrated out), and doubted: the noise of the detections is estimated until it stays, and what the calibration holds is
tested (`adjustment.suspicions`). Where a contradicted statement may be given up, the answer is stated anew under the
better model. What remains in doubt is a remark.

What a lens does to an image, or a clock, is smooth, and looks like an error that detections share. An error that they
share is as large as the residuals are, so that it contradicts nothing. Errors therefore count as independent until
nothing is contradicted that may be given up; what neighbours still share after that is noise.
"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError

from stereophd.core.arrays import Array, Booleans
from stereophd.core.calibration.adjustment.marginal import curvature_covariance
from stereophd.core.calibration.adjustment.noise import estimate_noise
from stereophd.core.calibration.adjustment.stretches import disagreement_of_stretches
from stereophd.core.calibration.adjustment.suspicions import Suspicion, quadratic_posterior, suspect
from stereophd.core.calibration.adjustment.track_moves import TrackMoves, track_moves
from stereophd.core.calibration.annealing.control import World, WorldControl, with_control
from stereophd.core.calibration.annealing.fits import (
    HistoryRow,
    history_of,
    marginal_fit,
    problem_of,
    readjusted,
    refitted,
    stated_problem,
)
from stereophd.core.calibration.annealing.known_lengths import with_lengths
from stereophd.core.calibration.annealing.known_scale import measured_scale, rescaled
from stereophd.core.calibration.annealing.starts import (
    NOISE_AS_STATED,
    agreeing_with_best,
    best_of,
    rival_of,
    squared_residuals,
)
from stereophd.core.calibration.annealing.task import Fit, Start, Task
from stereophd.core.calibration.time_limit import within
from stereophd.core.calibration.unknowns.held import FOCAL_STD, EnlargedSet, enlarge
from stereophd.core.calibration.unknowns.observability import posed_cameras
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, log_scale, scale_is_free
from stereophd.core.numerics.covariance_factors import covariance_factor
from stereophd.core.numerics.random_streams import NOISE_SEED
from stereophd.wording import percent

# Largest number of refits under a better model, and how many of them at least know of errors that detections share.
MOST_ROUNDS, ROUNDS_OF_SHARED = 12, 3
# Factor on a noise that hides itself.
LOOSENED = 4.0
# A refit with other noise or other unknowns keeps at least this part of the detections, or the association stays.
LEAST_KEPT = 0.8
# Which configured values may be freed: none, those that nobody may have measured, all.
AS_STATED, LENSES, FREE = "as_stated", "lenses", "free"
# An answer whose expected move by what is held exceeds this many of its own standard deviations is not determined.
LARGEST_MOVE = 1.0
# A value this many standard deviations from its prior is reported, and by these factors a noise of detections and of
# the motion.
FAR_FROM_PRIOR, SAID_FACTOR, MOTION_FACTOR = 3.0, 1.5, 4.0
# What is contradicted together is named where it is this many of its standard deviations from what is stated.
CLEAR = 2.0
# An answer whose stated deviations are widened by more than this is not determined.
LARGEST_WIDENING = 3.0
# Where cameras leave tracks uncertain by more than this part s of their distance, deviations hold to first order only:
# a disparity that is two of its deviations off is a distance 1 / (1 - 2 s) times as large, not 1 + 2 s times.
LARGEST_SPREAD = 0.15


@dataclass(frozen=True)
class Choices:
    """What decides between starts and result."""

    model: str = LENSES  # What may be given up of what is stated.
    known: ScaleMeasurement | None = None  # A speed or a length of the scene: of the kind ``speed`` or ``length``
    is_sampled: bool = False  # Whether a sampler states the posterior afterwards.
    control: WorldControl | None = None


@dataclass(frozen=True)
class Remark:
    """A remark on the answer, for the report."""

    # `noise`, `model`, `sensitivity`, `stretches`, `prior`, `motion`, `scale`, `spread`, `starts`, `control` or `time`
    topic: str
    text: str
    is_reservation: bool = False  # Whether the data determine the cameras partly at most.


@dataclass(frozen=True)
class Believed:
    """An answer whose model was doubted."""

    task: Task  # With the scale, the noise and the unknowns of the answer.
    answer: Fit  # The marginal optimum.
    noise: Array  # Noise (c,) of each camera's detections over that of the camera.
    given_up: tuple[Suspicion, ...]  # Of statements that were estimated: contradicted, or images not shown.
    held: tuple[Suspicion, ...]  # Of the statements that the answer holds.
    doubtful: Array  # (m, k): Root of the covariance that the held statements add to that of the answer.
    remarks: tuple[Remark, ...]

    @property
    def contradicted_noise(self) -> Array:
        """`noise` (c,) where it is far from what is stated, and 1 elsewhere."""
        return np.where(is_far(self.noise), self.noise, 1.0)


@dataclass(frozen=True)
class Calibrated:
    """The result of method annealed."""

    believed: Believed
    fit: Fit  # That of the answer, widened, with known lengths and control.
    history: tuple[HistoryRow, ...]
    pairs_of_known_length: int | None
    moves: TrackMoves
    doubt: str  # Why the answer is not to be trusted; empty if it may be.
    remarks: tuple[Remark, ...]
    world: World | None  # That of the control


def calibrated(task: Task, starts: list[Start], choices: Choices) -> Calibrated:
    """Return the answer of the best start; one of them has succeeded."""
    best = best_of(starts)
    assert best is not None
    assert best.fit is not None
    doubt, remarks = doubt_of_starts(task, starts, best, choices.is_sampled)
    task, fit, remark = at_known_scale(task, best.fit, choices.known)
    remarks += remark
    believed = believe(task, fit, choices)
    task, answer = believed.task, believed.answer
    remarks += believed.remarks
    widening = 1.0
    if not choices.is_sampled:
        answer, widening, remark = widened(task, answer, believed.doubtful)
        remarks += remark
    fit, pairs, known = answer, None, choices.known
    # particles are weighed by the scale of lengths alone
    if known is not None and known.kind == "length" and task.scale is not None and not choices.is_sampled:
        fit, pairs = with_lengths(task, fit, known.value, known.std)
    world = None
    if choices.control is not None:
        try:
            fit, world = with_control(task, fit, choices.control)
        except ValueError as error:
            remarks += (Remark("control", f"the control was not used: {error}", is_reservation=True),)
    values = fit.adjustment.values
    doubt = doubt or ("" if answer.adjustment.converged else "the search for the optimum ended before it was found")
    if (against := task.parameters.prior_disagreement(values)) is not None:
        by = known.kind if known is not None else "baseline" if task.scale is not None else ""
        doubt = f"with the known {by} {against}" if by else against
    history, moves = history_of(task, answer, fit), track_moves(problem_of(task, fit), fit.adjustment)
    remarks += motion_remarks(answer, log_scale(task.parameters, task.reference, values)[0], known)
    remarks += (*statement_remarks(believed, bool(doubt), widening), *prior_remarks(task, values))
    if not choices.is_sampled:  # particles need no Gaussian
        remarks += spread_remarks(moves, fit.adjustment.covariance)
    return Calibrated(believed, fit, history, pairs, moves, doubt, remarks, world)


def doubt_of_starts(task: Task, starts: list[Start], best: Start, is_sampled: bool) -> tuple[str, tuple[Remark, ...]]:
    """Return why the best start may be wrong although it is the best (empty if it is trusted), and what to say.

    Where poses alone are unknown, starts that find the right cameras end at one optimum. A best start that stands alone
    although others were run may be a wrong one that happens to explain the log. With further unknowns optima are flat,
    and this is a remark only. The full posterior decides by itself.
    """
    agreeing, least = agreeing_with_best(starts), task.settings.agreeing_starts
    doubt, remarks = "", tuple[Remark, ...]()
    if agreeing < min(least, task.most_starts):
        why = f"only {agreeing} of {len(starts)} starts found these cameras, of {least} wanted: others may be right; "
        why += "narrower priors or more starts (calibration.annealed.starts) show it"
        if not is_sampled and task.parameters.only_moves:
            doubt = why
        else:
            remarks = (Remark("starts", why),)
    assert best.fit is not None
    squares = float(squared_residuals(best.fit).mean())
    if squares > NOISE_AS_STATED:
        text = (
            f"residuals were {np.sqrt(squares):.1f} times the expected noise before it was estimated: "
            "detector.sigma_px is too small, or lenses, clocks or motion do not fit"
        )
        remarks += (Remark("noise", text, is_reservation=True),)
    if not is_sampled and (rival := rival_of(starts)) is not None:
        doubt = f"starts {best.number} and {rival.number} agree with the data alike, and differ; see posterior: smc"
    return doubt, remarks


def why_none_succeeded(starts: list[Start], is_timed: bool = True, is_searched: bool = False) -> str:
    """Return the most frequent reason why starts failed, and what to try.

    That follows from what is unknown: not the clocks (`is_timed`), or all poses, which were searched (`is_searched`).
    """
    often, count = Counter(start.outcome for start in starts).most_common(1)[0]
    tries = [f"`check` compares {'clocks and noise' if is_timed else 'the noise'} with the log"]
    tries += [] if is_searched else ["a pose that is far off needs wider priors, or `pose: unknown`"]
    tries += ["where cameras share hardly any object, record more that two of them see"]
    return f"none of {len(starts)} starts agrees with the data; most often ({count}): {'; '.join([often, *tries])}"


def at_known_scale(task: Task, fit: Fit, known: ScaleMeasurement | None) -> tuple[Task, Fit, tuple[Remark, ...]]:
    """Adjust again where speeds or a length of the scene are known; the task holds their measurement of the scale."""
    if known is None:
        return task, fit, ()
    if not scale_is_free(task.parameters):
        why = f"the centres of two cameras are known, which fixes the scale: the known {known.kind} was not used"
        return task, fit, (Remark("scale", why),)
    measured = measured_scale(task, fit, known)
    if measured is None:
        reasons = {
            "speed": "the objects do not agree on one speed: the known speed was not used",
            "length": "no two objects keep their distance, or chance may have it: the known length was not used",
        }
        return task, fit, (Remark("scale", reasons[known.kind]),)
    return replace(task, scale=measured), rescaled(task, fit, measured), ()


def chosen_anew(task: Task, fit: Fit, still: bool = False) -> Fit:
    """Let the trajectories of a fit choose their detections anew, unless that leaves many out."""
    chosen = refitted(task, fit, still=still)
    return fit if chosen is None or len(chosen.detections) < LEAST_KEPT * len(fit.detections) else chosen


def believe(task: Task, fit: Fit, choices: Choices) -> Believed:
    """State the answer, and state it anew with the noise of the residuals and without what the data contradict.

    Each round: (1) the answer, where there is none, is the marginal optimum of the fit. (2) Its trajectories choose
    detections anew, whose residuals show the noise. (3) Where that is another, the search goes on from the answer, or
    begins at the joint optimum where it had not converged or residuals hide the noise; the next round follows. (4) Once
    the noise stays, what is held is tested; what is unknown (`Suspicion.is_unknown`) is freed, beginning as stated, for
    the next round. (5) The errors of detections are independent at first, and shared within a radius once nothing is.
    """
    count = len(task.parameters.cameras)
    noise, shared = np.ones(count), np.zeros(count)
    given_up, held = list[Suspicion](), list[Suspicion]()
    from_above, remarks = np.zeros(count, dtype=np.bool_), tuple[Remark, ...]()
    answer: Fit | None = None
    radius, is_tested = 0.0, False  # Within which detections share errors; whether nothing else is left to be doubted.
    for number in range(MOST_ROUNDS):
        if not task.limit.begin(f"what the answer assumes is tested, round {number + 1} of at most {MOST_ROUNDS}"):
            text = "the time was over before the answer was found and tested: these cameras are the best so far"
            answer = answer or fit
            held, remarks = [], (Remark("time", text, is_reservation=True),)
            break
        if number >= MOST_ROUNDS - ROUNDS_OF_SHARED:
            radius = task.settings.shared_error_px
        last = choices.is_sampled or number == MOST_ROUNDS - 1  # particles are weighed as the configuration states
        if answer is None:
            answer = marginal_fit(task, fit)
        chosen = chosen_anew(task, answer, still=True) if answer.adjustment.converged else answer
        estimate = estimate_noise(
            problem_of(task, chosen), chosen.adjustment, noise, shared, radius, np.random.default_rng(NOISE_SEED)
        )
        differs, hides = estimate.differs(shared, from_above), estimate.hides & ~from_above
        is_new = bool((differs | hides).any()) and not last
        if is_tested and not is_new:
            break
        is_tested = False
        if is_new:
            factors = np.where(hides, LOOSENED, np.where(differs, estimate.factors, 1.0))
            shared = np.where(hides, 0.0, np.where(differs, estimate.shared, shared))
            task, noise = task.with_noise(factors, shared), noise * factors
            from_above |= hides
        if answer.adjustment.converged and not hides.any():
            # the search goes on from the marginal optimum, with the noise of the task: the joint one is biased
            again = marginal_fit(task, readjusted(task, chosen, still=True))
            if is_new or again.adjustment.converged:
                answer = again
        fit = answer
        if is_new:
            if hides.any() or not answer.adjustment.converged:
                fit, answer = chosen_anew(task, readjusted(task, fit)), None
            continue
        try:
            enlarged, held = suspected(task, answer)
        except LinAlgError:
            text = "what is held as stated could not be tested: the posterior is singular"
            held, remarks = [], (Remark("model", text, is_reservation=True),)
            break
        wrong = next((s for s in held if s.is_unknown and may_be_freed(s, choices, task.parameters)), None)
        if wrong is not None and not last:
            given_up.append(wrong)
            task, fit = with_freed(task, fit, enlarged, wrong)
            answer = None
        elif radius < task.settings.shared_error_px and not last:
            radius, is_tested = task.settings.shared_error_px, True
        else:
            break
    assert answer is not None
    size = task.parameters.size
    doubtful = np.hstack([np.zeros((size, 0)), *(suspicion.spread[:size] for suspicion in held)])
    remarks = (*noise_remarks(task, noise), *remarks)
    return Believed(task, answer, noise, tuple(given_up), tuple(held), doubtful, remarks)


def suspected(task: Task, answer: Fit) -> tuple[EnlargedSet, list[Suspicion]]:
    """Test what an answer holds as stated; the statement of the greatest evidence against it first."""
    within("what is held as stated is tested")
    enlarged = enlarge(task.parameters, task.reference, task.recording.periods(len(task.parameters.cameras)))
    problem = stated_problem(task, answer)
    quadratic = quadratic_posterior(problem, enlarged, answer.adjustment)
    return enlarged, suspect(quadratic, enlarged, np.arange(task.parameters.size))


def widened(task: Task, answer: Fit, doubtful: Array) -> tuple[Fit, float, tuple[Remark, ...]]:
    """Give an answer its exact covariance, and widen it by the disagreement of stretches of the log; say if large.

    `doubtful` (m, k) is the root of the covariance that what is stated adds. By how much the cameras were widened at
    most is returned as well.
    """
    problem, adjustment = stated_problem(task, answer), answer.adjustment
    task.limit.begin("the covariance of the answer is computed")
    if adjustment.converged:
        try:
            exact = curvature_covariance(problem, adjustment, task.threads)
            adjustment = replace(adjustment, covariance=exact)
        except LinAlgError:
            adjustment = replace(adjustment, converged=False)
    try:
        more, factor, of_cameras = disagreement_of_stretches(problem, adjustment)
    except LinAlgError:
        return replace(answer, adjustment=replace(adjustment, converged=False)), 1.0, ()
    adjustment = replace(adjustment, covariance=adjustment.covariance + more + doubtful @ doubtful.T)
    text = (
        f"stretches of the log disagree by up to {factor:.1f} times what their noise allows ({of_cameras:.1f} times "
        "about the cameras): the stated deviations were widened; errors of detections last, or something stated is "
        "wrong"
    )
    remark = Remark("stretches", text, factor > LARGEST_WIDENING)
    return replace(answer, adjustment=adjustment), of_cameras, (remark,) if factor > SAID_FACTOR else ()


def may_be_freed(suspicion: Suspicion, choices: Choices, parameters: ParameterSet) -> bool:
    """Whether a statement that is contradicted, or not shown, may be given up."""
    if suspicion.group.is_unmeasured:
        return choices.model != AS_STATED
    return choices.model == FREE and is_shown(suspicion, parameters)


def is_shown(suspicion: Suspicion, parameters: ParameterSet) -> bool:
    """Whether the data can show what a statement is about: two cameras of unknown pose fit many focal lengths."""
    return suspicion.group.quantity != "focal" or len(parameters.cameras) > 2 or not posed_cameras(parameters)


def with_freed(task: Task, fit: Fit, enlarged: EnlargedSet, suspicion: Suspicion) -> tuple[Task, Fit]:
    """Return the task with what was doubted among its unknowns, and the fit, which has it as it was stated.

    What nobody has measured with it is unknown, too. The trajectories follow it with the noise of the motion that was
    found, and the search for the marginal optimum begins there. The joint optimum of all that runs away where objects
    manoeuvre, to a lens from which that search does not come back.
    """
    places = enlarged.unmeasured_with(suspicion.group)
    task = replace(task, parameters=enlarged.freed(task.parameters, places))
    values = np.append(fit.adjustment.values, np.zeros(len(places)))
    begin = replace(fit, adjustment=replace(fit.adjustment, values=values))
    return task, readjusted(task, begin, still=True)


def spread_remarks(moves: TrackMoves, covariance: Array) -> tuple[Remark, ...]:
    """Say where the cameras leave tracks so uncertain that a Gaussian statement of them does not hold."""
    spread = moves.relative_std(covariance_factor(covariance))
    if spread <= LARGEST_SPREAD:
        return ()
    text = (
        f"the cameras leave tracks uncertain by {percent(spread)} of their distance, and with so much their standard "
        "deviations hold to first order only: more objects, or objects nearer to the cameras, narrow it"
    )
    return (Remark("spread", text, is_reservation=True),)


def motion_remarks(answer: Fit, scale: float, known: ScaleMeasurement | None) -> tuple[Remark, ...]:
    """Return a remark if the noise of the motion is far from the stated one; it proposes no length that is `known`.

    The noise is that in a scene of this logarithm of its `scale`.
    """
    factor = float(np.exp(np.log(answer.motion_factors).mean()))
    if abs(np.log(factor)) <= np.log(MOTION_FACTOR):
        return ()
    value = float(np.exp(np.log(answer.knots.noise_std).mean() + scale))
    text = (
        f"the objects accelerate by {value:.2g} length/s^2, {factor * np.exp(scale):.2g} times as much as "
        "motion.acceleration_std states; what they show was used: state it, unless objects move together"
    )
    if known is None or known.kind != "length":
        text += " (corners of a board: state their known distance, calibration.scale.kind: length)"
    return (Remark("motion", text),)


def is_far(noise: Array) -> Booleans:
    """Whether noises (c,) are far from what is stated."""
    return np.asarray(np.maximum(noise, 1.0 / noise) > SAID_FACTOR)


def noise_remarks(task: Task, noise: Array) -> tuple[Remark, ...]:
    """Say where the noise of the detections is far from that of the cameras."""
    sigma = [float(camera.detector.sigma.mean()) for camera in task.parameters.cameras]
    return tuple(
        Remark(
            "noise",
            f"{camera.name}: the residuals show {factor:.2g} times the noise that was expected; {factor * px:.2g} px "
            f"were used in place of {px:.3g} px",
        )
        for camera, factor, px, said in zip(task.parameters.cameras, noise.tolist(), sigma, is_far(noise), strict=True)
        if said
    )


def statement_remarks(believed: Believed, is_doubted: bool, widening: float = 1.0) -> tuple[Remark, ...]:
    """Return remarks on statements that were given up or that the data contradict, and on which the answer depends.

    Of an answer that is doubted only the contradictions are reported. What lasting errors may do as well, by how much
    they have widened the answer, is no contradiction.
    """
    remarks = [
        Remark(
            "model",
            f"the data {'contradict what is' if one.is_contradicted else 'do not show that images are as'} stated: "
            f"{fitting(one, is_doubted)} fits; it was estimated (calibration.model: as_stated keeps the statement)",
        )
        for one in believed.given_up
    ]
    contradicted = next((s for s in believed.held if s.is_contradicted), None)
    if contradicted is not None:
        can_tell = is_shown(contradicted, believed.task.parameters)
        remedy = "measure it: two cameras do not show it"
        if can_tell:
            model = "lenses" if contradicted.group.is_unmeasured else "free"
            remedy = f"state it, give it a prior, or let it be estimated (calibration.model: {model})"
        text = f"the data contradict what is stated: {fitting(contradicted, is_doubted or not can_tell)} fits; {remedy}"
        if not contradicted.is_contradicted_at(widening):
            text = f"{fitting(contradicted, is_doubted=True)} may fit better, or errors of detections last; {remedy}"
        remarks.append(Remark("model", text, is_reservation=True))
    largest = max(believed.held, key=lambda s: s.expected_move, default=None)
    if contradicted is None and not is_doubted and largest is not None and largest.expected_move > LARGEST_MOVE:
        text = (
            f"the answer depends on what is stated: the data allow {fitting(largest)} too, which moves tracks by "
            f"{largest.expected_move:.1f} of their stated standard deviations"
        )
        return (*remarks, Remark("sensitivity", text, is_reservation=True))
    hidden = max(
        (s for s in believed.held if not is_shown(s, believed.task.parameters)), key=lambda s: s.moves, default=None
    )
    if contradicted is None and not is_doubted and hidden is not None and hidden.moves > LARGEST_MOVE:
        names = hidden.group.names
        priors = dict.fromkeys(f"calibration.priors.{name.rpartition('.')[0]}.focal_std" for name in names)
        text = (
            f"two cameras do not show whether {' and '.join(names)} are as stated: if they were "
            f"{percent(FOCAL_STD)} off, tracks would be off by {hidden.moves:.1f} of their stated standard deviations "
            f"(remedy: state how well they are known, {' and '.join(priors)})"
        )
        remarks.append(Remark("sensitivity", text))
    return tuple(remarks)


def fitting(suspicion: Suspicion, is_doubted: bool = False) -> str:
    """Name the clear unknowns of a suspicion, with the values that fit if they are of an answer that is not doubted."""
    clear = np.abs(suspicion.values) >= CLEAR * suspicion.stds
    places = np.flatnonzero(clear | ~clear.any())
    if is_doubted:
        return f"another {', '.join(suspicion.group.names[place] for place in places)}"
    return ", ".join(
        f"{suspicion.group.names[place]} {suspicion.values[place]:+.3g} +- {suspicion.stds[place]:.2g}"
        for place in places
    )


def prior_remarks(task: Task, values: Array) -> tuple[Remark, ...]:
    """Say which values lie far from their own priors."""
    parameters = task.parameters
    scaled = (values - parameters.prior_mean) / parameters.prior_std
    return tuple(
        Remark(
            "prior",
            f"{name} lies {abs(distance):.1f} standard deviations of its prior from the mean: the prior is too narrow, "
            "or the answer is wrong",
            is_reservation=True,
        )
        for name, distance in zip(parameters.names, scaled.tolist(), strict=True)
        if abs(distance) > FAR_FROM_PRIOR
    )
