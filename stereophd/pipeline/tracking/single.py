"""`track` for one object without clutter (``filter.kind: single``): one track, number 0."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from stereophd.config.model import Config
from stereophd.config.single import (
    CartesianEstimatorConfig,
    InverseDepthEstimatorConfig,
    ParticleEstimatorConfig,
    RectifiedEstimatorConfig,
    SingleConfig,
    SinglePriorConfig,
)
from stereophd.core.disparity.events import make_event, make_rig
from stereophd.core.disparity.initial import InitialPrior
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.models import ConstantVelocity, Motion
from stereophd.core.multi.estimates import Estimates, Info
from stereophd.core.single.base import AnyEstimator, SingleEstimate, SingleInfo, SingleState
from stereophd.core.single.build import build_estimator
from stereophd.core.single.settings import (
    CartesianSettings,
    DisparitySettings,
    EstimatorSettings,
    InverseDepthSettings,
    ParticleSettings,
)
from stereophd.errors import InputError
from stereophd.io.logs import Frame, LogReader
from stereophd.pipeline.tracking.loop import PROGRESS_EVERY, Progress, Record, ReportTimes, grid_times, same_time

# The object's identity in ``tracks.parquet``.
TRACK = np.zeros(1, dtype=np.int64)
NOTHING = Estimates(TRACK[:0], np.empty((0, 6)), np.empty((0, 6, 6)), np.empty(0), TRACK[:0])

# Key of the estimator's random numbers among the purposes of a seed (`stereophd.commands.track.SAMPLES_KEY` is 2^31).
ESTIMATOR_KEY = 2**31 + 1


def estimator_settings(config: Config) -> EstimatorSettings:
    """Return the settings of the single-object estimator that a configuration (``filter.kind: single``) names."""
    assert isinstance(config.filter, SingleConfig)
    chosen = config.filter.estimator
    if isinstance(chosen, ParticleEstimatorConfig):
        return ParticleSettings(**chosen.model_dump(exclude={"kind"}))
    if isinstance(chosen, InverseDepthEstimatorConfig):
        return InverseDepthSettings()
    if isinstance(chosen, CartesianEstimatorConfig):
        return CartesianSettings(chosen.rule)
    rectified = isinstance(chosen, RectifiedEstimatorConfig)
    return DisparitySettings(config.moments.method, config.moments.samples, rectified, config.moments.max_nonlinearity)


def initial_prior(config: SinglePriorConfig) -> InitialPrior:
    """Return the prior that a configuration describes."""
    disparity = None if config.disparity is None else (config.disparity.mean_px, config.disparity.std_px)
    return InitialPrior(disparity, config.depth_range, config.velocity_std or 0.0, config.disparity_velocity_std_px_s)


def build_single(config: Config, motion: Motion, cameras: tuple[Camera, ...], path: Path | str) -> AnyEstimator:
    """Return the single-object estimator that a configuration describes.

    Raises
    ------
    InputError
        The configuration (read from `path`) has no prior of the velocity of a moving object; or its cameras are
        not rectified, and its estimator needs them to be.
    """
    assert isinstance(config.filter, SingleConfig)
    prior = config.filter.prior
    no_velocity = prior.velocity_std is None and prior.disparity_velocity_std_px_s is None
    if isinstance(motion, ConstantVelocity) and no_velocity:
        raise InputError(f"{path}: filter.prior: expected velocity_std, found none (motion.model is not static)")
    rig = make_rig(cameras, config.disparity.baseline, config.disparity.rectification)
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(ESTIMATOR_KEY,)))
    try:
        return build_estimator(estimator_settings(config), rig, motion, initial_prior(prior), rng)
    except ValueError as error:
        raise InputError(f"{path}: filter.estimator: {error}") from None


def run_single(
    estimator: AnyEstimator,
    point: Literal["mean", "map"],
    reader: LogReader,
    times: ReportTimes,
    unusable: list[int],
    progress: Progress | None = None,
) -> Iterator[Record]:
    """Run an estimator over a log, as `stereophd.pipeline.tracking.loop.run_filter` runs a filter.

    Parameters
    ----------
    estimator : SingleEstimator
    point : {"mean", "map"}
        The estimate that is reported.
    reader : LogReader
        Made with the estimator's cameras.
    times : ReportTimes
    unusable : list of one int
        Raised by the number of detections that have no undistorted place.
    progress : callable, optional

    Raises
    ------
    InputError
        A frame has several detections.
    """
    state: SingleState = estimator.init()
    known = False
    last: Record | None = None
    for number, frame in enumerate(reader):
        if last is not None:
            until_s = frame.time_s - same_time(frame.time_s)
            yield from _predictions(estimator, point, state, last, times.grid_s, until_s)
        camera = estimator.rig.cameras[frame.camera]
        _check_frame(frame, camera, reader)
        frozen = camera if camera.pose.is_static else camera.at(frame.time_s)
        event = make_event(frozen, frame.camera, frame.time_s, frame.pixels, frame.sigma)
        unusable[0] += len(frame.pixels) - len(event.points)
        first_label = int(known)
        state, info = estimator.step(state, event)
        estimate = estimator.estimate(state)
        known = estimate is not None
        attributed = {0: {camera.name: 1}} if len(event.points) else {}
        last = Record(
            frame.time_s, camera.name, frame.frame, len(event.points), first_label, _info(info, estimate),
            _estimates(estimate, point), attributed, times.after(camera.name),
        )  # fmt: skip
        yield last
        if number % PROGRESS_EVERY == 0 and progress is not None:
            progress(reader.counts["rows"], reader.num_rows)
    if last is not None:
        yield from _predictions(estimator, point, state, last, times.grid_s, last.time_s + same_time(last.time_s))
    if progress is not None:
        progress(reader.num_rows, reader.num_rows)


def _check_frame(frame: Frame, camera: Camera, reader: LogReader) -> None:
    if len(frame.pixels) > 1:
        raise InputError(
            f"{reader.path}: frame {frame.frame} of {camera.name} at {frame.time_s:g} s: expected at most one "
            f"detection (filter.kind is single), found {len(frame.pixels)}"
        )


def _predictions(
    estimator: AnyEstimator,
    point: Literal["mean", "map"],
    state: SingleState,
    last: Record,
    grid_s: float | None,
    until_s: float,
) -> Iterator[Record]:
    """Yield the object after an event at the times of the grid before `until_s`."""
    if grid_s is None:
        return
    for time_s in grid_times(grid_s, last.time_s - same_time(last.time_s), until_s):
        estimate = estimator.estimate(estimator.at(state, time_s))
        info = _info(SingleInfo(0.0, 0.0), estimate)
        yield Record(
            time_s, last.camera, last.frame, 0, 1, info, _estimates(estimate, point), reported=True, is_event=False
        )


def _info(info: SingleInfo, estimate: SingleEstimate | None) -> Info:
    known = int(estimate is not None)
    return Info(info.log_likelihood, float(known), known)


def _estimates(estimate: SingleEstimate | None, point: Literal["mean", "map"]) -> Estimates:
    """Reported object: none before its first detection, and while it is at or beyond infinity."""
    if estimate is None:
        return NOTHING
    state = estimate.mean if point == "mean" else estimate.map
    if not (np.isfinite(state).all() and np.isfinite(estimate.covariance).all()):
        return NOTHING
    return Estimates(TRACK, state[None], estimate.covariance[None], np.ones(1), TRACK)
