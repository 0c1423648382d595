"""What `calibrate` samples: method sequential, and posterior smc."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.annealing.fits import HistoryRow, fit_from
from stereophd.core.calibration.annealing.starts import NOISE_AS_STATED, RIVAL_DISTANCE, disagreement, explained
from stereophd.core.calibration.annealing.task import Task
from stereophd.core.calibration.sampling import runs
from stereophd.core.calibration.sampling.bridging import (
    BridgeInfo,
    BridgeSampler,
    BridgeState,
    acceptance_of,
    least_effective,
)
from stereophd.core.calibration.sampling.likelihood import Evidence
from stereophd.core.calibration.sampling.paths import LogEvidence, growing_path, tempered_path
from stereophd.core.calibration.sampling.recording_evidence import RecordingEvidence
from stereophd.core.calibration.sampling.runs import Info, Sampler, State
from stereophd.core.calibration.sampling.sequential import SequentialInfo, SequentialSampler, SequentialState
from stereophd.core.calibration.unknowns.modes import Modes
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, can_be_enlarged, scale_is_free
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.camera_hypotheses.batch import FilterBatch
from stereophd.core.numerics.random_streams import SEQUENTIAL_PARTICLES, TEMPERED_PARTICLES
from stereophd.core.numerics.weights import effective_sample_size, weighted_mean_covariance
from stereophd.pipeline.calibration.problem import CalibrationRun, Outcome, annealed_task, phd_filter, pmb_filter

# What is known of the cameras after steps of a sampler: its last state, rows of the history, entries of the report.
Sampled = tuple[BridgeState | SequentialState, tuple[HistoryRow, ...], dict[str, Any]]


def sequential_outcome(run: CalibrationRun) -> Outcome:
    """Method sequential: the paper's particle filter over cameras, with moves or without."""
    state, history, details = _plain(run) if run.section.sequential.moves == "none" else _with_moves(run)
    mean, covariance = weighted_mean_covariance(state.values, state.log_weights)
    doubt = _doubt(run, mean, covariance, details)
    return Outcome(
        run.problem.parameters, mean, covariance, state.values, state.log_weights, history, "", doubt, details=details
    )


def _run(run: CalibrationRun, name: str, sampler: Sampler[State, Info], kind: Any) -> tuple[State, list[Info]]:
    """Run a sampler, of which an unfinished run keeps state and infos, of the type `kind`, under a name."""

    def after(state: State, infos: Sequence[Info]) -> None:
        run.unfinished.keep(name, (state, list(infos)))
        run.progress(*sampler.progress(state))

    return runs.run(sampler, run.unfinished.read(name, kind), after)


def _bridged(
    run: CalibrationRun, name: str, sampler: BridgeSampler, evidence: str
) -> tuple[BridgeState, list[BridgeInfo], dict[str, Any]]:
    """Run a sampler along a path of densities; also what the report holds of it."""
    state, history = _run(run, name, sampler, tuple[BridgeState, list[BridgeInfo]])
    figures = {
        "evidence": evidence,
        "log_evidence": state.log_evidence,
        "acceptance": acceptance_of(history),
        "effective_sample_size": least_effective(history) * len(state.values),
        "ancestors": len(np.unique(state.ancestors)),
    }
    return state, history, figures


def _with_moves(run: CalibrationRun) -> Sampled:
    """Particles that moves filter anew: the posterior of more and more of the log."""
    settings, problem = run.section.sequential, run.problem
    evidence = _evidence(run, settings.likelihood, problem.scale, problem.recording, settings.samples)
    path, seed = growing_path(evidence, settings), SEQUENTIAL_PARTICLES.seed(run.loaded.config.seed)
    sampler = BridgeSampler(path, settings.resample_below, settings.moves_per_step, seed)
    state, infos, figures = _bridged(run, "sequential", sampler, settings.likelihood)
    last, times = {info.stage: info for info in infos}, np.sort(problem.recording.times)
    history = tuple(
        HistoryRow(float(times[stage.n_events - 1]), last[number].mean, last[number].covariance)
        for number, stage in enumerate(path.stages)
        if stage.inflation == 1.0
    )
    return state, history, {"log_evidence": state.log_evidence, "sampler": figures}


def _plain(run: CalibrationRun) -> Sampled:
    """The paper's filter without changes: particles are weighted, resampled and jittered."""
    settings, parameters = run.section.sequential, run.problem.parameters
    batch = FilterBatch(_template(run, settings.likelihood, settings.samples), run.jobs)
    seed = SEQUENTIAL_PARTICLES.seed(run.loaded.config.seed)
    sampler = SequentialSampler(parameters, run.problem.scans().events, batch, settings, seed)
    state, infos = _run(run, "sequential", sampler, tuple[SequentialState, list[SequentialInfo]])
    details = {
        "log_evidence": state.log_evidence,
        "effective_sample_size": effective_sample_size(state.log_weights),
        "least_effective_sample_size": min(info.effective_sample_size for info in infos),
        "resampled": sum(info.resampled for info in infos),
    }
    return state, tuple(HistoryRow(info.time_s, info.mean, info.covariance) for info in infos), details


def _template(run: CalibrationRun, likelihood: str, samples: int | None = None) -> DisparityFilter:
    """Return the filter that weighs hypotheses of the cameras."""
    cameras = run.problem.parameters.cameras
    return pmb_filter(run.loaded, cameras) if likelihood == "pmb" else phd_filter(run.loaded, cameras, samples)


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


def smc_outcome(run: CalibrationRun, task: Task, modes: Modes, annealed: Outcome) -> Outcome:
    """Full posterior by tempered particles about the modes found, of the frames that a task tracks."""
    settings = run.section.smc
    evidence = _evidence(run, settings.evidence, task.scale, task.recording.part(task.frames))
    path, seed = tempered_path(evidence, modes, settings), TEMPERED_PARTICLES.seed(run.loaded.config.seed)
    sampler = BridgeSampler(path, settings.resample_below, settings.moves, seed)
    state, _, figures = _bridged(run, "smc", sampler, settings.evidence)
    mean, covariance = weighted_mean_covariance(state.values, state.log_weights)
    details = {**annealed.details, "smc": {**figures, "modes": len(modes.weights)}}
    return replace(
        annealed, values=mean, covariance=covariance, particles=state.values, log_weights=state.log_weights,
        details=details,
    )  # fmt: skip


def _evidence(
    run: CalibrationRun,
    likelihood: str,
    scale: ScaleMeasurement | None,
    recording: Recording,
    samples: int | None = None,
) -> LogEvidence:
    """Return the evidence of a recording; where the scale is free, no prior of objects decides on it.

    Hypotheses of the poses of cameras that stand still share the events, and are filtered side by side.
    """
    problem, template = run.problem, _template(run, likelihood, samples)
    parameters = problem.parameters
    reference = problem.reference if scale_is_free(parameters) else None
    if parameters.only_poses and not template.rig.moving:
        events = Scans.of(recording, parameters.cameras).events
        return Evidence(parameters, events, FilterBatch(template, run.jobs), reference, scale)
    if not can_be_enlarged(parameters.cameras, problem.reference):
        reference = None
    frames = np.lexsort((recording.cameras, recording.times))
    return RecordingEvidence(parameters, recording, frames, template, run.jobs, reference, scale)
