"""Shared parts of the scenarios of one object: the section they need, and errors and bounds as series."""

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.bounds.cramer_rao import mean_error_norm
from stereophd.core.disparity.events import Rig, make_rig
from stereophd.core.metrics.errors import nees
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Series

# Memory of an observation, bytes (measured).
OBSERVATION_BYTES = 5e3


def single_config(loaded: LoadedConfig) -> SingleSettings:
    """Return the section ``filter``, or raise InputError if it is not of kind single."""
    settings = loaded.config.filter
    if not isinstance(settings, SingleSettings):
        found = "none" if settings is None else settings.kind
        raise InputError(f"{loaded.path}: filter: expected a filter of kind single for one object, found {found}")
    return settings


def rig_of(loaded: LoadedConfig) -> Rig:
    """Return the cameras with their disparity spaces."""
    config = loaded.config
    return make_rig(loaded.build_cameras(), config.disparity.baseline, config.disparity.rectification)


def series_of_errors(
    name: str, unit: str, times_s: Array, errors: Array, covariances: Array, consistent: Array
) -> list[Series]:
    """Return the length of errors (k, d) of the reported estimate over time (k,), and the NEES about the mean.

    `covariances` (k, d, d) are those that the estimator states, `consistent` (k, d) the errors of the mean that they
    are about. `name` is ``position``, say.
    """
    lengths = np.linalg.norm(errors, axis=1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # particles that (almost) sit in one place
        normalised = nees(consistent, covariances)
    return [Series(f"{name}_error", unit, lengths, times_s), Series(f"{name}_nees", "1", normalised, times_s)]


def bounds_of(name: str, unit: str, times_s: Array, covariances: Array) -> list[Series]:
    """Return the bounds of the mean and of the root mean square of errors whose least covariances are (k, d, d)."""
    means = np.array([mean_error_norm(one) for one in covariances])
    roots = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    return [Series(f"{name}_error", unit, means, times_s), Series(f"{name}_rmse", unit, roots, times_s)]


def last_of(series: Series, name: str) -> Series:
    """Return the last value of a series as one of the whole run."""
    return Series(name, series.unit, series.values[-1:])
