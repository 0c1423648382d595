"""Results of a run of `track` or `calibrate` as tables for readers: rounded, with units.

The terminal and the page print the same tables.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

from stereophd.pipeline.checks.run_checks import MOST_OUTLIERS
from stereophd.report.tables import CHECKS, SummaryTable, table_text
from stereophd.validated import NO_LENGTH
from stereophd.wording import counted, number, percent, shown_unit

# Tracks that the terminal lists.
TRACKS_SHOWN = 20
# Cameras that have their own column in the table of tracks.
CAMERAS_SHOWN = 6

# What determined the scale of calibrated cameras, in words.
SCALES = {
    "prior": "the first guess alone, and as wrong as that: state a distance (calibration.scale)",
    "known cameras": "the cameras whose places are given",
    "data": "the first guess and the data",
    "baseline": "the stated distance of two cameras",
    "speed": "the stated speed of the objects",
    "length": "the stated distance of two objects",
    "control": "the control",
}


def share(value: float | None) -> str:
    """Return a share in per cent."""
    return "-" if value is None else percent(value)


def tracking_part(report: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the figures of a tracking run inside a report; empty if there are none."""
    part = report.get("tracking", report)
    return part if isinstance(part.get("tracks"), list) else {}


class FitTotals(NamedTuple):
    """How well the tracks of a run explain the detections of all cameras; None where nothing is known."""

    detections: int
    explained: float | None  # Share of the detections
    residual_px: float | None  # Root mean square of one axis
    ratio: float | None  # Of the residuals to what the noise leads to expect
    outliers: float  # The largest share of a camera's residuals that is left out


def fit_totals(tracking: Mapping[str, Any]) -> FitTotals:
    """Return the figures of all cameras of a tracking run together."""
    cameras = (tracking.get("cameras") or {}).values()
    detections = sum(camera["detections"] for camera in cameras)
    explained = sum(camera["explained_detections"] for camera in cameras) / detections if detections else None
    residuals = sum(camera["residuals"] for camera in cameras)

    def rms(key: str) -> float | None:
        known = [(c["residuals"], c[key]) for c in cameras if c.get(key)]
        # products of floats that are too large are infinite; powers would raise
        return (sum(n * value * value for n, value in known) / residuals) ** 0.5 if known and residuals else None

    outliers = max((camera.get("outlier_share") or 0.0 for camera in cameras), default=0.0)
    return FitTotals(detections, explained, rms("residual_rms_px"), rms("residual_ratio"), outliers)


def residual_text(rms_px: float | None, outliers: float | None, unit: str = "") -> str:
    """Return the root mean square of residuals, and the share that is left out of it where that is large."""
    left_out = f" ({percent(outliers)} left out)" if outliers is not None and outliers > MOST_OUTLIERS else ""
    return f"{number(rms_px, 2)}{unit}{left_out}"


def run_tables(report: Mapping[str, Any], most_tracks: int | None = TRACKS_SHOWN) -> list[SummaryTable]:
    """Return the tables of a ``report.json`` of `track` or `calibrate`: calibration, cameras, tracks, findings.

    Of the tracks only the longest are listed; None: all of them.
    """
    unit = report.get("length_unit") or "length"
    tracking = tracking_part(report)
    tables = []
    if "parameters" in report:
        tables += [_poses(report, unit), _parameters(report)]
    described = report["provenance"]["config"].get("cameras") or {}
    if tracking:
        clocks = _clocks(report, described)
        tables += [_cameras(tracking.get("cameras") or {}, described, clocks, report.get("detectors"))]
        tables += [_tracks(tracking, described, unit, most_tracks)]
    if report.get("checks"):
        tables.append(_findings(report["checks"], _status(report)))
    return [table for table in tables if table.rows or table.notes]


def summary_text(report: Mapping[str, Any]) -> str:
    """Return the verdict and the tables of a report as text for a terminal."""
    return "\n\n".join([verdict(report), *map(table_text, run_tables(report))])


def _poses(report: Mapping[str, Any], unit: str) -> SummaryTable:
    rows = [
        (name, number(camera["rotation_std_deg"]), number(camera["direction_std_deg"]), number(camera["center_std"]))
        for name, camera in (report.get("cameras") or {}).items()
    ]
    header = ("camera", "rotation std [deg]", "direction std [deg]", f"centre std [{unit}]")
    return SummaryTable("Calibrated cameras", header, tuple(rows), tuple(_scale(report)))


def _scale(report: Mapping[str, Any]) -> Iterator[str]:
    if (scale := report.get("scale")) is not None:
        known = SCALES.get(by := str(scale.get("determined_by")), f"what is stated: {by}")
        if by == "prior" and report.get("length_unit") == NO_LENGTH:
            known = "nothing: the distance of two cameras is 1; state a distance (calibration.scale)"
        yield f"scale from {known}"


