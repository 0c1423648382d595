"""Method annealed of `calibrate`: its starts, kept while the run is unfinished, on processes, and its `Outcome`."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from operator import call
from typing import Any, cast

import numpy as np

from stereophd.config.calibration import CalibrationConfig, LengthScale, SpeedScale
from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.marginal import LEFT_OUT
from stereophd.core.calibration.annealing.known_scale import rescaled
from stereophd.core.calibration.annealing.method import (
    AS_STATED,
    Calibrated,
    Choices,
    Remark,
    calibrated,
    why_none_succeeded,
)
from stereophd.core.calibration.annealing.starts import (
    agreeing_with_best,
    best_of,
    compared,
    distinct,
    followed_before,
    is_led_to,
    modes_of,
    paired,
    run_start,
    start_values,
)
from stereophd.core.calibration.annealing.task import Start, Task
from stereophd.core.calibration.unknowns.held import with_unmeasured
from stereophd.core.calibration.unknowns.observability import laplace_draws
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.random_streams import CALIBRATION_PAIRING, CALIBRATION_STARTS, POSTERIOR_DRAWS
from stereophd.io.outputs.json_text import finite_or_none
from stereophd.pipeline.calibration.problem import CalibrationRun, Outcome, annealed_task, part_used
from stereophd.pipeline.calibration.sampled import smc_outcome
from stereophd.pipeline.workers.places import worker_processes
from stereophd.wording import PROGRESS

# Draws that represent a Laplace posterior.
LAPLACE_DRAWS = 1000


def annealed_outcome(run: CalibrationRun) -> Outcome:
    """Method annealed, with the posterior that the section names.

    Where no start agrees with the data, or the first that explain them end at cameras that are ruled out, what nobody
    may have measured is unknown from the beginning.
    """
    problem, section, stated = run.problem, run.section, run.problem.parameters.size
    run.limit.begin("one-camera tracks are made")
    is_timed = not problem.parameters.clock_offset_stds.any()
    task, unmeasured = _task(run), _unmeasured(run)
    starts, failed = _all_starts(run, task, unmeasured.size > stated), list[dict[str, Any]]()
    if best_of(starts) is None and unmeasured.size > stated and not run.limit.is_over:
        run.limit.begin("no start agrees: starts begin anew with what nobody may have measured unknown")
        failed = [_start_report(task, start, None) for start in starts]
        problem = replace(problem, parameters=unmeasured)
        run = replace(run, problem=problem)
        task = _task(run)
        starts = _all_starts(run, task, kept="starts_unmeasured")
    best = best_of(starts)
    details: dict[str, Any] = {
        "starts": [*failed, *(_start_report(task, start, best) for start in starts)],
        "agreeing_starts": agreeing_with_best(starts),
        "input": {**problem.counts, **part_used(problem, task)},
    }
    if best is None:
        return Outcome.of_none(problem.parameters, why_none_succeeded(starts, is_timed, run.is_searched), details)
    result = calibrated(task, starts, replace(choices_of(section), control=problem.control))
    believed = result.believed
    details |= _result_report(result, best, stated)
    if problem.parameters.size > stated:
        names = ", ".join(problem.parameters.names[stated:])
        text = f"no start agrees with cameras as stated: {names} were estimated (calibration.model: as_stated forbids)"
        result = replace(result, remarks=(Remark("model", text, is_reservation=True), *result.remarks))
    adjustment = result.fit.adjustment
    outcome = Outcome(
        believed.task.parameters, adjustment.values, adjustment.covariance, np.empty((0, 0)), np.empty(0),
        result.history, "", result.doubt, result.fit, result.remarks, result.moves, result.world, details,
        1.0 if problem.noise_in_log else believed.contradicted_noise,
    )  # fmt: skip
    if section.posterior == "laplace":
        draws = laplace_draws(
            outcome.parameters, problem.reference, outcome.values, outcome.covariance, LAPLACE_DRAWS,
            np.random.default_rng(POSTERIOR_DRAWS.seed(run.loaded.config.seed)),
        )  # fmt: skip
        return replace(outcome, particles=draws, log_weights=np.full(LAPLACE_DRAWS, -np.log(LAPLACE_DRAWS)))
    scale, found = believed.task.scale, distinct(starts)
    fits = [mode.fit if scale is None else rescaled(task, mode.fit, scale) for mode in found if mode.fit]
    return smc_outcome(run, believed.task, modes_of(fits, [mode.score for mode in found]), outcome)


def _task(run: CalibrationRun) -> Task:
    task = annealed_task(run.loaded, run.section, run.problem)
    return replace(task, limit=run.limit, threads=run.jobs, history_times=run.history_times)


def _unmeasured(run: CalibrationRun) -> ParameterSet:
    """Return the unknowns of a run, and those that nobody may have measured where these may be given up."""
    problem = run.problem
    if run.section.model == AS_STATED:
        return problem.parameters
    cameras = len(problem.parameters.cameras)
    return with_unmeasured(problem.parameters, problem.reference, problem.recording.periods(cameras))


def choices_of(section: CalibrationConfig) -> Choices:
    """Return what of a section decides between starts and result."""
    known = None
    if isinstance(section.scale, SpeedScale):
        known = ScaleMeasurement("speed", section.scale.speed, section.scale.std)
    elif isinstance(section.scale, LengthScale):
        known = ScaleMeasurement("length", section.scale.length, section.scale.std)
    return Choices(section.model, known, section.posterior == "smc")


def _all_starts(run: CalibrationRun, task: Task, may_refuse: bool = False, kept: str = "starts") -> list[Start]:
    """Run starts until enough agree or, if that `may_refuse` the others, as many explain the log and are ruled out.

    They are kept under a name while the run is unfinished. The second is nearly always led to what the first has found:
    processes begin for those after it.
    """
    count, agreeing = task.most_starts, task.settings.agreeing_starts
    values = start_values(task.parameters, CALIBRATION_STARTS.seed(run.loaded.config.seed), count)
    seeds = CALIBRATION_PAIRING.seed(run.loaded.config.seed).spawn(count)
    starts: list[Start] = run.unfinished.read(kept, list[Start], {Motion: task.filter.motion}) or []

    def is_done() -> bool:
        explaining = sum(start.explained >= task.settings.min_tracked for start in starts)
        is_refused = may_refuse and best_of(starts) is None and explaining >= agreeing
        enough = agreeing_with_best(starts) >= agreeing or is_refused
        return len(starts) == count or enough or (bool(starts) and run.limit.is_over)

    if not is_done():
        run.limit.begin(f"up to {count} starts begin")
    jobs, results_of = 1, cast("Callable[..., Iterator[Any]]", map)
    with ExitStack() as held:
        while not is_done():
            if jobs == 1 and len(starts) > 1 and (jobs := min(run.jobs, count - len(starts))) > 1:
                results_of = held.enter_context(worker_processes(jobs, PROGRESS.debug))
            for start in _next_starts(task, starts, values, seeds, results_of, jobs):
                starts[:] = compared(task, [*starts, start])
                if not run.limit.is_over:  # one that the time has cut short is done again
                    run.unfinished.keep(kept, list(starts))
                run.progress(len(starts), count)
                if is_done():
                    break
    return starts


def _next_starts(
    task: Task, starts: list[Start], values: Array, seeds: list[np.random.SeedSequence],
    results_of: Callable[..., Iterator[Any]], jobs: int,
) -> Iterator[Start]:  # fmt: skip
    """Yield the starts after those that there are, as many as there are processes, which `results_of` calls.

    All are paired, and those of one pairing are followed once: they would end alike.
    """
    places, std = range(len(starts), min(len(starts) + jobs, len(values))), task.parameters.prior_std
    calls = [partial(paired, task, place, values[place], seeds[place]) for place in places]
    pairings = dict(zip(places, results_of(call, calls), strict=True))
    firsts = [
        place
        for place in places
        if followed_before(task, starts, place, pairings[place]) is None
        and not any(
            is_led_to(pairings[place], p, std) for one in places[: place - places[0]] for p in pairings[one][:1]
        )
    ]
    followed = results_of(call, [partial(run_start, task, place, values[place], pairings[place]) for place in firsts])
    for place in places:
        own = next(followed) if place in firsts else None
        # one before it may have ended at another than its first pairing: processes decide about none
        before = followed_before(task, starts, place, pairings[place])
        yield before or own or run_start(task, place, values[place], pairings[place])


def _start_report(task: Task, start: Start, best: Start | None) -> dict[str, Any]:
    values = list[float]() if start.fit is None else start.fit.adjustment.values.tolist()
    return {
        "start": start.number,
        "began_from": start.origin,
        "outcome": start.outcome,
        "best": start is best,
        "passes": len(start.passes),
        "explained": start.explained,
        "log_evidence": finite_or_none(start.log_evidence),
        "log_prior": finite_or_none(start.log_prior),
        "values": dict(zip(task.parameters.names, values, strict=False)),
    }


def _result_report(result: Calibrated, best: Start, stated: int) -> dict[str, Any]:
    """What the report holds of the way from the best start to the answer; of all unknowns `stated` were stated."""
    believed, fit = result.believed, result.fit
    inliers = fit.adjustment.distances[fit.adjustment.distances < np.inf]
    report: dict[str, Any] = {
        "motion_noise_factor": believed.answer.motion_factors.tolist(),
        "noise_factors": {
            camera.name: factor
            for camera, factor in zip(believed.task.parameters.cameras, believed.noise.tolist(), strict=True)
        },
        "freed": list(believed.task.parameters.names[stated:]),
        "stated": _statements(result),
        "fit": {
            "trajectories": fit.knots.count,
            "detections": len(fit.detections),
            "explained": best.explained,
            "rms_residual_sigmas": float(np.sqrt(np.minimum(inliers, LEFT_OUT).mean() / 2.0)),
            "log_evidence": best.log_evidence,
            "log_prior": best.log_prior,
            "converged": fit.adjustment.converged,
        },
    }
    if result.pairs_of_known_length is not None:
        report["known_lengths"] = result.pairs_of_known_length
    if (why := next((remark.text for remark in result.remarks if remark.topic == "scale"), None)) is not None:
        report["scale_warning"] = why
    return report


def _statements(result: Calibrated) -> list[dict[str, Any]]:
    """The evidence against each configured value: the offset that fits, and how far it moves tracks."""
    return [
        {
            "unknowns": {
                name: {"value": float(value), "std": float(std)}
                for name, value, std in zip(suspicion.group.names, suspicion.values, suspicion.stds, strict=True)
            },
            "log_evidence": suspicion.log_evidence,
            "contradicted": suspicion.is_contradicted,
            "moves_stds": suspicion.moves,
            "expected_move_stds": suspicion.expected_move,
        }
        for suspicion in (*result.believed.given_up, *result.believed.held)
    ]
