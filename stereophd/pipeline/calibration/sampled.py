"""What `calibrate` samples: method sequential, and posterior smc."""

from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.annealing.fits import HistoryRow, fit_from
from stereophd.core.calibration.annealing.method import Calibrated
from stereophd.core.calibration.annealing.starts import NOISE_AS_STATED, RIVAL_DISTANCE, disagreement, explained
from stereophd.core.calibration.sampling import bridging, sequential
from stereophd.core.calibration.sampling.bridging import BridgeInfo, BridgeResult, BridgeSampler, BridgeState
from stereophd.core.calibration.sampling.likelihood import Evidence
from stereophd.core.calibration.sampling.paths import BlockPath, LogEvidence, TemperedPath
from stereophd.core.calibration.sampling.recording_evidence import RecordingEvidence
from stereophd.core.calibration.sampling.sequential import SequentialInfo, SequentialState
from stereophd.core.calibration.unknowns.modes import Modes
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, can_be_enlarged, scale_is_free
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.camera_hypotheses.batch import FilterBatch
from stereophd.core.numerics.random_streams import SEQUENTIAL_PARTICLES, TEMPERED_PARTICLES
from stereophd.core.numerics.weights import effective_sample_size, weighted_mean_covariance
from stereophd.pipeline.calibration.problem import CalibrationRun, Outcome, annealed_task, phd_filter, pmb_filter

# What an unfinished run keeps of a sampler: its state, and its steps so far.
BRIDGE = tuple[BridgeState, list[BridgeInfo]]


def sequential_outcome(run: CalibrationRun) -> Outcome:
    """Method sequential: the paper's particle filter over cameras, with moves or without."""
    settings, problem = run.section.sequential, run.problem
    if settings.moves == "none":
        return _plain_outcome(run)
    path = BlockPath(_evidence(run, settings.likelihood, problem.scale, samples=settings.samples), settings)
    seed = SEQUENTIAL_PARTICLES.seed(run.loaded.config.seed)
    sampler = BridgeSampler(path, settings.resample_below, settings.moves_per_step, seed)

    def after(state: BridgeState, steps: Any) -> None:
        run.unfinished.keep("sequential", (state, list(steps)))
        run.progress(int(1000 * (state.stage + state.temperature)), 1000 * len(path.stages))

    result = bridging.run(sampler, run.unfinished.read("sequential", BRIDGE), after)
    mean, covariance = weighted_mean_covariance(result.values, result.log_weights)
    details = {"log_evidence": result.log_evidence, "sampler": _sampler_figures(result, settings.likelihood)}
    last, times = {info.stage: info for info in result.history}, np.sort(problem.recording.times)
    history = tuple(
        HistoryRow(float(times[stage.n_events - 1]), last[number].mean, last[number].covariance)
        for number, stage in enumerate(path.stages)
        if stage.inflation == 1.0
    )
    doubt = _doubt(run, mean, covariance, details)
    return Outcome(
        problem.parameters, mean, covariance, result.values, result.log_weights, history, "", doubt, details=details
    )


def _template(run: CalibrationRun, likelihood: str, samples: int | None = None) -> DisparityFilter:
    """Return the filter that weighs hypotheses of the cameras."""
    cameras = run.problem.parameters.cameras
    return pmb_filter(run.loaded, cameras) if likelihood == "pmb" else phd_filter(run.loaded, cameras, samples)


def _plain_outcome(run: CalibrationRun) -> Outcome:
    """The paper's filter without changes: particles are weighted, resampled and jittered."""
    settings, problem, parameters = run.section.sequential, run.problem, run.problem.parameters
    noises = {"center": settings.center_noise, "rotation": float(np.deg2rad(settings.rotation_noise_deg))}
    walk = np.array([noises.get(p.quantity.name, 0.0) for p in parameters.parameters])
    events = problem.scans().events

    def after(number: int, state: Any, history: Any) -> None:
        run.unfinished.keep("sequential", (state, list(history)))
        run.progress(number, len(events))

    state, infos = sequential.run(
        parameters,
        events,
        FilterBatch(_template(run, settings.likelihood, settings.samples), run.jobs),
        settings,
        SEQUENTIAL_PARTICLES.seed(run.loaded.config.seed),
        run.unfinished.read("sequential", tuple[SequentialState, list[SequentialInfo]]),
        after,
        walk if walk.any() else None,
    )
    mean, covariance = weighted_mean_covariance(state.values, state.log_weights)
    details = {
        "log_evidence": state.log_evidence,
        "effective_sample_size": effective_sample_size(state.log_weights),
        "least_effective_sample_size": min(info.effective_sample_size for info in infos),
        "resampled": sum(info.resampled for info in infos),
    }
    history = tuple(HistoryRow(info.time_s, info.mean, info.covariance) for info in infos)
    doubt = _doubt(run, mean, covariance, details)
    return Outcome(parameters, mean, covariance, state.values, state.log_weights, history, "", doubt, details=details)


