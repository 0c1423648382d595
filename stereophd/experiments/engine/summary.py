"""Summary of many runs: means with confidence intervals, root mean squares, means over windows of time.

The interval of a mean is Student's, at 95 %. A root mean square R = sqrt(mean of e^2) takes the interval of
the mean of e^2, through the root. The bound of a case is the same for every method.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.numerics.times import TIME_DECIMALS
from stereophd.errors import InputError, nearest
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.work import experiment_section

CONFIDENCE = 0.95
ERROR, RMSE = "_error", "_rmse"

Windows = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Summary:
    """One quantity over the runs of one method in one case."""

    quantity: str
    unit: str
    times_s: Array | None  # (k,) or None
    runs: np.ndarray[tuple[int], np.dtype[np.int64]]  # (k,) of int: Runs in which it is defined
    # arrays (k,): NaN where not defined. The mean of a quantity ``*_rmse*`` is the root mean square over the runs.
    mean: Array
    std: Array
    ci_low: Array
    ci_high: Array
    bound: Array
    # Whose it is, and the name of the value along each axis of the cases.
    method: str = ""
    case: str = ""
    settings: tuple[str, ...] = ()


def with_windows(series: Sequence[Series], windows: Windows, squares: bool = True) -> list[Series]:
    """Return series of one run, and their means over windows of time (name -> first and last time, s).

    A window W adds ``X_W``, and for errors ``X_error_W`` and, with `squares` (not for the bound of a mean),
    ``X_rmse_W``.
    """
    out = list(series)
    for name, (first, last) in windows.items():
        for run_series in series:
            if run_series.times_s is None:
                continue
            inside = (run_series.times_s >= first) & (run_series.times_s <= last) & ~np.isnan(run_series.values)
            values = run_series.values[inside]
            mean = np.array([values.mean() if values.size else np.nan])
            with np.errstate(over="ignore"):  # of a filter that has lost all it knew
                root = np.array([np.sqrt((values**2).mean()) if values.size else np.nan])
            out.append(
                Series(f"{run_series.quantity}_{name}", run_series.unit, root if is_rms(run_series.quantity) else mean)
            )
            if squares and run_series.quantity.endswith(ERROR):
                out.append(Series(f"{run_series.quantity.removesuffix(ERROR)}{RMSE}_{name}", run_series.unit, root))
    return out


def is_rms(quantity: str) -> bool:
    """Whether values of a quantity are summarised by their root mean square."""
    return RMSE in quantity


def summarise(runs: Sequence[Sequence[Series]], bounds: Iterable[Series]) -> list[Summary]:
    """Return the summaries of one method in one case, from the series of every run and the bounds of the case."""
    quantities: dict[tuple[str, str, bool], list[Series]] = {}
    for run in runs:
        for series in run:
            quantities.setdefault((series.quantity, series.unit, series.times_s is None), []).append(series)
    known = {(series.quantity, series.times_s is None): series for series in bounds}
    out = []
    for (quantity, unit, whole), alike in quantities.items():
        times_s, values = _matrix(alike)
        names = [quantity]
        if quantity.endswith(ERROR):
            names.append(quantity.removesuffix(ERROR) + RMSE)
        for name in names:
            bound = _bound(known.get((name, whole)), times_s, values.shape[1])
            out.append(_summary(name, unit, times_s, values, bound))
    return out


def _matrix(runs: Sequence[Series]) -> tuple[Array | None, Array]:
    """Return the times (k,) and the values (runs, k), NaN where a run has none."""
    first = runs[0].times_s
    if first is None:
        return None, np.array([run.values for run in runs])
    if all(run.times_s is not None and np.array_equal(run.times_s, first) for run in runs):
        return first, np.array([run.values for run in runs])
    rounded = [np.round(run.times_s, TIME_DECIMALS) for run in runs if run.times_s is not None]
    times_s = np.unique(np.concatenate(rounded))
    values = np.full((len(runs), len(times_s)), np.nan)
    for row, run_times, run in zip(values, rounded, runs, strict=True):
        row[np.searchsorted(times_s, run_times)] = run.values
    return times_s, values


def _bound(bound: Series | None, times_s: Array | None, count: int) -> Array:
    out = np.full(count, np.nan)
    if bound is None:
        return out
    if times_s is None or bound.times_s is None:
        return bound.values.copy()
    at = dict(zip(np.round(bound.times_s, TIME_DECIMALS).tolist(), bound.values.tolist(), strict=True))
    return np.array([at.get(time, np.nan) for time in np.round(times_s, TIME_DECIMALS).tolist()])


def _summary(quantity: str, unit: str, times_s: Array | None, values: Array, bound: Array) -> Summary:
    from scipy.special import stdtrit  # costly to import, which workers need not

    rms = is_rms(quantity)
    defined = ~np.isnan(values)
    runs = defined.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        samples = values**2 if rms else values
        mean = np.where(defined, samples, 0.0).sum(axis=0) / runs
        squares = np.where(defined, (samples - mean) ** 2, 0.0).sum(axis=0)
        std = np.where(runs > 1, np.sqrt(squares / (runs - 1.0)), np.nan)
        half = stdtrit(np.maximum(runs - 1.0, 1.0), 0.5 + CONFIDENCE / 2.0) * std / np.sqrt(runs)
        low, high = mean - half, mean + half
        if rms:
            mean, low, high = np.sqrt(mean), np.sqrt(np.maximum(low, 0.0)), np.sqrt(high)
            std = np.full_like(mean, np.nan)
    return Summary(quantity, unit, times_s, runs.astype(np.int64), mean, std, low, high, bound)


def check_quantities(loaded: LoadedConfig, cells: Iterable[tuple[str, str]]) -> Callable[..., None]:
    """Return what takes note of method, case and series of every run, of `cells`: their names of method and case.

    As soon as every method has one run in every case, and not after all runs, it raises InputError for a quantity of
    the table or the figure that no run gave.
    """
    settings, left = experiment_section(loaded), set(cells)
    wanted = {
        "experiment.table": settings.table or (),
        "experiment.figure.quantities": settings.figure.quantities or (),
    }
    known: dict[str, None] = {}

    def see(method: str, case: str, series: Sequence[Series]) -> None:
        if (method, case) not in left:
            return
        left.remove((method, case))
        summaries = summarise([with_windows(series, settings.windows)], [])
        known.update(dict.fromkeys(summary.quantity for summary in summaries))
        unknown = [(key, name) for key, names in wanted.items() for name in names if name not in known]
        if unknown and not left:
            key, name = unknown[0]
            raise InputError(f"{loaded.path}: {key}: unknown quantity {name}{nearest(name, known)}")

    return see
