"""From settings to an estimator."""

from __future__ import annotations

import numpy as np

from stereophd.disparity.events import Rig
from stereophd.disparity.initial import InitialPrior
from stereophd.disparity.samples import SampleSets
from stereophd.motion import Motion
from stereophd.single.base import AnyEstimator
from stereophd.single.settings import EstimatorSettings


def build_estimator(
    settings: EstimatorSettings,
    rig: Rig,
    motion: Motion,
    prior: InitialPrior,
    rng: np.random.Generator,
    sets: SampleSets | None = None,
) -> AnyEstimator:
    """Return the estimator that the settings describe.

    Parameters
    ----------
    settings : EstimatorSettings
    rig : Rig
        The cameras.
    motion : Motion
    prior : InitialPrior
    rng : Generator
        Source of all randomness of the estimator. Low-discrepancy points are the same whatever it is
        (they are a rule, not draws); pseudo-random samples and particles are drawn from it.
    sets : SampleSets, optional
        Samples of the moves between disparity spaces, in place of those that the settings name.

    Raises
    ------
    ValueError
        If the estimator cannot work with these cameras (Algorithm 1 with cameras that are not rectified).
    """
    raise NotImplementedError
