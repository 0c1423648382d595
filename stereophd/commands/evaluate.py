"""Score the tracks of a run against the truth: OSPA, OSPA(2), GOSPA, RMSE, cardinality, identities, NEES."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from stereophd.commands.options import EvaluateOptions
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.truth.interpolation import DEFAULT_GAP_STEPS
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.json_text import write_json
from stereophd.io.outputs.provenance import provenance, to_metadata
from stereophd.options import declarations, takes
from stereophd.pipeline.evaluation.gates import gates, raise_if_failed
from stereophd.pipeline.evaluation.inputs import (
    SCANS_NAME,
    Tracks,
    cameras_of_record,
    read_sightings,
    read_tracks,
    read_truth,
)
from stereophd.pipeline.evaluation.options import ScoreOptions, check_options
from stereophd.pipeline.evaluation.report import build_report, write_per_scan
from stereophd.pipeline.evaluation.scale import default_cutoff, warn_of_another_scene
from stereophd.pipeline.evaluation.scoring import score_tracks
from stereophd.report.installed import whether_to_draw
from stereophd.validated import NO_LENGTH

REPORT_NAME, PER_SCAN_NAME = "report.json", "per_scan.parquet"
PLOT_NAMES = tuple(f"{plot}.{kind}" for plot in ("ospa", "cardinality", "top", "side") for kind in ("png", "svg"))


@takes(EvaluateOptions)
def evaluate(
    tracks_path: Path | str, truth_path: Path | str, out_dir: Path | str | None = None, *, options: EvaluateOptions
) -> dict[str, Any]:
    """Score tracks against the truth, as `stereophd.api.evaluate`; ``report.json``, ``per_scan.parquet`` and plots.

    With ``scans.parquet`` in the folder of the tracks every event is known, also those that reported nothing; without
    it, the times of the truth stand in for them. Nothing is written without `out_dir`. Returns the report. Raises
    InputError if an option or file is not usable, units differ, no cutoff is known, nothing can be scored, or a limit
    names no figure; GateError, which carries the report, if a figure is beyond its limit or is not a number:
    everything has been written then.
    """
    check_options(options, options.log_path)
    inputs = _input_paths(tracks_path, truth_path, options.log_path, options.cameras_path)
    if out_dir is None:
        report = _run(inputs, options, None, False)
    else:
        draw = whether_to_draw(options.plots)
        with OutputFolder(out_dir, [REPORT_NAME, PER_SCAN_NAME, *PLOT_NAMES], options.force) as out:
            report = _run(inputs, options, out, draw)
    raise_if_failed(report, tracks_path)
    return report


def _run(inputs: dict[str, Path], options: EvaluateOptions, out: OutputFolder | None, draw: bool) -> dict[str, Any]:
    tracks = read_tracks(inputs["tracks"])
    truth, truth_unit = read_truth(inputs["truth"])
    cameras, cameras_unit = _cameras(inputs.get("cameras"), tracks)
    units = {"tracks": tracks.length_unit, "truth": truth_unit, "cameras": cameras_unit}
    if options.align == "similarity" and (truth_unit is not None or tracks.length_unit == NO_LENGTH):
        del units["tracks"]  # the scale is found, and figures are in the unit of the truth, which it may not name
    unit = _common_unit(units, inputs)
    if options.cutoff is None:
        record = tracks.metadata if unit == tracks.length_unit else None
        options = replace(options, cutoff=default_cutoff(options.base, unit, record, inputs["tracks"]))
    sightings = None if options.seen_by is None else read_sightings(inputs["log"], cameras)
    max_gap_s = DEFAULT_GAP_STEPS * truth.step_s if options.max_gap_s is None else options.max_gap_s
    scored = score_tracks(tracks, truth, sightings, options, max_gap_s, inputs["tracks"])
    warn_of_another_scene(inputs, tracks, truth, scored.scans)
    judged = gates(options.fail_above, options.fail_below, {**scored.figures, "scans": scored.scans})
    values = {name: getattr(options, name) for name in declarations(ScoreOptions)}
    record = provenance("evaluate", values, inputs=inputs, length_unit=unit)
    report = build_report(scored, options, max_gap_s, unit, record, judged)
    if out is not None:
        write_json(out.path(REPORT_NAME), report)
        write_per_scan(out.path(PER_SCAN_NAME), scored.columns, to_metadata(record))
        if draw:
            from stereophd.report.plots.scene_plots import Pictures, write_plots  # costly to import, and an extra

            if options.align != "none" and "cameras" not in inputs:
                cameras = None  # those of the tracks stand in the frame of these
            paths = {name: out.path(name) for name in PLOT_NAMES}
            write_plots(Pictures(report, scored, truth, cameras or ()), paths)
    return report


def _input_paths(
    tracks: Path | str, truth: Path | str, log: Path | str | None, cameras: Path | str | None
) -> dict[str, Path]:
    """Return role -> path of the files that are read."""
    given = {"tracks": tracks, "truth": truth, "log": log, "cameras": cameras}
    paths = {role: Path(path) for role, path in given.items() if path is not None}
    scans = paths["tracks"].with_name(SCANS_NAME)
    if scans.exists():
        paths["scans"] = scans
    return paths


def _cameras(path: Path | None, tracks: Tracks) -> tuple[list[Camera] | None, str | None]:
    """Return the cameras of a file, else of the provenance of the tracks, and their unit."""
    if path is None:
        return cameras_of_record(tracks.metadata), None
    from stereophd.config.loading import load_cameras

    described = load_cameras(path)
    built = [camera.build(name) for name, camera in described.cameras.items()]
    return built, described.units.length


def _common_unit(units: dict[str, str | None], inputs: dict[str, Path]) -> str | None:
    """Return the unit of length that all files name (or are silent about)."""
    named = {role: unit for role, unit in units.items() if unit is not None}
    if len(set(named.values())) > 1:
        (first, unit), *others = named.items()
        role, other = next((role, value) for role, value in others if value != unit)
        raise InputError(f"{inputs[role]}: expected lengths in {unit} as in {inputs[first]}, found {other}")
    return next(iter(named.values()), None)
