"""Limits on the figures of an evaluation: what is compared, and what happens where a figure is beyond its limit."""

import math
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal

from stereophd.errors import GateError, InputError

Side = Literal["above", "below"]


#: Limits of figures by dotted key, such as ``{"ospa.mean": 0.8}``, of each side: a figure beyond its limit fails.
Limits = Mapping[Side, Mapping[str, float]]


def limits_of(above: Mapping[str, float] | None, below: Mapping[str, float] | None) -> Limits:
    """Return the limits that options state."""
    return {"above": above or {}, "below": below or {}}


def figures_by_key(figures: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the numbers of nested figures by dotted key, such as ``ospa.mean``."""
    flat: dict[str, float | None] = {}
    for group, values in figures.items():
        named = values.items() if isinstance(values, Mapping) else [("", values)]
        for name, value in named:
            if value is None or isinstance(value, int | float):
                flat[f"{group}.{name}".rstrip(".")] = value
    return flat


def check_limits(limits: Limits, figures: Mapping[str, Any]) -> None:
    """Raise InputError for a limit that is not a number, or of something that is not a figure of the run."""
    known = figures_by_key(figures)
    for side, chosen in limits.items():
        for key, limit in chosen.items():
            if key not in known:
                near = get_close_matches(key, known, n=1, cutoff=0.0)[0]
                raise InputError(f"`fail_{side}`: {key}: no such figure in the report; did you mean {near}?")
            if math.isnan(limit):
                raise InputError(f"`fail_{side}`: {key}: expected a number, found {limit}")


def gates(limits: Limits, figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a record of every limit: ``name, value, limit, fails, passed``; a figure that is null fails."""
    values = figures_by_key(figures)
    found = []
    for side, chosen in limits.items():
        for name, limit in chosen.items():
            value = values[name]
            passed = value is not None and (value <= limit if side == "above" else value >= limit)
            found.append({"name": name, "value": value, "limit": limit, "fails": side, "passed": passed})
    return found


def raise_if_failed(report: Mapping[str, Any], path: Path | str) -> None:
    """Raise GateError naming the file that was scored and every figure of `gates` beyond its limit."""
    failed = [gate for gate in report["gates"] if not gate["passed"]]
    if not failed:
        return
    texts = []
    for gate in failed:
        value = "null" if gate["value"] is None else format(gate["value"], ".6g")
        texts.append(f"{gate['name']} is {value}, {gate['fails']} the limit {gate['limit']:g}")
    raise GateError(f"{path}: {'; '.join(texts)}", dict(report))
