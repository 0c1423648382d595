"""What a bundle adjustment works on: detections that belong to trajectories, a loss, and the problem as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment import normal_equations
from stereophd.core.calibration.adjustment.trajectories import Knots
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.rows import ArrayRows


@dataclass(frozen=True)
class Observations(ArrayRows):
    """Detections that belong to trajectories."""

    # `trajectories`, `cameras`: arrays (n,) of int
    trajectories: Integers
    cameras: Integers
    times: Array  # (n,): True times by the clocks and readouts of the prior mean, s
    # `points`, `precisions`: arrays (n, 2), (n, 2, 2): Raw pixels and their inverse covariances.
    points: Array
    precisions: Array
    log_times: Array  # (n,): Times of the frames on the cameras' own clocks, s
    rows: Array  # (n,): Row of each detection over the height of the image
    # (n,), optional: What each detection counts, in measurements of its precision (`adjustment.noise`);
    # default 1.
    weights: Array | None = None

    def __len__(self) -> int:
        return len(self.times)


@dataclass(frozen=True)
class Loss:
    """Robust loss: ``squared``, ``cauchy`` (scale in sigmas) or ``floor`` (height relative to a peak of 1)."""

    kind: int
    scale: float


SQUARED = Loss(normal_equations.SQUARED, 1.0)


@dataclass(frozen=True)
class Problem:
    """What is adjusted."""

    parameters: ParameterSet
    reference: int  # Index of the reference camera
    knots: Knots
    observations: Observations
    loss: Loss
    scale: ScaleMeasurement | None = None
    # (m,) of bool, optional: Values that stay where the adjustment starts; default none.
    held: NDArray[np.bool_] | None = None

    def weights(self, distances: Array) -> Array:
        """Weights (n,) that the loss gives detections at squared distances (n,), times those that they have."""
        scale = self.loss.scale
        if self.loss.kind == normal_equations.FLOOR:
            peak = np.exp(-0.5 * distances)
            weights = peak / (peak + scale)
        elif self.loss.kind == normal_equations.CAUCHY:
            weights = 1.0 / (1.0 + distances / scale**2)
        else:
            weights = np.ones(len(distances))
        return weights if self.observations.weights is None else weights * self.observations.weights

    def weighted(self, weights: Array) -> Self:
        """Return the problem of least squares in which detections have the given weights (n,)."""
        return replace(self, loss=SQUARED, observations=replace(self.observations, weights=weights))


def true_times(cameras: Sequence[Camera], observations: Observations) -> Array:
    """True times (n,) of detections by the clocks and readouts of cameras, s."""
    times = np.empty(len(observations))
    for number, camera in enumerate(cameras):
        here = observations.cameras == number
        times[here] = camera.clock.to_true(observations.log_times[here]) + camera.readout_s * observations.rows[here]
    return times
