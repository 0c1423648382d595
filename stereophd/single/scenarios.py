"""One Monte Carlo run of a single-object experiment: draw the truth and its detections, estimate, compare.

The data of a run are drawn first and depend on the scenario and the generator alone: estimators that are
given generators of the same seed see the same detections.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.disparity.events import Rig
from stereophd.disparity.initial import InitialPrior
from stereophd.motion import Motion
from stereophd.single.settings import EstimatorSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocalisationScenario:
    """A static object observed by one camera after another (paper VIII-A).

    Attributes
    ----------
    rig : Rig
    position : array (3,)
        The object, in the world.
    prior : InitialPrior
        Of the disparity in the camera that sees the object first.
    sequence : tuple of int
        Camera (index in the rig) of each observation.
    """

    rig: Rig
    position: Array
    prior: InitialPrior
    sequence: tuple[int, ...]


@dataclass(frozen=True)
class LocalisationRun:
    """Errors (estimate minus truth) after each observation of a run, length.

    Attributes
    ----------
    map_errors, mean_errors : arrays (k, 3)
        Of the estimate of greatest density, and of the mean; NaN where there is none.
    covariances : array (k, 3, 3)
        That the estimator states.
    """

    map_errors: Array
    mean_errors: Array
    covariances: Array


def localisation_run(
    scenario: LocalisationScenario, settings: EstimatorSettings, rng: np.random.Generator
) -> LocalisationRun:
    """Draw one observation for each entry of the sequence, estimate, and compare after each.

    Raises
    ------
    ValueError
        If the object is not in view of a camera that should observe it.
    """
    raise NotImplementedError


def localisation_bound(scenario: LocalisationScenario, with_prior: bool) -> Array:
    """Cramer-Rao bound on the covariance of the position (k, 3, 3) after each observation, length^2.

    Infinite where the observations so far (and the prior, if it is counted) do not determine the position.
    `stereophd.metrics.bounds.mean_error_norm` gives the mean length of an error with such a covariance.
    """
    raise NotImplementedError


@dataclass(frozen=True)
class TrackingScenario:
    """A moving object observed by several cameras (paper VIII-B).

    Attributes
    ----------
    rig : Rig
    start : array (6,)
        State at the first event, in the world.
    motion : Motion
        Of the object, and of the estimators' model.
    prior : InitialPrior
        Of disparity in the camera that sees the object first, and of velocity.
    times : array (k,)
        Times of the events, s, not decreasing.
    cameras : array (k,) of int
        Camera of each event.
    """

    rig: Rig
    start: Array
    motion: Motion
    prior: InitialPrior
    times: Array
    cameras: NDArray[np.int64]


@dataclass(frozen=True)
class TrackingRun:
    """Errors (estimate minus truth) of a run, after the last event of each distinct time.

    Attributes
    ----------
    times : array (t,)
        Distinct times, s.
    map_errors, mean_errors : arrays (t, 6)
        Position and velocity, length and length/s; NaN where there is no estimate.
    covariances : array (t, 6, 6)
        That the estimator states.
    """

    times: Array
    map_errors: Array
    mean_errors: Array
    covariances: Array


def tracking_run(scenario: TrackingScenario, settings: EstimatorSettings, rng: np.random.Generator) -> TrackingRun:
    """Draw a trajectory and its detections (where in view, with each detector's p_detect), and track it."""
    raise NotImplementedError


def tracking_bound(scenario: TrackingScenario, rng: np.random.Generator, trajectories: int = 100) -> Array:
    """Posterior Cramer-Rao bound (t, 6, 6) on the covariance of the state at each distinct time.

    The expected information of the detections is averaged over drawn trajectories.
    """
    raise NotImplementedError
