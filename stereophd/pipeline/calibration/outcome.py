"""Results of a calibration method, and the random numbers of its purposes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from stereophd.core.arrays import Array
from stereophd.core.calibration.annealing.task import Fit

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class HistoryRow:
    """Posterior of the parameters given the log up to a time."""

    time_s: float
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class Outcome:
    """The result of a method."""

    # `values`, `covariance`: arrays (m,), (m, m): Mean (or optimum) and covariance; NaN where nothing agrees with the
    # data.
    values: Array
    covariance: Array
    # `particles`, `log_weights`: arrays (k, m), (k,): Posterior as particles.
    particles: Array
    log_weights: Array
    history: tuple[HistoryRow, ...]
    reason: str = ""  # Why nothing was found; empty if something was
    doubt: str = ""  # Why the posterior is not to be trusted; empty if it may be
    fit: Fit | None = None  # Trajectories and residuals, of method annealed
    details: dict[str, Any] = field(default_factory=dict)  # For the report
