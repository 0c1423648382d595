"""Calibrate cameras from a detection log: poses with their posterior, history, tracks and a report."""

import contextlib
import functools
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.commands.options import CalibrateOptions
from stereophd.config.loading import LoadedConfig
from stereophd.core.alignment.to_points import ControlPoints
from stereophd.core.calibration.annealing.method import SAID_FACTOR, Remark
from stereophd.core.calibration.time_limit import TimeLimit
from stereophd.core.calibration.unknowns.considered import CameraUncertainty
from stereophd.core.calibration.unknowns.observability import DETERMINED, PARTLY, UNDETERMINED
from stereophd.errors import GateError, InputError
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.json_text import write_json
from stereophd.io.outputs.locks import output_lock
from stereophd.io.outputs.provenance import provenance, sha256_of, to_metadata
from stereophd.io.tables.schemas import history_schema, posterior_schema
from stereophd.io.tables.writing import TableWriter
from stereophd.options import takes
from stereophd.pipeline.arithmetic import within_arithmetic
from stereophd.pipeline.calibration.annealed import annealed_outcome
from stereophd.pipeline.calibration.configured_unknowns import calibration_section, with_quantities
from stereophd.pipeline.calibration.found_cameras import in_world, with_found_cameras
from stereophd.pipeline.calibration.problem import (
    CalibrationRun,
    Outcome,
    control_path,
    pmb_filter,
    read_problem,
    size_of_calibration,
)
from stereophd.pipeline.calibration.report import build_report
from stereophd.pipeline.calibration.sampled import sequential_outcome
from stereophd.pipeline.cameras_covariance import in_world as uncertainty_in_world
from stereophd.pipeline.cameras_covariance import rows_of
from stereophd.pipeline.checks.check_log import check_log, report_findings
from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.checks.run_checks import FinishedRun
from stereophd.pipeline.control import points_report
from stereophd.pipeline.initial.acceleration import with_estimated_motion
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.pipeline.runs.sizes import check_size
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES, UnfinishedRun
from stereophd.pipeline.stream import open_stream
from stereophd.pipeline.tracking.tracking_run import ASSOCIATIONS_FILE, SCANS_FILE, TRACKS_FILE, TrackingRun
from stereophd.pipeline.workers.places import processes
from stereophd.report.installed import whether_to_draw
from stereophd.wording import LOGGER

PLOTS = tuple(f"{plot}.{kind}" for plot in ("history", "posterior", "residuals") for kind in ("png", "svg"))
CAMERAS_FILE, POSTERIOR_FILE, HISTORY_FILE = "cameras.yaml", "posterior.parquet", "history.parquet"
FILES = (CAMERAS_FILE, POSTERIOR_FILE, HISTORY_FILE, TRACKS_FILE, SCANS_FILE, ASSOCIATIONS_FILE, "report.json", *PLOTS)
# Requirement -> the statuses of a report that meet it.
ACCEPTED = {None: (DETERMINED, PARTLY, UNDETERMINED), "partly": (DETERMINED, PARTLY), "determined": (DETERMINED,)}

NOISE_NOTE = f"sigma_px is what the data show where what was stated is wrong by more than a factor of {SAID_FACTOR}."
# Checks that need the calibrated cameras; the checks of the log alone come first. Method annealed has found another
# acceleration than is stated by itself (`calibration.motion`), and takes no `estimate`, which is that check's remedy.
WITH_CAMERAS, BY_ITSELF = ("geometry.", "settings."), "settings.acceleration_std"