def _parameters(report: Mapping[str, Any]) -> SummaryTable:
    rows = []
    for estimate in report["parameters"]:
        factor, unit = shown_unit(estimate["unit"])
        mean = None if estimate["mean"] is None else factor * estimate["mean"]
        rows.append(
            (
                estimate["name"],
                unit,
                number(factor * estimate["prior_std"]),
                number(mean),
                number(factor * estimate["std"]),
                number(estimate["posterior_over_prior_std"], 2),
                "the data" if estimate["determined_by_data"] else "the prior",
            )
        )
    header = ("parameter", "unit", "prior std", "offset from prior", "std", "std / prior std", "determined by")
    return SummaryTable("Parameters", header, tuple(rows))


def _clocks(report: Mapping[str, Any], described: Mapping[str, Any]) -> dict[str, str]:
    """Return offset and rate of every clock, with the correction that a calibration found, on that of a control."""
    estimates = {estimate["name"]: estimate for estimate in report.get("parameters", ())}
    world = (report.get("control") or {}).get("clock") or {"at_s": 0.0, "shift_s": 0.0, "rate": 1.0}
    out = {}
    for name, camera in described.items():
        clock = camera.get("clock") or {}
        offset, rate = float(clock.get("offset_s") or 0.0), float(clock.get("rate") or 1.0)
        estimated = estimates.get(f"{name}.clock_offset")
        mean = None if estimated is None else estimated["mean"]
        offset += mean or 0.0
        offset += world["shift_s"] + (world["rate"] - 1.0) * (offset - world["at_s"])
        rate *= world["rate"]
        text = "as in the log" if mean is None and not offset else f"{offset:+.4f} s"
        if estimated is not None and mean is not None:
            text += f" +- {number(estimated['std'], 2)}"
        if rate != 1.0:
            text += f", {1e6 * (rate - 1.0):+.0f} ppm"
        out[name] = text
    return out


def _cameras(
    figures: Mapping[str, Any],
    described: Mapping[str, Any],
    clocks: Mapping[str, str],
    detectors: Mapping[str, Any] | None,
) -> SummaryTable:
    rows = []
    for name, camera in figures.items():
        detector = (detectors or {}).get("cameras", {}).get(name) or (described.get(name) or {}).get("detector") or {}
        mean = camera["residual_mean_px"]
        a_frame = camera["detections"] / camera["frames"] if camera["frames"] else None
        rows.append(
            (
                name,
                str(camera["frames"]),
                str(camera["detections"]),
                number(a_frame, 2),
                share(camera["explained_share"]),
                residual_text(camera["residual_rms_px"], camera.get("outlier_share")),
                "-" if mean is None else f"{mean[0]:+.2f}, {mean[1]:+.2f}",
                " x ".join(dict.fromkeys(number(s, 2) for s in detector.get("sigma_px") or ())) or "-",
                clocks.get(name, "-"),
            )
        )
    header = (
        "camera", "frames", "detections", "per frame", "explained", "residual [px]", "mean u, v [px]", "noise [px]",
        "clock offset",
    )  # fmt: skip
    return SummaryTable("Cameras", header, tuple(rows))


def _tracks(
    tracking: Mapping[str, Any], described: Mapping[str, Any], unit: str, most: int | None
) -> SummaryTable:  # fmt: skip
    tracks: Sequence[Mapping[str, Any]] = tracking["tracks"]
    if not tracks:
        return SummaryTable("Tracks", (), (), ("no tracks",))
    names = list(tracks[0]["n_detections"])
    each = names if len(names) <= CAMERAS_SHOWN else []
    by_length = sorted(tracks, key=lambda track: (track["first_s"] - track["last_s"], track["track_id"]))
    chosen = sorted(by_length[: len(tracks) if most is None else most], key=lambda track: track["track_id"])
    rows = []
    for track in chosen:
        counts = track["n_detections"]
        rows.append(
            (
                str(track["track_id"]),
                f"{track['first_s']:.2f}",
                f"{track['last_s']:.2f}",
                f"{track['last_s'] - track['first_s']:.2f}",
                *(str(counts.get(name, 0)) for name in each),
                *(() if each else (str(sum(counts.values())), str(sum(n > 0 for n in counts.values())))),
                number(track.get("mean_speed")),
                number(track.get("mean_position_std"), 2),
                number(track["mean_existence"], 2),
            )
        )
    header = (
        "track", "from [s]", "to [s]", "lasts [s]", *(f"seen by {name}" for name in each),
        *(() if each else ("detections", "cameras")), f"speed [{unit}/s]", f"position std, 3-D [{unit}]", "existence",
    )  # fmt: skip
    hidden = len(tracks) - len(chosen)
    shorter = [f"... and {counted(hidden, 'shorter track')}"] * bool(hidden)
    notes = (*shorter, *_camera_error(tracking, described, unit))
    return SummaryTable(f"Tracks ({len(tracks)})", header, tuple(rows), notes)


