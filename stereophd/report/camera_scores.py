"""Reports about cameras for readers: scores of calibrated ones against true ones, and those of `align`."""

from collections.abc import Mapping
from typing import Any

from stereophd.core.calibration.unknowns.quantities.registry import quantities, quantity_of
from stereophd.report.summaries import share
from stereophd.report.tables import SummaryTable, table_text
from stereophd.wording import number, shown_unit

# Errors up to this are rounding of the files of cameras, in any unit.
ROUNDING = 1e-12


def camera_scores_text(report: Mapping[str, Any]) -> str:
    """Return the report of `stereophd.commands.evaluate_cameras.evaluate_calibration` as text for a terminal."""
    tables = [_poses(report), _bounds(report), _others(report), _parameters(report), _gates(report)]
    return "\n\n".join(table_text(table) for table in tables if table.rows or table.notes)


def _poses(report: Mapping[str, Any]) -> SummaryTable:
    rows = [(name, *_pose_cells(errors)) for name, errors in report["cameras"].items()]
    if len(rows) > 1:
        rows.append(("all together", *_pose_cells(report["joint"])))
    unit = report["length_unit"]
    header = ("camera", "rotation [deg]", "direction [deg]", "scale ratio", f"centre [{unit}]",
              f"centre after scale [{unit}]")  # fmt: skip
    notes = ("all together: root mean squares, and the scale of the whole scene",) if len(rows) > 1 else ()
    if "scale_is_unknown" in report:
        notes += (report["scale_is_unknown"],)
    return SummaryTable(f"Errors of the poses relative to camera {report['reference']}", header, tuple(rows), notes)


def _pose_cells(errors: Mapping[str, Any]) -> tuple[str, ...]:
    keys = ("rotation_deg", "direction_deg", "scale_ratio", "center", "center_after_scale")
    return tuple(number(errors[key], 5 if key == "scale_ratio" else 3) for key in keys)


def _bounds(report: Mapping[str, Any]) -> SummaryTable:
    cameras = report.get("bounds", {}).get("cameras", {})
    keys = ("rotation_deg", "direction_deg", "scale", "center")
    rows = tuple((name, *(number(bound[key]) for key in keys)) for name, bound in cameras.items())
    header = ("camera", "rotation [deg]", "direction [deg]", "scale", f"centre [{report['length_unit']}]")
    return SummaryTable("Cramer-Rao bounds of these errors", header, rows)


def _others(report: Mapping[str, Any]) -> SummaryTable:
    """Errors of lenses, clocks and movements that are not the true ones."""
    by_camera: Mapping[str, Mapping[str, float | None]] = report["quantities"]
    rows = []
    for quantity, component in ((one, name) for one in quantities() for name in one.components):
        key = quantity.key(component)
        errors = [figures.get(key, 0.0) for figures in by_camera.values()]
        if any(error is None or abs(error) > ROUNDING for error in errors):
            cells = (number(figures.get(key)) for figures in by_camera.values())
            rows.append((component, shown_unit(quantity.unit, report["length_unit"])[1], *cells))
    notes = () if rows else ("none: intrinsics, lenses, clocks and movements are the true ones",)
    return SummaryTable("Other errors, estimated less true", ("value", "unit", *by_camera), tuple(rows), notes)


def _parameters(report: Mapping[str, Any]) -> SummaryTable:
    """Errors of the parameters of the posterior, and the bounds of their standard deviations."""
    posterior, bounds = report.get("posterior") or {}, report.get("bounds", {}).get("parameters", {})
    errors = posterior.get("parameters", {})
    header = ["parameter", "unit", *(("error", "std", "in 90 % interval") if errors else ())]
    header += ["bound of std"] if bounds else []
    rows = []
    for name in dict.fromkeys((*errors, *bounds)):
        factor, unit = shown_unit(quantity_of(name.rpartition(".")[2]).unit, report["length_unit"])
        row = [name, unit]
        if errors:
            score = errors.get(name)
            row += ["-"] * 3 if score is None else [
                number(factor * score["error"]), number(factor * score["std"]), "yes" if score["covered_90"] else "no"
            ]  # fmt: skip
        if bounds:
            row.append(number(factor * bounds[name]) if name in bounds else "-")
        rows.append(tuple(row))
    notes: tuple[str, ...] = ()
    if errors:
        notes = (
            f"NEES for each parameter: {number(posterior['nees'])} (1 if consistent)",
            f"{share(posterior['covered_90'])} of the parameters lie in their 90 % intervals",
        )
    title = "Parameters of the posterior" if errors else "Cramer-Rao bounds of the parameters"
    return SummaryTable(title, tuple(header), tuple(rows), notes)


def _gates(report: Mapping[str, Any]) -> SummaryTable:
    rows = tuple(
        (
            gate["name"],
            number(gate["value"], 4),
            f"{gate['fails']} {gate['limit']:g}",
            "yes" if gate["passed"] else "no",
        )
        for gate in report["gates"]
    )
    return SummaryTable("Limits", ("figure", "value", "fails if", "passed"), rows)


def alignments_text(report: Mapping[str, Any]) -> str:
    """Return a paragraph for each run."""
    return "\n\n".join("\n".join(_lines(run)) for run in report["runs"])


def _lines(run: Mapping[str, Any]) -> list[str]:
    unit, clock = run["length_unit"], run["clock"]
    lines = [
        f"{run['name']} to {run['to']}",
        f"  scale        {run['scale']:.6g} +- {number(run['scale_std'])}",
        f"  rotation     {_vector(run['rotation_deg'])} +- {_vector(run['rotation_std_deg'])} deg",
        f"  translation  {_vector(run['translation'])} {unit}",
        f"  middle       {_vector(run['translation_std_at'])} +- {_vector(run['translation_std'])} {unit}",
        f"  clock        {clock['shift_s']:+.4f} +- {number(clock['shift_std_s'])} s at {clock['at_s']:.3f} s, "
        f"rate {clock['rate']:.7g} +- {number(clock['rate_std'])}",
    ]
    for name, of in (("residual", unit), ("residual_px", "px")):
        if name in run:
            left = run[name]
            lines.append(f"  left over    {number(left['median'])} {of} (median), {number(left['p90'])} {of} (90 %)")
    if run["tracks"]:
        more = " and others" if len(run["tracks"]) > 8 else ""
        lines.append(f"  tracks       {', '.join(map(str, run['tracks'][:8]))}{more}")
    if "scale_is_unknown" in run:
        lines.append(f"  {run['scale_is_unknown']}")
    return lines


def _vector(values: list[float]) -> str:
    return "[" + ", ".join(number(value, 4) for value in values) + "]"
