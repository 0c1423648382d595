"""The methods of `calibrate`, each from a problem to an `Outcome`, with checkpoints."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereophd.calibrate_inputs import CalibrationProblem, phd_filter, pmb_filter, thinned
from stereophd.calibration import sequential, tempered
from stereophd.calibration.annealed import (
    AnnealedSettings,
    Fit,
    Start,
    Task,
    best_of,
    distinct_modes,
    enough,
    fit_until,
    real_detections,
    rescaled,
    run_start,
    start_values,
)
from stereophd.calibration.association import shared, track_detections
from stereophd.calibration.batch import FilterBatch
from stereophd.calibration.likelihood import Evidence
from stereophd.calibration.resampling import effective_sample_size, weighted_mean_covariance
from stereophd.config_calibration import CalibrationConfig, LengthScale, SpeedScale
from stereophd.errors import InputError
from stereophd.io.atomic import atomic_write

if TYPE_CHECKING:
    from stereophd.config_loading import LoadedConfig

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

# Keys of random numbers among the purposes of a seed (simulated runs count from 0).
STARTS_KEY, SEQUENTIAL_KEY, SMC_KEY, DRAWS_KEY, PAIRING_KEY = (2**31 + k for k in range(1, 6))
# Seconds between two checkpoints.
CHECKPOINT_EVERY_S = 60.0
# Draws that stand for a Gaussian posterior, and times at which it is given in the history.
GAUSSIAN_DRAWS = 1000
HISTORY_TIMES = 25


@dataclass(frozen=True)
class HistoryRow:
    """Posterior of the parameters given the log up to a time."""

    time_s: float
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class Outcome:
    """What a method found.

    Attributes
    ----------
    values, covariance : arrays (m,), (m, m)
        Mean (or optimum) and covariance; NaN where nothing agrees with the data.
    particles, log_weights : arrays (k, m), (k,)
        Posterior as particles.
    history : tuple of HistoryRow
    reason : str
        Why nothing was found; empty if something was.
    doubt : str
        Why the posterior is not to be trusted; empty if it may be.
    fit : Fit or None
        Trajectories and residuals, of method annealed.
    details : dict
        For the report.
    """

    values: Array
    covariance: Array
    particles: Array
    log_weights: Array
    history: tuple[HistoryRow, ...]
    reason: str = ""
    doubt: str = ""
    fit: Fit | None = None
    details: dict[str, Any] = field(default_factory=dict)


class Checkpoint:
    """State of an unfinished run, in a file beside its output folder.

    Parameters
    ----------
    path : Path
    identity : str
        Of configuration and log: a checkpoint of another run is refused.
    resume : bool
        Whether to begin with what the file holds.
    """

    def __init__(self, path: Path, identity: str, resume: bool) -> None:
        self.path = path
        self._identity = identity
        self._parts: dict[str, Any] = {}
        self._saved = time.monotonic()
        if resume:
            self._parts = self._load()

    def _load(self) -> dict[str, Any]:
        try:
            with open(self.path, "rb") as stream:
                identity, parts = pickle.load(stream)
        except FileNotFoundError:
            raise InputError(f"--resume: expected a checkpoint {self.path}, found none") from None
        except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: expected a checkpoint of this version, found {error}") from None
        if identity != self._identity:
            raise InputError(f"{self.path}: expected a checkpoint of this configuration and log, found another's")
        return dict(parts)

    def get(self, name: str) -> Any:
        """What was kept under a name, or None."""
        return self._parts.get(name)

    def keep(self, name: str, value: Any) -> None:
        """Keep a value; it is written now if the last time was a while ago."""
        self._parts[name] = value
        if time.monotonic() - self._saved >= CHECKPOINT_EVERY_S:
            self.save()

    def save(self) -> None:
        """Write the file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.path) as temporary, open(temporary, "wb") as stream:
            pickle.dump((self._identity, self._parts), stream)
        self._saved = time.monotonic()

    def remove(self) -> None:
        """Remove the file: the run is done."""
        self.path.unlink(missing_ok=True)


def seed_for(loaded: LoadedConfig, key: int) -> np.random.SeedSequence:
    """Random numbers of a purpose."""
    return np.random.SeedSequence(loaded.config.seed, spawn_key=(key,))


