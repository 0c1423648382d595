"""Score the tracks of a run against the truth: OSPA, OSPA(2), GOSPA, RMSE, cardinality, identities, NEES."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from stereophd.core.metrics.alignment import (
    DEFAULT_GAP_STEPS,
    Events,
    Truth,
    add_truth_times,
    align_truth,
    in_window,
    last_event_of_each_time,
)
from stereophd.core.metrics.assignment import is_positive_definite
from stereophd.core.metrics.scans import PointSets, score_scans
from stereophd.core.metrics.summary import figures, pair_errors, per_scan_columns, track_ospa
from stereophd.core.metrics.visibility import Sightings, cameras_that_saw, leave_out_unseen
from stereophd.errors import InputError
from stereophd.io.atomic import OutputFolder
from stereophd.io.json_text import write_json
from stereophd.io.provenance import provenance, to_metadata
from stereophd.pipeline.evaluation.inputs import (
    SCANS_NAME,
    Tracks,
    cameras_of_record,
    read_sightings,
    read_tracks,
    read_truth,
)
from stereophd.pipeline.evaluation.options import Options, check_options
from stereophd.pipeline.evaluation.report import (
    Scored,
    build_report,
    check_limits,
    raise_if_above,
    write_per_scan,
)
from stereophd.report.installed import whether_to_draw

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stereophd.core.geometry.camera import Camera

REPORT_NAME, PER_SCAN_NAME = "report.json", "per_scan.parquet"
PLOT_NAMES = tuple(f"{plot}.{kind}" for plot in ("ospa", "cardinality", "top", "side") for kind in ("png", "svg"))

# The paper's scale: centimetres. Files in another unit deserve a word about it.
DEFAULT_CUTOFF = 20.0

LOGGER = logging.getLogger("stereophd")


def evaluate(
    tracks_path: Path | str,
    truth_path: Path | str,
    out_dir: Path | str | None = None,
    *,
    order: float = 2.0,
    cutoff: float | None = None,
    base: Literal["euclidean", "mahalanobis"] = "euclidean",
    from_s: float | None = None,
    to_s: float | None = None,
    max_gap_s: float | None = None,
    at: Literal["times", "events"] = "times",
    log_path: Path | str | None = None,
    seen_by: int | None = None,
    within_s: float | None = None,
    ospa2_window: int = 10,
    fail_above: Mapping[str, float] | None = None,
    cameras_path: Path | str | None = None,
    force: bool = False,
    plots: bool | None = None,
) -> dict[str, Any]:
    """Score tracks against the truth, and write ``report.json``, ``per_scan.parquet`` and plots.

    Parameters
    ----------
    tracks_path, truth_path : path
        Tables as in ``docs/formats.md``. With ``scans.parquet`` beside the tracks every event is known, also
        those that reported nothing; without it, the times of the truth stand in for them.
    out_dir : path, optional
        Where to write; nothing is written without it.
    order, cutoff : float
        Order p and cutoff c of OSPA and GOSPA; c in the length unit of the files, or a number of standard
        deviations for the base ``mahalanobis``. Pairs nearer than c count as matched for RMSE, NEES, position
        errors and identity switches.
    base : str
        Base distance: ``euclidean``, or ``mahalanobis`` with the covariance of the estimate (paper VIII-C).
    from_s, to_s : float, optional
        Closed interval of times that are scored.
    max_gap_s : float, optional
        Longest interval of the truth that is interpolated over; default 1.5 times its median step. Times in a
        longer one, or outside the truth, are counted but not scored.
    at : str
        ``times``: each distinct time once, after its last event; ``events``: after every event.
    log_path, seen_by, within_s : path, int, float, optional
        Score only objects that at least `seen_by` cameras detected in the last `within_s` seconds, as the log
        says (by its ``object_id``, else any detection counts). Other objects and the estimates assigned to
        them are left out.
    ospa2_window : int
        Number of scored scans in a window of OSPA(2).
    fail_above : mapping, optional
        Limits of figures, such as ``{"ospa.mean": 0.8}``.
    cameras_path : path, optional
        ``cameras.yaml`` with the clocks of the log and the cameras to draw; default the cameras in the
        provenance of the tracks.
    force : bool
        Replace an earlier evaluation in `out_dir`.
    plots : bool, optional
        Whether to draw plots; default if matplotlib is installed.

    Returns
    -------
    dict
        The report, as it is in ``report.json``.

    Raises
    ------
    InputError
        An option or file is not usable, units differ, nothing can be scored, or a limit names no figure.
    GateError
        A figure is above its limit (or is not a number). Everything has been written; the error carries the
        report as `report`.
    """
    chosen = DEFAULT_CUTOFF if cutoff is None else cutoff
    options = Options(order, chosen, base, from_s, to_s, max_gap_s, at, seen_by, within_s, ospa2_window)
    check_options(options, log_path)
    inputs = _input_paths(tracks_path, truth_path, log_path, cameras_path)
    if out_dir is None:
        report = _run(inputs, options, fail_above or {}, None, False)
    else:
        draw = whether_to_draw(plots)
        with OutputFolder(out_dir, [REPORT_NAME, PER_SCAN_NAME, *PLOT_NAMES], force) as out:
            report = _run(inputs, options, fail_above or {}, out, draw)
    if cutoff is None and base == "euclidean" and report["length_unit"] not in (None, "cm"):
        LOGGER.warning("no `cutoff` given: OSPA and GOSPA use the default, %g %s", chosen, report["length_unit"])
    raise_if_above(fail_above or {}, report)
    return report


def _run(
    inputs: dict[str, Path],
    options: Options,
    limits: Mapping[str, float],
    out: OutputFolder | None,
    draw: bool,
) -> dict[str, Any]:
    """Read, score, and write all files of the output folder."""
    tracks = read_tracks(inputs["tracks"])
    truth, truth_unit = read_truth(inputs["truth"])
    cameras, cameras_unit = _cameras(inputs.get("cameras"), tracks)
    unit = _common_unit({"tracks": tracks.length_unit, "truth": truth_unit, "cameras": cameras_unit}, inputs)
    sightings = None if options.seen_by is None else read_sightings(inputs["log"], cameras)
    max_gap_s = DEFAULT_GAP_STEPS * truth.step_s if options.max_gap_s is None else options.max_gap_s
    scored = _score(tracks, truth, sightings, options, max_gap_s, inputs["tracks"])
    check_limits(limits, scored)
    record = provenance("evaluate", asdict(options), inputs=inputs, length_unit=unit)
    report = build_report(scored, options, max_gap_s, unit, record)
    if out is not None:
        write_json(out.path(REPORT_NAME), report)
        write_per_scan(out.path(PER_SCAN_NAME), scored.columns, to_metadata(record))
        if draw:
            # Costly to import, and matplotlib is an extra.
            from stereophd.report.plots import Pictures, write_plots

            pictures = Pictures(
                columns=scored.columns,
                order=options.order,
                cutoff=options.cutoff,
                base=options.base,
                truth=truth,
                max_gap_s=max_gap_s,
                estimates=scored.estimates,
                cameras=cameras or [],
                length_unit=unit,
            )
            write_plots(pictures, {name: out.path(name) for name in PLOT_NAMES})
    return report


def _score(
    tracks: Tracks,
    truth: Truth,
    sightings: Sightings | None,
    options: Options,
    max_gap_s: float,
    tracks_path: Path,
) -> Scored:
    """Bring tracks and truth to the same scans, and score them."""
    events = tracks.events if tracks.all_events else add_truth_times(tracks.events, truth.time_s)
    if options.at == "times":
        events = events.take(last_event_of_each_time(events.time_s))
    events = events.take(in_window(events.time_s, options.from_s, options.to_s))
    aligned = align_truth(truth, events.time_s, max_gap_s)
    usable = ~(aligned.outside | aligned.gap)
    scans = {
        "outside_truth": int(aligned.outside.sum()),
        "truth_gap": int((aligned.gap & ~aligned.outside).sum()),
        "unseen": 0,
    }
    time_s, points = events.time_s[usable], aligned.points.keep_scans(usable)
    estimates = _estimates(tracks, events.take(usable), options, tracks_path)
    mahalanobis = options.base == "mahalanobis"
    if sightings is not None and options.seen_by is not None and options.within_s is not None:
        cameras = cameras_that_saw(sightings, time_s[points.scan], points.label, options.within_s)
        estimates, points, emptied = leave_out_unseen(
            estimates,
            points,
            cameras >= options.seen_by,
            options.order,
            options.cutoff,
            mahalanobis=mahalanobis,
        )
        scans["unseen"] = int(emptied.sum())
        time_s = time_s[~emptied]
        estimates, points = estimates.keep_scans(~emptied), points.keep_scans(~emptied)
    if len(time_s) == 0:
        raise InputError(_nothing_to_score(tracks, truth, scans, options, tracks_path))
    scores = score_scans(estimates, points, options.order, options.cutoff, mahalanobis=mahalanobis)
    ospa2 = track_ospa(estimates, points, options.ospa2_window, options.order, options.cutoff, mahalanobis=mahalanobis)
    errors = pair_errors(estimates, points, scores)
    return Scored(
        figures=figures(estimates, points, scores, ospa2, errors),
        scans={"scored": len(time_s), "not_scored": sum(scans.values()), **scans},
        columns=per_scan_columns(time_s, estimates, points, scores, ospa2, errors),
        estimates=estimates,
    )


def _estimates(tracks: Tracks, events: Events, options: Options, path: Path) -> PointSets:
    """Return the estimates that were reported after each event."""
    count = events.row_end - events.row_start
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    rows = np.arange(start[-1]) + np.repeat(events.row_start - start[:-1], count)
    covariance = tracks.covariance[rows]
    if options.base == "mahalanobis":
        bad = np.flatnonzero(~is_positive_definite(covariance))
        if bad.size:
            raise InputError(
                f"{path}: row {rows[bad[0]]}: column covariance: expected a positive definite covariance "
                "of the position (base mahalanobis), found one that is not"
            )
    return PointSets(start, tracks.position[rows], tracks.velocity[rows], tracks.track_id[rows], covariance)


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


def _nothing_to_score(tracks: Tracks, truth: Truth, scans: dict[str, int], options: Options, path: Path) -> str:
    def span(time_s: NDArray[Any]) -> str:
        return f"{time_s.min():g} to {time_s.max():g} s" if len(time_s) else "none"

    why = ", ".join(f"{name} {count}" for name, count in scans.items() if count)
    limits = "".join(
        f", {name} {value}"
        for name, value in (("`from_s`", options.from_s), ("`to_s`", options.to_s))
        if value is not None
    )
    return f"{path}: nothing to score: events {span(tracks.events.time_s)}, truth {span(truth.time_s)}{limits}" + (
        f", not scored: {why}" if why else ""
    )
