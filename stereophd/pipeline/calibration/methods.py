"""Method annealed of `calibrate`, from a problem to an `Outcome`, with checkpoints."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from stereophd.config.calibration import CalibrationConfig, LengthScale, SpeedScale
from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.marginal import LEFT_OUT
from stereophd.core.calibration.adjustment.selection import compare
from stereophd.core.calibration.annealing.fits import fit_until, marginal_fit, problem_of, restricted_fit
from stereophd.core.calibration.annealing.known_lengths import with_lengths
from stereophd.core.calibration.annealing.known_scale import measured_scale, rescaled
from stereophd.core.calibration.annealing.starts import (
    agreeing_with_best,
    best_of,
    distinct,
    enough,
    modes_of,
    rival_of,
    run_start,
    start_values,
)
from stereophd.core.calibration.annealing.task import Fit, Start, Task
from stereophd.core.calibration.pairing.clock_search import offset_places
from stereophd.core.calibration.unknowns.observability import laplace_draws
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, scale_is_free
from stereophd.core.calibration.unknowns.unknown_sets import candidates
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.random_streams import CALIBRATION_PAIRING, CALIBRATION_STARTS, POSTERIOR_DRAWS
from stereophd.pipeline.calibration.inputs import CalibrationProblem, annealed_task
from stereophd.pipeline.calibration.outcome import HistoryRow, Outcome
from stereophd.pipeline.calibration.samplers import smc_outcome
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.workers.processes import on_processes

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig

LOGGER = logging.getLogger("stereophd")

# Draws that represent a Laplace posterior, and times at which the history holds it.
LAPLACE_DRAWS = 1000
HISTORY_TIMES = 25


def annealed_outcome(
    loaded: LoadedConfig,
    section: CalibrationConfig,
    problem: CalibrationProblem,
    unfinished: UnfinishedRun,
    jobs: int,
    progress: Progress | None,
) -> Outcome:
    """Method annealed, with the posterior that the section names."""
    task = annealed_task(loaded, section, problem)
    starts = _all_starts(loaded, task, unfinished, jobs, progress)
    best = best_of(starts)
    details: dict[str, Any] = {
        "starts": [_start_report(problem, start, best) for start in starts],
        "agreeing_starts": agreeing_with_best(starts),
        "stages": [list(stage.names) for stage in task.stages],
    }
    if (offset_places(problem.parameters) >= 0).any():
        details["clocks"] = _clock_report(task)
    size = problem.parameters.size
    if best is None or best.fit is None:
        often, _ = Counter(start.outcome for start in starts).most_common(1)[0]
        why = f"none of {len(starts)} starts agrees with the data; most often: {often}"
        nothing = np.full((size, size), np.nan)
        return Outcome(nothing[0], nothing, np.empty((0, size)), np.empty(0), (), why, "", None, details)
    doubt = doubt_of_starts(section, task, starts, best)
    task, fit = _at_known_scale(section, task, best.fit, details)
    joint = selected(section, task, fit, details)
    # known lengths hold what objects that move together would make too sure
    known = section.scale if isinstance(section.scale, LengthScale) and task.scale is not None else None
    fit, noise, against_marginal = marginal_fit(task, joint, any_noise=known is not None and joint.held is None)
    if fit is joint and noise != 1.0:
        LOGGER.warning(
            "the motion of the objects shows %.2g times the noise that the configuration states: the trajectories are "
            "not integrated out. motion.acceleration_std is wrong, or objects move together (corners of a board: state "
            "their known distance, calibration.scale.kind: length)",
            noise,
        )
    details["motion_noise_factor"] = noise
    early = "" if fit.adjustment.converged else "the search for the optimum ended before it was found"
    doubt = doubt or against_marginal or early
    without_lengths = fit
    if known is not None:
        fit, details["known_lengths"] = with_lengths(task, fit, known.length, known.std)
    mean, covariance = fit.adjustment.values, fit.adjustment.covariance
    if (against := task.parameters.prior_disagreement(mean)) is not None:
        doubt = against if section.scale.kind == "none" else f"with the known {section.scale.kind} {against}"
    details["fit"] = _fit_report(problem, best, fit)
    # integrating the trajectories out each time takes too long: the last row is the result, the others joint optima
    times = np.linspace(problem.recording.times[0], problem.recording.times[-1], HISTORY_TIMES + 1)[1:]
    history = (
        *(
            HistoryRow(float(time_s), until.adjustment.values, until.adjustment.covariance)
            for time_s in times[:-1]
            if (until := fit_until(task, without_lengths, float(time_s))) is not None
        ),
        HistoryRow(float(times[-1]), mean, covariance),
    )
    if section.posterior == "smc":
        found = distinct(starts)
        fits = [mode.fit if task.scale is None else rescaled(task, mode.fit, task.scale) for mode in found if mode.fit]
        modes = modes_of(fits, [mode.score for mode in found])
        outcome = smc_outcome(
            loaded, section, problem, task.scale, modes, fit, history, details, unfinished, jobs, progress
        )
        return replace(outcome, doubt=doubt)
    rng = np.random.default_rng(POSTERIOR_DRAWS.seed(loaded.config.seed))
    draws = laplace_draws(problem.parameters, problem.reference, mean, covariance, LAPLACE_DRAWS, rng)
    weights = np.full(LAPLACE_DRAWS, -np.log(LAPLACE_DRAWS))
    return Outcome(mean, covariance, draws, weights, history, "", doubt, fit, details)


def doubt_of_starts(section: CalibrationConfig, task: Task, starts: list[Start], best: Start) -> str:
    """Return why the best start may be wrong although it is the best; empty if it is trusted.

    Where poses alone are unknown, starts that find the right cameras end at one optimum. A best start that stands alone
    although others were run may be a wrong one that happens to explain the log. With further unknowns optima are flat,
    and this is a warning only. The full posterior decides by itself.
    """
    found, wanted = agreeing_with_best(starts), min(task.settings.agreeing_starts, task.most_starts)
    doubt = ""
    if found < wanted:
        why = f"only {found} of {len(starts)} starts found these cameras: another optimum may be the right one"
        if section.posterior == "laplace" and task.parameters.only_moves:
            doubt = f"{why}; narrower priors show it, or more starts (calibration.annealed.starts)"
        else:
            LOGGER.warning("%s; narrower priors or more starts (calibration.annealed.starts) show it", why)
    if section.posterior == "laplace" and (rival := rival_of(starts)) is not None:
        doubt = f"starts {best.number} and {rival.number} agree with the data alike, and differ; see posterior: smc"
    return doubt


def _all_starts(
    loaded: LoadedConfig, task: Task, unfinished: UnfinishedRun, jobs: int, progress: Progress | None
) -> list[Start]:
    """Run starts until enough agree."""
    count, agreeing = task.most_starts, task.settings.agreeing_starts
    values = start_values(task.parameters, CALIBRATION_STARTS.seed(loaded.config.seed), count)
    seeds = CALIBRATION_PAIRING.seed(loaded.config.seed).spawn(count)
    starts: list[Start] = unfinished.read("starts", list[Start], {Motion: task.filter.motion}) or []
    if enough(starts, agreeing):
        return starts
    for start in _run_starts(task, values, seeds, len(starts), jobs):
        starts.append(start)
        unfinished.keep("starts", starts)
        if progress is not None:
            progress(len(starts), count)
        if enough(starts, agreeing):
            break
    return starts


def _run_starts(
    task: Task, values: Array, seeds: list[np.random.SeedSequence], done: int, jobs: int
) -> Iterator[Start]:
    """Outcomes of the starts that are not done yet, in order."""
    numbers = range(done, len(values))
    if jobs == 1 or len(numbers) < 2:
        for number in numbers:
            yield run_start(task, number, values[number], seeds[number])
        return
    # No more ahead than there are workers: starts that are not needed are not begun.
    arguments = ((task, number, values[number], seeds[number]) for number in numbers)
    yield from on_processes(_run_start, arguments, jobs)


def _run_start(arguments: tuple[Task, int, Array, np.random.SeedSequence]) -> Start:
    return run_start(*arguments)


def _at_known_scale(section: CalibrationConfig, task: Task, fit: Fit, details: dict[str, Any]) -> tuple[Task, Fit]:
    """Adjust again where speeds or a length of the scene are known; the task holds their measurement of the scale."""
    scale = section.scale
    measured: ScaleMeasurement | None = None
    if isinstance(scale, SpeedScale | LengthScale) and not scale_is_free(task.parameters):
        details["scale_warning"] = (
            f"the centres of two cameras are known, which fixes the scale: the known {scale.kind} was not used"
        )
    elif isinstance(scale, SpeedScale):
        measured = measured_scale(task, fit, "speed", scale.speed, scale.std)
        if measured is None:
            details["scale_warning"] = "the objects do not agree on one speed: the known speed was not used"
    elif isinstance(scale, LengthScale):
        measured = measured_scale(task, fit, "length", scale.length, scale.std)
        if measured is None:
            details["scale_warning"] = (
                "no two objects keep their distance, or chance may have it: the known length was not used"
            )
    if measured is None:
        return task, fit
    return replace(task, scale=measured), rescaled(task, fit, measured)


def selected(section: CalibrationConfig, task: Task, fit: Fit, details: dict[str, Any]) -> Fit:
    """Adjust with the set of unknowns that predicts the log best, and report the comparison."""
    if section.select == "all" or section.posterior == "smc":
        return fit
    sets = candidates(task.parameters)
    found = compare(problem_of(task, fit), fit.adjustment.values, fit.adjustment.states, sets)
    if found is None:
        return fit
    details["selection"] = {
        "chosen": list(found.sets[found.chosen].names),
        "sets": [
            {"unknowns": list(one.names), "held_out_loss": float(total), "above_all": float(total - found.totals[-1]),
             "above_all_std_error": float(error)}
            for one, total, error in zip(found.sets, found.totals, found.errors, strict=True)
        ],
    }  # fmt: skip
    free = found.sets[found.chosen].free
    return fit if free.all() else restricted_fit(task, fit, free)


def _clock_report(task: Task) -> dict[str, Any]:
    """Offsets of unknown clocks by the speed profiles of one-camera tracks, and what motion does not show."""
    out: dict[str, Any] = {}
    for camera, place, offset, score in zip(
        task.parameters.cameras, offset_places(task.parameters), task.clocks.offsets, task.clocks.scores, strict=True
    ):
        if place >= 0:
            shown = bool(score > 0.0)
            out[camera.name] = {"shown_by_motion": shown, "offset_s": float(offset) if shown else None, "score": score}
    return out


def _start_report(problem: CalibrationProblem, start: Start, best: Start | None) -> dict[str, Any]:
    nothing: list[float] = []
    values = nothing if start.fit is None else start.fit.adjustment.values.tolist()
    return {
        "start": start.number,
        "began_from": start.origin,
        "outcome": start.outcome,
        "best": start is best,
        "passes": len(start.passes),
        "explained": start.explained,
        "log_evidence": _number(start.log_evidence),
        "log_prior": _number(start.log_prior),
        "values": dict(zip(problem.parameters.names, values, strict=False)),
    }


def _fit_report(problem: CalibrationProblem, best: Start, fit: Fit) -> dict[str, Any]:
    inliers = fit.adjustment.distances[fit.adjustment.distances < np.inf]
    return {
        "trajectories": fit.knots.count,
        "detections": len(fit.detections),
        "explained": best.explained,
        "rms_residual_sigmas": float(np.sqrt(np.minimum(inliers, LEFT_OUT).mean() / 2.0)),
        "log_evidence": best.log_evidence,
        "log_prior": best.log_prior,
        "converged": fit.adjustment.converged,
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
