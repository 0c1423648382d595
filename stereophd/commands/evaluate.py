"""Score the tracks of a run against the truth: OSPA, OSPA(2), GOSPA, RMSE, cardinality, identities, NEES."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from stereophd.core.metrics.truth.interpolation import (
    DEFAULT_GAP_STEPS,
)
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.json_text import write_json
from stereophd.io.outputs.provenance import provenance, to_metadata
from stereophd.pipeline.evaluation.gates import Limits, check_limits, raise_if_failed
from stereophd.pipeline.evaluation.inputs import (
    SCANS_NAME,
    Tracks,
    cameras_of_record,
    read_sightings,
    read_tracks,
    read_truth,
)
from stereophd.pipeline.evaluation.options import Options, check_options
from stereophd.pipeline.evaluation.report import build_report, write_per_scan
from stereophd.pipeline.evaluation.scale import PAPER_CUTOFF, default_cutoff, warn_of_another_scene
from stereophd.pipeline.evaluation.scoring import score_tracks
from stereophd.report.installed import whether_to_draw

if TYPE_CHECKING:
    from stereophd.core.geometry.camera import Camera

REPORT_NAME, PER_SCAN_NAME = "report.json", "per_scan.parquet"
PLOT_NAMES = tuple(f"{plot}.{kind}" for plot in ("ospa", "cardinality", "top", "side") for kind in ("png", "svg"))


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
    tentative: bool = False,
    align: Literal["none", "rigid", "similarity"] = "none",
    align_clock: bool = False,
    match_distance: float | None = None,
    fail_above: Mapping[str, float] | None = None,
    fail_below: Mapping[str, float] | None = None,
    cameras_path: Path | str | None = None,
    force: bool = False,
    plots: bool | None = None,
) -> dict[str, Any]:
    """Score tracks against the truth, and write ``report.json``, ``per_scan.parquet`` and plots.

    Parameters
    ----------
    tracks_path, truth_path : path
        Tables of tracks and truth. With ``scans.parquet`` in the folder of the tracks every event is known, also
        those that reported nothing; without it, the times of the truth stand in for them.
    out_dir : path, optional
        Where to write; nothing is written without it.
    order, cutoff : float
        Order p and cutoff c of OSPA and GOSPA; c in the length unit of the files, or a number of standard
        deviations for the base ``mahalanobis``. The default of c is `evaluation.cutoff` of the configuration of
        the tracks; without it 20 cm for files in centimetres, the paper's, and 20 standard deviations.
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
        Score only objects that at least `seen_by` cameras detected in the last `within_s` seconds according to the log
        (by its ``object_id``; without one, any detection counts). Other objects and the estimates assigned to them are
        left out.
    ospa2_window : int
        Number of scored scans in a window of OSPA(2).
    tentative : bool
        Score tentative estimates too, not only confirmed ones.
    align : str
        ``rigid``: score the tracks after the rotation and translation that bring them nearest to the truth, as those
        of cameras that calibrated themselves; ``similarity``: and after a change of scale.
    align_clock : bool
        Score the tracks after a change of the offset and rate of their clock, estimated with the frame.
    match_distance : float, optional
        Tracks and objects nearer than this, in the unit of c, may be matched: for all figures but OSPA, OSPA(2), GOSPA
        and HOTA. Default c. Where objects are nearer to each other than this, a match may be wrong from the first time
        on and yet be kept.
    fail_above, fail_below : mapping, optional
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
        An option or file is not usable, units differ, no cutoff is known, nothing can be scored, or a limit names
        no figure.
    GateError
        A figure is beyond its limit (or is not a number). Everything has been written; the error carries the
        report as `report`.
    """
    chosen = PAPER_CUTOFF if cutoff is None else cutoff
    options = Options(
        order, chosen, base, from_s, to_s, max_gap_s, at, seen_by, within_s, ospa2_window, tentative, align,
        align_clock, match_distance,
    )  # fmt: skip
    check_options(options, log_path)
    run = partial(
        _run, _input_paths(tracks_path, truth_path, log_path, cameras_path), options, cutoff is not None,
        Limits(fail_above or {}, fail_below or {}),
    )  # fmt: skip
    if out_dir is None:
        report = run(None, False)
    else:
        draw = whether_to_draw(plots)
        with OutputFolder(out_dir, [REPORT_NAME, PER_SCAN_NAME, *PLOT_NAMES], force) as out:
            report = run(out, draw)
    raise_if_failed(report, tracks_path)
    return report


def _run(
    inputs: dict[str, Path],
    options: Options,
    has_cutoff: bool,
    limits: Limits,
    out: OutputFolder | None,
    draw: bool,
) -> dict[str, Any]:
    """Read, score, and write all files of the output folder."""
    tracks = read_tracks(inputs["tracks"])
    truth, truth_unit = read_truth(inputs["truth"])
    cameras, cameras_unit = _cameras(inputs.get("cameras"), tracks)
    unit = _common_unit({"tracks": tracks.length_unit, "truth": truth_unit, "cameras": cameras_unit}, inputs)
    if not has_cutoff:
        options = replace(options, cutoff=default_cutoff(options.base, unit, tracks.metadata, inputs["tracks"]))
    sightings = None if options.seen_by is None else read_sightings(inputs["log"], cameras)
    max_gap_s = DEFAULT_GAP_STEPS * truth.step_s if options.max_gap_s is None else options.max_gap_s
    scored = score_tracks(tracks, truth, sightings, options, max_gap_s, inputs["tracks"])
    warn_of_another_scene(inputs, tracks, truth, scored.scans)
    check_limits(limits, {**scored.figures, "scans": scored.scans})
    record = provenance("evaluate", asdict(options), inputs=inputs, length_unit=unit)
    report = build_report(scored, options, max_gap_s, unit, record, limits)
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
                false_tracks=_mostly_unmatched(report["purity"], "track_id", "estimates"),
                missed_objects=_mostly_unmatched(report["completeness"], "object_id", "scans"),
            )
            write_plots(pictures, {name: out.path(name) for name in PLOT_NAMES})
    return report


def _mostly_unmatched(part: Mapping[str, Any], identity: str, count: str) -> frozenset[int]:
    """Return the identities of which less than half of the rows are matched."""
    return frozenset(int(row[identity]) for row in part["table"] or () if 2 * row["matched"] < row[count])


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
