"""The results of an experiment as tables for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from stereophd.experiments.engine.summary import is_rms

if TYPE_CHECKING:
    from stereophd.experiments.engine.results import Results
    from stereophd.experiments.engine.summary import Summary


def print_results(results: Results, console: Console) -> None:
    """Print a table for each quantity: a row for each case and method.

    Parameters
    ----------
    results : Results
    console : Console
        Where to print; it decides about colour and width.
    """
    for quantity in _quantities(results):
        rows = list(_rows(results, quantity))
        if not rows:
            continue
        with_bound = any(row[-1] for row in rows)
        unit = next(one.unit for cell in results.cells for one in cell.summaries if one.quantity == quantity)
        title = f"{quantity} [{unit}]" if unit != "1" else quantity
        table = Table(title=escape(title), title_justify="left", title_style="bold", box=None, pad_edge=False)
        for name in ("case", "method"):
            table.add_column(name, no_wrap=True)
        mean = "rms" if is_rms(quantity) else "mean"
        for name in (mean, "95 % interval", "std", "bound", "ratio")[: 5 if with_bound else 3]:
            table.add_column(name, justify="right", no_wrap=True)
        for row in rows:
            table.add_row(*map(escape, row[: 7 if with_bound else 5]))
        console.print(table)
        console.print()
    medians, ratios = results.timing["cpu_s_per_run"], results.timing["ratio_to_first_method"]
    first = next(iter(medians))
    for method, seconds in medians.items():
        ratio = "" if method == first or ratios[method] is None else f", {ratios[method]:.3g} times {first}"
        console.print(f"processor time a run, {escape(method)}: {1e3 * seconds:.3g} ms{escape(ratio)}", highlight=False)


def _quantities(results: Results) -> list[str]:
    if results.config.table is not None:
        return list(results.config.table)
    names = [one.quantity for cell in results.cells for one in cell.summaries if one.times_s is None]
    return list(dict.fromkeys(names))


def _rows(results: Results, quantity: str) -> Iterator[tuple[str, ...]]:
    cases = dict.fromkeys(cell.case for cell in results.cells)
    for case in cases:
        for cell in results.cells:
            for one in cell.summaries:
                if cell.case == case and one.quantity == quantity and one.times_s is None:
                    yield (case, cell.method, *_values(one))


def _values(one: Summary) -> tuple[str, ...]:
    mean, bound = float(one.mean[0]), float(one.bound[0])
    interval = f"{_number(one.ci_low[0])} to {_number(one.ci_high[0])}" if np.isfinite(one.ci_low[0]) else ""
    if not np.isfinite(bound):
        return (_number(mean), interval, _number(one.std[0]), "", "")
    return (_number(mean), interval, _number(one.std[0]), _number(bound), f"{mean / bound:.3f}")


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4g}"
