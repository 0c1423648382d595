"""The report of a calibration: cameras, parameters and observability, with units in the names of keys."""

import math
from typing import Any

import numpy as np

from stereophd.config.calibration import CalibrationConfig
from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.observability import (
    DETERMINED,
    HARMLESS_MOVE,
    PARTLY,
    UNDETERMINED,
    UNDETERMINED_RATIO,
    Observability,
    observability,
    pose_spread,
    posed_cameras,
)
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.io.outputs.json_text import finite_or_none
from stereophd.pipeline.calibration.problem import CalibrationProblem, Outcome
from stereophd.wording import percent

# Parameters that make up this part of a direction (in units of prior standard deviations) are named.
NAMED_PART = 0.3


def status_of(problem: CalibrationProblem, outcome: Outcome) -> tuple[str, str, Observability | None]:
    """Status, what is wrong if anything, and the observability if there is a posterior that is believed."""
    part = [text] if (text := _part_used(outcome)) else []
    if why := outcome.reason or outcome.doubt:
        return UNDETERMINED, "; ".join([why, *part]), None
    moves = None if outcome.moves is None else outcome.moves.relative_move
    found = observability(outcome.parameters, problem.reference, outcome.values, outcome.covariance, moves)
    reservations = [remark.text for remark in outcome.remarks if remark.is_reservation]
    if found.status == DETERMINED and not reservations:
        return DETERMINED, "", found
    if found.status == DETERMINED:
        return PARTLY, "; ".join([*reservations, *part]), found
    count = int((found.ratios > UNDETERMINED_RATIO).sum())
    why = f"the data leave {count} of {outcome.parameters.size} directions of the parameters as the prior has them"
    if (largest := float(found.open_moves.max(initial=0.0))) > HARMLESS_MOVE:
        why += f", and one of them moves tracks by {percent(largest)} of their distance"
    return (PARTLY if found.status == PARTLY else UNDETERMINED), "; ".join([why, *reservations, *part]), found


def _part_used(outcome: Outcome) -> str:
    """Return how much of a log that is too long was used; empty where it was used whole."""
    used = outcome.details.get("input", {})
    if not used.get("limited_by"):
        return ""
    fitted = f"{used['detections_used']:,} of {used['detections']:,} detections were used"
    tracked = f"{used['frames_tracked']:,} of {used['frames']:,} frames tracked"
    return f"{fitted} and {tracked}: a larger {used['limited_by']} uses more of the log"


def build_report(
    section: CalibrationConfig, problem: CalibrationProblem, outcome: Outcome, length_unit: str
) -> dict[str, Any]:
    """Return the report without provenance."""
    status, reason, found = status_of(problem, outcome)
    report: dict[str, Any] = {
        "report_version": 1,
        "length_unit": length_unit,
        "method": section.method,
        "posterior": section.posterior if section.method == "annealed" else "particles",
        "status": status,
        "reason": reason,
        "input": problem.counts,
    }
    if found is not None:
        report["scale"] = _scale(section, found, "scale_warning" not in outcome.details)
        if status != UNDETERMINED:
            report["cameras"] = pose_stds(
                outcome.parameters, problem.reference, outcome.values, outcome.covariance, "_std"
            )
        report["parameters"] = _parameters(outcome, found, status, length_unit)
        report["observability"] = _observability(outcome, found)
    return {**report, **outcome.details}


def _scale(section: CalibrationConfig, found: Observability, used: bool) -> dict[str, Any]:
    """Return what determined the scale: a known length that was `used`, however much the answer was widened after."""
    kind = section.scale.kind
    if math.isnan(found.scale_ratio):
        return {"kind": kind, "determined_by": "known cameras", "posterior_over_prior_std": None}
    by_data = "data" if found.scale_ratio <= UNDETERMINED_RATIO else "prior"
    return {
        "kind": kind,
        "determined_by": kind if used and kind != "none" else by_data,
        "posterior_over_prior_std": found.scale_ratio,
    }


def pose_stds(
    parameters: ParameterSet, reference: int, values: Array, covariance: Array, suffix: str
) -> dict[str, dict[str, float | None]]:
    """Standard deviations of rotation, direction of translation, scale and centre of every unknown camera.

    Keys are these words with a suffix, before the unit.
    """
    out = {}
    for name in posed_cameras(parameters):
        spread = pose_spread(parameters, reference, values, covariance, name)
        out[name] = {
            f"rotation{suffix}_deg": finite_or_none(math.degrees(spread.rotation)),
            f"direction{suffix}_deg": finite_or_none(math.degrees(spread.direction)),
            f"scale{suffix}": finite_or_none(spread.scale),
            f"center{suffix}": finite_or_none(spread.center),
        }
    return out


def _parameters(outcome: Outcome, found: Observability, status: str, length_unit: str) -> list[dict[str, Any]]:
    rows = []
    for index, (name, parameter) in enumerate(
        zip(outcome.parameters.names, outcome.parameters.parameters, strict=True)
    ):
        rows.append(
            {
                "name": name,
                "unit": parameter.unit.replace("length", length_unit),
                "prior_std": parameter.std,
                "mean": None if status == UNDETERMINED else float(outcome.values[index]),
                "std": float(np.sqrt(outcome.covariance[index, index])),
                "posterior_over_prior_std": float(found.parameter_ratios[index]),
                "determined_by_data": bool(found.parameter_ratios[index] <= UNDETERMINED_RATIO),
            }
        )
    return rows


def _observability(outcome: Outcome, found: Observability) -> dict[str, Any]:
    names = outcome.parameters.names
    directions = []
    for ratio, direction in zip(found.ratios.tolist(), found.directions, strict=True):
        order = np.argsort(-np.abs(direction), kind="stable")
        parts = {names[i]: float(direction[i]) for i in order if abs(direction[i]) >= NAMED_PART}
        directions.append({"posterior_over_prior_std": ratio, "direction": parts})
    return {
        "information_bits": found.information_bits,
        "determined_directions": int((found.ratios <= UNDETERMINED_RATIO).sum()),
        "of_directions": len(names),
        "directions": directions,
    }