def _camera_error(tracking: Mapping[str, Any], described: Mapping[str, Any], unit: str) -> Iterator[str]:
    """Yield what an error of a camera would do to tracks, where their standard deviations do not count any."""
    error = tracking.get("camera_error") or {}
    focal = [f for camera in described.values() if isinstance(f := (camera.get("intrinsics") or {}).get("fx"), float)]
    if error.get("move_per_px") is not None:
        angle = f" (a turn by {number(math.degrees(1.0 / median(focal)), 2)} deg)" if focal else ""
        yield "position std takes the cameras as exact"
        yield (
            f"detections of one camera that all lie 1 px off{angle} would move tracks by up to "
            f"{number(error['move_per_px'], 2)} {unit}, and by up to {number(error['stds_per_px'], 2)} standard "
            "deviations"
        )


def _findings(checks: Sequence[Mapping[str, Any]], said: str) -> SummaryTable:
    """Return the warnings that the verdict has not `said` before."""
    warnings = [check for check in checks if check["status"] == "warning"]
    rows = tuple(
        (check["name"], check["camera"] or "all", check["message"], check["remedy"] or "-")
        for check in warnings
        if check["message"] not in said
    )
    fine, missing = (sum(check["status"] == status for check in checks) for status in ("ok", "not checked"))
    note = f"{fine} of {len(checks)} checks passed" + (f", {len(warnings)} warn" if warnings else "")
    note += f", {missing} not checked" if missing else ""
    return SummaryTable(CHECKS, ("check", "camera", "finding", "remedy"), rows, (note,))


def _status(report: Mapping[str, Any]) -> str:
    """Return the status of a calibration with its reason; empty of a run of `track`."""
    return ": ".join(str(report[key]) for key in ("status", "reason") if report.get(key))


def verdict(report: Mapping[str, Any], evaluation: Mapping[str, Any] | None = None) -> str:
    """Return one line with the results of a run and the doubts about them."""
    return "; ".join(_clauses(report, evaluation)) + "."


def _clauses(report: Mapping[str, Any], evaluation: Mapping[str, Any] | None) -> Iterator[str]:
    unit = report.get("length_unit") or "length"
    if "parameters" in report or "status" in report:
        yield f"Cameras are {_status(report)}"
        worst = [camera["rotation_std_deg"] for camera in (report.get("cameras") or {}).values()]
        if worst:
            yield f"rotations to {number(max(worst), 2)} deg or better"
            yield from _scale(report)
        used = report.get("input") or {}
        limit = used.get("limited_by")
        if limit and limit not in (report.get("reason") or "") and used["detections_used"] < used["detections"]:
            part = f"{used['detections_used']:,} of {used['detections']:,} detections"
            yield f"they were fitted to a part of the log with {part} ({limit})"
    tracking = tracking_part(report)
    if tracking:
        tracks = tracking["tracks"]
        span = max((t["last_s"] for t in tracks), default=0.0) - min((t["first_s"] for t in tracks), default=0.0)
        count = len(tracks)
        cameras = counted(len(tracking.get("cameras") or {}), "camera")
        yield f"{counted(count, 'track')} in {number(span)} s from {cameras}" if count else "No tracks"
        totals = fit_totals(tracking)
        if totals.explained is not None and count:
            yield f"they explain {share(totals.explained)} of {totals.detections:,} detections"
            if totals.residual_px is not None:
                of_noise = "" if totals.ratio is None else f", {totals.ratio:.2f} times what the noise leads to expect"
                yield f"residual {residual_text(totals.residual_px, totals.outliers, ' px')}{of_noise}"
    if evaluation is not None:
        ospa = evaluation["ospa"]
        scale = f" {unit}" if ospa["base"] == "euclidean" else ""
        yield f"OSPA {number(ospa['mean'])}{scale} (cutoff {ospa['cutoff']:g}{scale})"
    warnings = Counter(finding["name"] for finding in report.get("checks", ()) if finding["status"] == "warning")
    if warnings:
        what = "check warns" if warnings.total() == 1 else "checks warn"
        names = (name if count == 1 else f"{name} ({count} times)" for name, count in warnings.items())
        yield f"{warnings.total()} {what}: {', '.join(names)}"
    elif report.get("checks"):
        yield "no check warns"
