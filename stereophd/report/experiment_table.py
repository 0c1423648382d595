"""The results of an experiment as tables for readers."""

from collections.abc import Iterator

import numpy as np

from stereophd.experiments.engine.results import Results
from stereophd.experiments.engine.summary import Summary, is_rms
from stereophd.report.tables import SummaryTable, table_text


def results_text(results: Results) -> str:
    """Return a table for each quantity, a row for each case and method, and the CPU times as text."""
    tables = [_table(results, quantity) for quantity in _quantities(results)]
    medians, ratios = results.timing["cpu_s_per_run"], results.timing["ratio_to_first_method"]
    first = next(iter(medians))
    lines = []
    for method, seconds in medians.items():
        ratio = "" if method == first or ratios[method] is None else f", {ratios[method]:.3g} times {first}"
        lines.append(f"CPU time per run, {method}: {1e3 * seconds:.3g} ms{ratio}")
    return "\n\n".join([*(table_text(table) for table in tables if table.rows), "\n".join(lines)])


def _table(results: Results, quantity: str) -> SummaryTable:
    rows = list(_rows(results, quantity))
    if not rows:
        return SummaryTable(quantity, (), ())
    with_bound = any(row[-1] for row in rows)
    unit = next(each.unit for each in results.summaries if each.quantity == quantity)
    title = f"{quantity} [{unit}]" if unit != "1" else quantity
    header = ("case", "method", "rms" if is_rms(quantity) else "mean", "95 % interval", "std", "bound", "ratio")
    columns = len(header) if with_bound else 5
    return SummaryTable(title, header[:columns], tuple(row[:columns] for row in rows), words=(0, 1))


def _quantities(results: Results) -> list[str]:
    if results.config.table is not None:
        return list(results.config.table)
    return list(dict.fromkeys(summary.quantity for summary in results.summaries if summary.times_s is None))


def _rows(results: Results, quantity: str) -> Iterator[tuple[str, ...]]:
    chosen = [each for each in results.summaries if each.quantity == quantity and each.times_s is None]
    order = list(dict.fromkeys(each.case for each in results.summaries))
    for summary in sorted(chosen, key=lambda each: order.index(each.case)):
        yield (summary.case, summary.method, *_values(summary))


def _values(summary: Summary) -> tuple[str, ...]:
    mean, bound = float(summary.mean[0]), float(summary.bound[0])
    interval = (
        f"{_number(summary.ci_low[0])} to {_number(summary.ci_high[0])}" if np.isfinite(summary.ci_low[0]) else ""
    )
    if not np.isfinite(bound):
        return (_number(mean), interval, _number(summary.std[0]), "", "")
    return (_number(mean), interval, _number(summary.std[0]), _number(bound), f"{mean / bound:.3f}")


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4g}"