def annealed_outcome(
    loaded: LoadedConfig,
    section: CalibrationConfig,
    problem: CalibrationProblem,
    checkpoint: Checkpoint,
    jobs: int,
    progress: Progress | None,
) -> Outcome:
    """Method annealed, with the posterior that the section names."""
    settings = section.annealed
    task = Task.of(
        problem.parameters,
        problem.reference,
        pmb_filter(loaded, problem.parameters.cameras),
        problem.scans,
        thinned(problem.scans, settings.max_events),
        problem.scale,
        AnnealedSettings(
            settings.starts,
            settings.agreeing_starts,
            settings.inflation,
            settings.min_detections,
            settings.min_tracked,
        ),
    )
    values = start_values(problem.parameters, seed_for(loaded, STARTS_KEY), settings.starts)
    seeds = seed_for(loaded, PAIRING_KEY).spawn(settings.starts)
    starts: list[Start] = list(checkpoint.get("starts") or [])
    if not enough(starts, settings.agreeing_starts):
        for start in _run_starts(task, values, seeds, len(starts), jobs):
            starts.append(start)
            checkpoint.keep("starts", starts)
            if progress is not None:
                progress(len(starts), len(values))
            if enough(starts, settings.agreeing_starts):
                break
    best = best_of(starts)
    details: dict[str, Any] = {"starts": [_start_report(problem, start, best) for start in starts]}
    size = problem.parameters.size
    if best is None or best.fit is None:
        why = f"none of {len(starts)} starts agrees with the data"
        nothing = np.full((size, size), np.nan)
        return Outcome(nothing[0], nothing, np.empty((0, size)), np.empty(0), (), why, "", None, details)
    fit = _scaled_fit(section, task, best.fit, details)
    mean, covariance = fit.adjustment.values, fit.adjustment.covariance
    details["fit"] = _fit_report(problem, best, fit)
    history = tuple(
        HistoryRow(time_s, until.adjustment.values, until.adjustment.covariance)
        for time_s in np.linspace(problem.scans.times[0], problem.scans.times[-1], HISTORY_TIMES + 1)[1:]
        if (until := fit_until(task, fit, float(time_s))) is not None
    )
    if section.posterior == "smc":
        modes = distinct_modes(starts)
        return smc_outcome(loaded, section, problem, modes, fit, history, details, checkpoint, jobs, progress)
    rng = np.random.default_rng(seed_for(loaded, DRAWS_KEY))
    draws = mean + rng.standard_normal((GAUSSIAN_DRAWS, size)) @ np.linalg.cholesky(covariance).T
    weights = np.full(GAUSSIAN_DRAWS, -np.log(GAUSSIAN_DRAWS))
    return Outcome(mean, covariance, draws, weights, history, "", "", fit, details)


def _run_starts(
    task: Task, values: Array, seeds: list[np.random.SeedSequence], done: int, jobs: int
) -> Iterator[Start]:
    """Outcomes of the starts that are not done yet, in order."""
    numbers = range(done, len(values))
    if jobs == 1 or len(numbers) < 2:
        for number in numbers:
            yield run_start(task, number, values[number], seeds[number])
        return
    import warnings

    from joblib import Parallel, delayed

    # that starts are given up once enough agree is meant
    warnings.filterwarnings("ignore", message=".*tasks which were still being processed", category=UserWarning)
    # no more ahead than there are workers: starts that are not needed are not begun
    pool = Parallel(n_jobs=jobs, return_as="generator", pre_dispatch="n_jobs")
    outcomes = pool(delayed(run_start)(task, number, values[number], seeds[number]) for number in numbers)
    try:
        yield from outcomes
    finally:
        outcomes.close()


def _scaled_fit(section: CalibrationConfig, task: Task, fit: Fit, details: dict[str, Any]) -> Fit:
    """Adjust again where speeds or a length of the scene are known."""
    scale = section.scale
    if isinstance(scale, SpeedScale):
        scaled = rescaled(task, fit, "speed", scale.speed, scale.std)
    elif isinstance(scale, LengthScale):
        scaled = rescaled(task, fit, "length", scale.length, scale.std)
    else:
        return fit
    if scaled is None:
        details["scale_warning"] = "no two objects keep their distance: the known length was not used"
        return fit
    return scaled


