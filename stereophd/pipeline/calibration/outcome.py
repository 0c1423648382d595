"""Results of a calibration method."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.track_moves import TrackMoves
from stereophd.core.calibration.annealing.control import World
from stereophd.core.calibration.annealing.method import HistoryRow, Remark
from stereophd.core.calibration.annealing.task import Fit
from stereophd.core.calibration.unknowns.parameters import ParameterSet


@dataclass(frozen=True)
class Outcome:
    """The result of a method."""

    parameters: ParameterSet  # The unknowns of the result: those of the problem, and what was contradicted and freed
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
    remarks: tuple[Remark, ...] = ()  # What has to be said of the answer
    moves: TrackMoves | None = None  # How tracks move with the values, of method annealed
    world: World | None = None  # That of the control track
    details: dict[str, Any] = field(default_factory=dict)  # For the report