def _doubt(run: CalibrationRun, values: Array, covariance: Array, details: dict[str, Any]) -> str:
    """Why particles are not to be trusted: tracks that two cameras share move the cameras far away, or are missing.

    Particles that settled on wrong cameras are narrow, and still far from the nearest optimum.
    """
    task = annealed_task(run.loaded, run.section, run.problem)
    fit = fit_from(task, values)
    details["explained"] = 0.0 if fit is None else explained(task, fit)
    if fit is None:
        return "no tracks are shared by two cameras"
    if (why := disagreement(task, fit, NOISE_AS_STATED)) is not None:
        return why
    difference = fit.adjustment.values - values
    joint = np.linalg.inv(covariance + fit.adjustment.covariance)
    moved = float(np.sqrt(difference @ joint @ difference / len(difference)))
    details["standard_deviations_to_optimum"] = moved
    if moved <= RIVAL_DISTANCE:
        return ""
    return f"the optimum next to the particles lies {moved:.0f} standard deviations away: they settled on wrong cameras"


def smc_outcome(
    run: CalibrationRun, scale: ScaleMeasurement | None, modes: Modes, annealed: Calibrated, details: dict[str, Any]
) -> Outcome:
    """Full posterior by tempered particles about the modes found."""
    settings, parameters = run.section.smc, run.problem.parameters
    path = TemperedPath(parameters, _evidence(run, settings.evidence, scale, settings.max_events), modes, settings)
    seed = TEMPERED_PARTICLES.seed(run.loaded.config.seed)
    sampler = BridgeSampler(path, settings.resample_below, settings.moves, seed)

    def after(state: BridgeState, steps: Any) -> None:
        run.unfinished.keep("smc", (state, list(steps)))
        run.progress(int(1000 * state.temperature), 1000)

    result = bridging.run(sampler, run.unfinished.read("smc", BRIDGE), after)
    mean, covariance = weighted_mean_covariance(result.values, result.log_weights)
    details["smc"] = {**_sampler_figures(result, settings.evidence), "modes": len(modes.weights)}
    return Outcome(
        parameters, mean, covariance, result.values, result.log_weights, annealed.history, "", annealed.doubt,
        annealed.fit, annealed.remarks, annealed.moves, None, details,
    )  # fmt: skip


def _evidence(
    run: CalibrationRun,
    likelihood: str,
    scale: ScaleMeasurement | None,
    most: int | None = None,
    samples: int | None = None,
) -> LogEvidence:
    """Return the evidence of at most about `most` events; where the scale is free, no prior of objects decides on it.

    Hypotheses of the poses of cameras that stand still share the events, and are filtered side by side.
    """
    problem, template = run.problem, _template(run, likelihood, samples)
    parameters = problem.parameters
    reference = problem.reference if scale_is_free(parameters) else None
    if parameters.only_poses and not template.rig.moving:
        return Evidence(parameters, problem.scans(most).events, FilterBatch(template, run.jobs), reference, scale)
    if not can_be_enlarged(parameters.cameras, problem.reference):
        reference = None
    frames = problem.frames(most)
    frames = frames[np.lexsort((problem.recording.cameras[frames], problem.recording.times[frames]))]
    return RecordingEvidence(parameters, problem.recording, frames, template, run.jobs, reference, scale)


def _sampler_figures(result: BridgeResult, evidence: str) -> dict[str, Any]:
    """Return what the report holds of a sampler."""
    return {
        "evidence": evidence,
        "log_evidence": result.log_evidence,
        "acceptance": result.acceptance,
        "effective_sample_size": result.effective_sample_size * len(result.values),
        "ancestors": result.ancestors,
    }