def _start_report(problem: CalibrationProblem, start: Start, best: Start | None) -> dict[str, Any]:
    nothing: list[float] = []
    values = nothing if start.fit is None else start.fit.adjustment.values.tolist()
    return {
        "start": start.number,
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
        "rms_residual_sigmas": float(np.sqrt(np.minimum(inliers, 1e4).mean() / 2.0)),
        "log_evidence": best.log_evidence,
        "log_prior": best.log_prior,
        "converged": fit.adjustment.converged,
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def sequential_outcome(
    loaded: LoadedConfig,
    section: CalibrationConfig,
    problem: CalibrationProblem,
    checkpoint: Checkpoint,
    jobs: int,
    progress: Progress | None,
) -> Outcome:
    """Method sequential: the paper's particle filter over cameras."""
    settings = section.sequential
    cameras, parameters = problem.parameters.cameras, problem.parameters
    template = (
        phd_filter(loaded, cameras, settings.samples) if settings.likelihood == "phd" else pmb_filter(loaded, cameras)
    )
    per_unit = {"length": settings.center_noise, "rad": float(np.deg2rad(settings.rotation_noise_deg))}
    walk = np.array([per_unit[p.unit] for p in parameters.parameters])
    events = problem.scans.events

    def after(number: int, state: Any, history: Any) -> None:
        checkpoint.keep("sequential", (state, list(history)))
        if progress is not None:
            progress(number, len(events))

    result = sequential.run(
        parameters,
        events,
        FilterBatch(template, jobs),
        sequential.SequentialSettings(
            settings.particles, settings.resample_below, settings.roughening, walk if walk.any() else None
        ),
        seed_for(loaded, SEQUENTIAL_KEY),
        checkpoint.get("sequential"),
        after,
    )
    mean, covariance = weighted_mean_covariance(result.state.values, result.state.log_weights)
    sizes = [info.effective_sample_size for info in result.history]
    details = {
        "log_evidence": result.state.log_evidence,
        "effective_sample_size": effective_sample_size(result.state.log_weights),
        "least_effective_sample_size": min(sizes),
        "resampled": sum(info.resampled for info in result.history),
    }
    history = tuple(HistoryRow(info.time_s, info.mean, info.covariance) for info in result.history)
    doubt = _doubt(loaded, section, problem, mean, details)
    return Outcome(mean, covariance, result.state.values, result.state.log_weights, history, "", doubt, None, details)


def _doubt(
    loaded: LoadedConfig,
    section: CalibrationConfig,
    problem: CalibrationProblem,
    values: Array,
    details: dict[str, Any],
) -> str:
    """Track with the cameras found: a filter that settled on wrong ones has no tracks that two cameras share."""
    settings = section.annealed
    scans = thinned(problem.scans, settings.max_events)
    found = track_detections(pmb_filter(loaded, problem.parameters.build(values)), scans, 1.0)
    chosen = shared(found.tracks, scans.cameras[scans.event_of[found.detections]], settings.min_detections)
    part = int(np.isin(found.tracks, chosen).sum()) / real_detections(problem.parameters, scans)
    details["explained"] = part
    if part >= settings.min_tracked:
        return ""
    return f"shared tracks explain only {100 * part:.0f} % of the detections that are not expected to be false"


def smc_outcome(
    loaded: LoadedConfig,
    section: CalibrationConfig,
    problem: CalibrationProblem,
    modes: tempered.Modes,
    fit: Fit,
    history: tuple[HistoryRow, ...],
    details: dict[str, Any],
    checkpoint: Checkpoint,
    jobs: int,
    progress: Progress | None,
) -> Outcome:
    """Full posterior by tempered particles about the modes found."""
    settings = section.smc
    cameras = problem.parameters.cameras
    template = pmb_filter(loaded, cameras) if settings.evidence == "pmb" else phd_filter(loaded, cameras)
    evidence = Evidence(
        problem.parameters, thinned(problem.scans, settings.max_events).events, FilterBatch(template, jobs)
    )
    sampler = tempered.TemperedSampler(
        problem.parameters,
        evidence,
        modes,
        tempered.TemperedSettings(settings.particles, settings.resample_below, settings.moves, settings.spread),
        seed_for(loaded, SMC_KEY),
    )

    def after(state: Any, steps: Any) -> None:
        checkpoint.keep("smc", (state, list(steps)))
        if progress is not None:
            progress(int(1000 * state.temperature), 1000)

    result = tempered.run(sampler, checkpoint.get("smc"), after)
    mean, covariance = weighted_mean_covariance(result.values, result.log_weights)
    details["smc"] = {
        "evidence": settings.evidence,
        "log_evidence": result.log_evidence,
        "acceptance": result.acceptance,
        "effective_sample_size": result.effective_sample_size,
        "ancestors": result.ancestors,
        "modes": len(modes.weights),
    }
    return Outcome(mean, covariance, result.values, result.log_weights, history, "", "", fit, details)
