"""Limits on the figures of an evaluation: what is compared, and what happens where a figure is beyond its limit."""

import math
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from stereophd.errors import GateError, InputError

#: Limits of figures by dotted key, such as ``{"ospa.mean": 0.8}``.
Limits = Mapping[str, float]

# Groups of figures that a report has only with an option, and the option.
ADDED_BY = {"tgospa": "switch_cost"}


def figures_by_key(figures: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the numbers of nested figures by dotted key, such as ``ospa.mean``."""
    flat: dict[str, float | None] = {}
    for group, values in figures.items():
        named = values.items() if isinstance(values, Mapping) else [("", values)]
        for name, value in named:
            if value is None or isinstance(value, int | float):
                flat[f"{group}.{name}".rstrip(".")] = value
    return flat


def gates(above: Limits | None, below: Limits | None, figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a record of every limit: ``name, value, limit, fails, passed``.

    Figures above a limit of `above` fail, those below one of `below`, and those that are null. Raises InputError for a
    limit that is not a number, or of something that is not a figure of the run.
    """
    values = figures_by_key(figures)
    found = []
    for side, limits in (("above", above or {}), ("below", below or {})):
        for name, limit in limits.items():
            if name not in values:
                option = ADDED_BY.get(name.split(".")[0])
                near = get_close_matches(name, values, n=1, cutoff=0.0)[0]
                hint = f"did you mean {near}?" if option is None else f"`{option}` adds it"
                raise InputError(f"`fail_{side}`: {name}: no such figure in the report; {hint}")
            if math.isnan(limit):
                raise InputError(f"`fail_{side}`: {name}: expected a number, found {limit}")
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
        if gate["value"] is None:
            texts.append(f"{gate['name']} has no value, so the limit {gate['limit']:g} cannot hold")
        else:
            texts.append(f"{gate['name']} is {gate['value']:.6g}, {gate['fails']} the limit {gate['limit']:g}")
    raise GateError(f"{path}: {'; '.join(texts)}", dict(report))