@takes(CalibrateOptions)
def calibrate(
    loaded: LoadedConfig,
    log_path: Path | str,
    out_dir: Path | str,
    *,
    options: CalibrateOptions,
    progress: Progress = ignore,
) -> dict[str, Any]:
    """Calibrate cameras from a detection log (paper section VII), as `stereophd.api.calibrate`.

    The configuration has the sections ``calibration`` and ``filter``, and cameras at the prior mean. The output folder
    gets ``report.json``, ``posterior.parquet`` and ``history.parquet``, and where the data determine the cameras
    ``cameras.yaml``, and the tables of ``track`` made with them. `progress` is called with (done, total); an exception
    that it raises ends the run, and leaves a checkpoint. Returns the report. Raises InputError if configuration, log,
    checkpoint or folder are not usable, or it needs too much memory; GateError, which carries the report, if the data
    determine less than `require`: everything has been written then.
    """
    jobs = processes(options.jobs)
    limit = TimeLimit(math.inf if options.time_s is None else time.monotonic() + options.time_s)
    stated = loaded
    loaded, unknown = with_found_cameras(stated, log_path, limit)
    section = calibration_section(loaded)
    if options.time_s is not None and (section.method != "annealed" or section.posterior == "smc"):
        raise InputError("`time_s`: expected method annealed with posterior laplace, found particles, which need all")
    problem = read_problem(loaded, log_path, is_placed=unknown is None or not unknown.reason)
    control = control_path(loaded)
    inputs = {"detections": log_path, **({} if control is None else {"control": control})}
    record = provenance("calibrate", loaded.record, inputs=inputs)
    unfinished = UnfinishedRun(Path(out_dir), sha256_of(record))
    if options.resume and (done := unfinished.finished_report(record, options.force)) is not None:
        return _accepted(done, options.require, log_path)
    recording = problem.recording
    size = size_of_calibration(section, len(recording.cameras), len(recording.pixels))
    check_size(size, f"{log_path}: calibration", out_dir)
    limit.begin(
        f"{problem.parameters.size} unknowns of {len(problem.parameters.cameras)} cameras, "
        f"{len(recording.pixels)} detections in {len(recording.cameras)} frames"
    )
    drawn = whether_to_draw(options.plots)
    LOGGER.info("configuration %s, sha256 %s, seed %d", loaded.path, loaded.sha256, loaded.config.seed)
    findings = report_findings(check_log(stated, log_path, of_rows=False, alone=True))
    with contextlib.ExitStack() as held:
        held.enter_context(output_lock(out_dir))
        held.enter_context(unfinished.held(options.resume, options.force))
        out = held.enter_context(OutputFolder(out_dir, (*FILES, *UNFINISHED_FILES), options.force or unfinished.exists))
        run = CalibrationRun(loaded, problem, unfinished, jobs, progress, limit, is_searched=unknown is not None)
        reason = "" if unknown is None else unknown.reason
        outcome = Outcome.of_none(problem.parameters, reason) if reason else _outcome(run)
        outcome = outcome if unknown is None else unknown.judged(problem, outcome)
        report = build_report(section, problem, outcome, loaded.config.units.length)
        _write_posterior(out, outcome, to_metadata(record))
        if report["status"] != UNDETERMINED:
            cameras = outcome.build_cameras()
            uncertainty = CameraUncertainty(outcome.parameters.about(cameras), outcome.covariance)
            if (world := outcome.world) is not None and problem.control is not None:
                unit, found = problem.control.length_unit, world.alignment
                if unit != loaded.config.units.length:
                    _in_unit(report, unit, found.registration.scale)
                loaded, cameras, report["control"] = in_world(loaded, cameras, world, unit)
                if isinstance(problem.control.known, ControlPoints):
                    report["control"] |= points_report(problem.control.known, cameras, str(control))
                uncertainty = uncertainty_in_world(uncertainty, found.registration, found.center, world.covariance)
            is_other_noise = bool(problem.remarks) or not np.all(outcome.noise == 1.0)
            write_cameras(
                out.path(CAMERAS_FILE), with_quantities(loaded.cameras, cameras), loaded.config.units.length, record,
                rows_of(uncertainty), NOISE_NOTE if is_other_noise else "",
            )  # fmt: skip
            limit.begin("tracks are made with the cameras")
            if unknown is not None:
                yielding = unknown.with_motion_to_estimate(loaded)
                loaded, report["motion"] = with_estimated_motion(yielding, log_path, cameras)
            of_tables = to_metadata(provenance("calibrate", loaded.record, inputs=inputs))
            report["tracking"], further = _track(loaded, uncertainty, log_path, out, of_tables, progress)
            findings += report_findings(further)
        report["provenance"] = record
        report["checks"] = findings + _findings_of(report, (*problem.remarks, *outcome.remarks))
        write_json(out.path("report.json"), report)
        if drawn and not outcome.reason:
            limit.begin("pictures are drawn")
            # Costly to import, and matplotlib is an extra.
            from stereophd.report.plots.calibration_plots import write_calibration_plots

            paths = {name: out.path(name) for name in PLOTS if outcome.fit or not name.startswith("residuals")}
            write_calibration_plots(outcome, record["units"]["length"], paths)
    return _accepted(report, options.require, log_path)


def _in_unit(report: dict[str, Any], unit: str, factor: float) -> None:
    """State a report on cameras without a length in the unit of the control, which gives it.

    The parameters in it name their own unit.
    """
    report["length_unit"], report["scale"]["determined_by"] = unit, "control"
    for camera in report["cameras"].values():
        camera["center_std"] = None if camera["center_std"] is None else factor * camera["center_std"]


def _findings_of(report: dict[str, Any], remarks: tuple[Remark, ...]) -> list[dict[str, Any]]:
    """Return the findings about the result: what the data leave open, and what they contradict."""
    found = []
    if report["status"] != DETERMINED:
        text = f"{report['status']}: {report['reason']}"
        # logged at the end, after the outputs
        found.append(Finding("calibration.status", "warning", text, cause=report["status"].replace(" ", "_")).as_dict())
    unit = report["provenance"]["units"]["length"]  # of the calibration, not of a control that gives it another
    said = tuple(
        Finding(f"calibration.{remark.topic}", "warning", remark.text.replace(" length/s^2", f" {unit}/s^2"))
        for remark in remarks
    )
    return found + report_findings(said)


def _outcome(run: CalibrationRun) -> Outcome:
    """Run the method of the configuration; where it is interrupted, keep what it has finished."""
    method = annealed_outcome if run.section.method == "annealed" else sequential_outcome
    try:
        with within_arithmetic(f"{run.loaded.path}: calibration"):
            return method(run)
    except InputError:
        raise
    except BaseException:
        # of any class: compiled code may turn the exception of a signal into one of its own
        if run.unfinished.save() or run.unfinished.exists:
            LOGGER.warning("stopped: continue with `resume=True` from %s", run.unfinished.folder)
        raise


def _accepted(report: dict[str, Any], require: str | None, log_path: Path | str) -> dict[str, Any]:
    """Return a report that satisfies `require`; raise `GateError` otherwise."""
    # the report, which is printed beside this, has the reason
    text = f"{log_path}: the cameras are {report['status']}; report.json says why"
    if report["status"] not in ACCEPTED[require]:
        raise GateError(text, report)
    if report["status"] != DETERMINED:
        LOGGER.warning(text)
    return report


def _write_posterior(out: OutputFolder, outcome: Outcome, metadata: dict[bytes, bytes]) -> None:
    """Write particles and history; nothing where nothing was found."""
    if outcome.reason:
        return
    names = outcome.parameters.names
    with TableWriter(out.path(POSTERIOR_FILE), posterior_schema(names), metadata) as table:
        weights = np.exp(outcome.log_weights - outcome.log_weights.max())
        columns: dict[str, NDArray[np.float64]] = {"weight": weights / weights.sum()}
        table.append({**columns, **{name: outcome.particles[:, i] for i, name in enumerate(names)}})
    with TableWriter(out.path(HISTORY_FILE), history_schema(names), metadata) as table:
        if outcome.history:
            means = np.stack([row.mean for row in outcome.history])
            table.append(
                {
                    "time_s": np.array([row.time_s for row in outcome.history]),
                    **{name: means[:, i] for i, name in enumerate(names)},
                    "covariance": np.stack([row.covariance for row in outcome.history]),
                }
            )


def _track(
    loaded: LoadedConfig, uncertainty: CameraUncertainty, log_path: Path | str, out: OutputFolder,
    metadata: dict[bytes, bytes], progress: Progress,
) -> tuple[dict[str, Any], tuple[Finding, ...]]:  # fmt: skip
    """Track with the calibrated cameras, as `stereophd.commands.track` does; return figures and findings of the run."""
    report = loaded.config.report.model_copy(update={"associations": True})
    cameras = uncertainty.parameters.cameras
    multi_filter = replace(pmb_filter(loaded, cameras), claims=True)
    stream = open_stream(loaded.config, cameras, log_path, progress)
    run = TrackingRun(loaded, 1, multi_filter, multi_filter.motion, cameras, report)
    summary = run.write(run.records(stream), out, metadata, uncertainty=uncertainty)
    checked = check_log(loaded, log_path, of_rows=False, cameras=cameras)
    known = BY_ITSELF if calibration_section(loaded).method == "annealed" else ""
    since = functools.partial(check_log, loaded, log_path, False, cameras)
    findings = FinishedRun(summary, stream.counts, cameras, stream.has_noise).checked(checked, since)
    return summary, (*(f for f in checked if f.name.startswith(WITH_CAMERAS) and f.name != known), *findings)
