"""The one filter loop: a detection log in, tracks out, event by event.

Memory does not depend on the length of the log: frames are read as they come, and estimates are
written as they are made (smoothing, which needs the whole run, holds it in memory).
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereophd.config import Config
from stereophd.config_filter import BirthConfig, MotionConfig, PhdConfig, PmbConfig, RegionConfig
from stereophd.config_report import CameraTimes, GridTimes, ReportConfig
from stereophd.config_single import SingleConfig
from stereophd.disparity.samples import draw_sample_sets
from stereophd.errors import InputError
from stereophd.io.atomic import OutputFolder
from stereophd.io.log_checks import KINDS
from stereophd.io.logs import LogReader
from stereophd.io.provenance import provenance, to_metadata
from stereophd.io.tables import SCANS, TRACKS, TableWriter
from stereophd.motion import ConstantVelocity, Motion, Static
from stereophd.multi.base import DisparityFilter
from stereophd.multi.birth import BirthPrior
from stereophd.multi.events import make_rig
from stereophd.multi.extract import Hysteresis
from stereophd.multi.phd import PhdFilter, PhdSettings
from stereophd.multi.pmb import PmbFilter, PmbSettings
from stereophd.track_detectors import estimate_detectors
from stereophd.track_output import smoothed_records, write_records
from stereophd.track_run import Progress, Record, ReportTimes, run_filter
from stereophd.track_single import build_single, run_single

if TYPE_CHECKING:
    from stereophd.config_loading import LoadedConfig
    from stereophd.geometry.camera import Camera

FILES = ("tracks.parquet", "scans.parquet", "report.json")
REPORT_VERSION = 1

LOGGER = logging.getLogger("stereophd")


def track(
    loaded: LoadedConfig,
    log_path: Path | str,
    out_dir: Path | str,
    force: bool = False,
    threads: int = 1,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Track the objects of a detection log.

    Parameters
    ----------
    loaded : LoadedConfig
        With a ``filter`` section and cameras.
    log_path : path
        Detection log.
    out_dir : path
        Folder for ``tracks.parquet``, ``scans.parquet`` and ``report.json``; all or none is written.
    force : bool
        Whether the outputs of an earlier run may be replaced.
    threads : int
        Threads of the sample trips; the outputs do not depend on it.
    progress : callable, optional
        Called with the rows done and their total.

    Returns
    -------
    dict
        The report, as in ``report.json``.

    Raises
    ------
    InputError
        The configuration has no filter or no cameras; the log is not usable; the output folder is not
        ours or cannot be written.
    """
    config = loaded.config
    cameras = loaded.build_cameras()
    motion, run = _prepare(config, cameras, loaded.path, threads)
    estimated = [name for name, c in loaded.cameras.items() if c.detector.estimate or config.detector == "estimate"]
    if estimated and isinstance(config.filter, SingleConfig):
        raise InputError(f"{loaded.path}: detector: expected given where filter.kind is single, found estimate")
    rolling = [camera for camera in cameras if camera.readout_s != 0.0]
    if rolling and isinstance(config.filter, SingleConfig):
        where = f"{loaded.path}: cameras.{rolling[0].name}.readout_s"
        raise InputError(f"{where}: expected 0 where filter.kind is single, found {rolling[0].readout_s:g}")
    LOGGER.info("configuration %s, sha256 %s, seed %d", loaded.path, loaded.sha256, config.seed)
    _announce_compilation()
    reader = LogReader(log_path, cameras, config.input.on_bad_row, config.input.image_margin_px)
    with OutputFolder(out_dir, FILES, force) as out:
        detectors = None
        if estimated:
            cameras, detectors = estimate_detectors(
                cameras, estimated, lambda found: _labelled_filter(config, found, loaded.path, threads),
                lambda: LogReader(log_path, cameras, config.input.on_bad_row, config.input.image_margin_px),
                progress,
            )  # fmt: skip
            motion, run = _prepare(config, cameras, loaded.path, threads)
        record = provenance("track", loaded, inputs={"detections": log_path})
        metadata = to_metadata(record)
        with (
            TableWriter(out.path("tracks.parquet"), TRACKS, metadata) as tracks,
            TableWriter(out.path("scans.parquet"), SCANS, metadata) as scans,
        ):
            unusable = [0]
            records = run(reader, report_times(config.report), unusable, progress)
            if config.report.smooth is not None:
                records = smoothed_records(records, cameras, motion, config.report.smooth.max_gap_s)
            names = [camera.name for camera in cameras]
            summary = write_records(records, tracks, scans, names, config.report.max_position_std)
        report = {
            "report_version": REPORT_VERSION,
            "length_unit": config.units.length,
            "input": {**reader.counts, "not_invertible": unusable[0]},
            "detectors": detectors,
            **summary,
            "provenance": record,
        }
        text = json.dumps(report, indent=2, allow_nan=False) + "\n"
        out.path("report.json").write_text(text, encoding="utf-8")
    _warn_of_losses(reader, log_path, cameras, unusable[0])
    return report


def _announce_compilation() -> None:
    """Say that the kernels are compiled first, where no compiled ones are found."""
    folder = Path(__file__).parent / "disparity" / "__pycache__"
    if not any(folder.glob("move_kernels.carry_components-*.nbi")):
        LOGGER.info("first run: compiling the kernels, once, in about a minute")


def _warn_of_losses(reader: LogReader, log_path: Path | str, cameras: tuple[Camera, ...], unusable: int) -> None:
    """Say what of the log did not reach the filter, and which cameras said nothing."""
    counts = reader.counts
    LOGGER.info("%s: %d frames, %d detections", log_path, counts["frames"], counts["detections"])
    dropped = {kind: counts[kind] for kind in KINDS if counts.get(kind)}
    if dropped:
        why = ", ".join(f"{kind} {count}" for kind, count in dropped.items())
        LOGGER.warning("%s: %d of %d rows dropped (%s)", log_path, sum(dropped.values()), counts["rows"], why)
    if unusable:
        LOGGER.warning("%s: %d detections lie where the lens model cannot be inverted: left out", log_path, unusable)
    if counts.get("cameras_without_frames"):
        LOGGER.warning(
            "%s: no frames of %d of the %d cameras: %s",
            log_path,
            len(reader.silent_cameras),
            len(cameras),
            ", ".join(reader.silent_cameras),
        )


def _prepare(
    config: Config, cameras: tuple[Camera, ...], path: Path | str, threads: int
) -> tuple[Motion, Callable[[LogReader, ReportTimes, list[int], Progress | None], Iterator[Record]]]:
    """Return the motion model, and what runs the filter or the single-object estimator over a log."""
    if isinstance(config.filter, SingleConfig):
        motion, point = build_motion(config.motion), config.filter.point
        estimator = build_single(config, motion, cameras, path)
        return motion, partial(run_single, estimator, point)
    multi_filter = build_filter(config, cameras, path, threads)
    keep_events = config.report.smooth is not None
    return multi_filter.motion, partial(run_filter, multi_filter, keep_events=keep_events)


def build_filter(config: Config, cameras: tuple[Camera, ...], path: Path | str, threads: int = 1) -> DisparityFilter:
    """Return the multi-object filter that a configuration describes.

    Raises
    ------
    InputError
        The configuration (read from `path`) has no ``filter`` section, or not one for many objects.
    """
    settings = config.filter
    if settings is None:
        raise InputError(f"{path}: filter: expected a filter section for track, found none")
    if isinstance(settings, SingleConfig):
        raise InputError(f"{path}: filter.kind: expected a filter for many objects, found single")
    motion = build_motion(config.motion)
    rows = 3 if isinstance(motion, Static) else 12
    # spawned by purpose: the simulation's random numbers have keys of their own
    seed = np.random.SeedSequence(config.seed, spawn_key=(SAMPLES_KEY,))
    moments = config.moments
    sets = draw_sample_sets(moments.method, moments.samples, rows, seed, moments.max_nonlinearity)
    rig = make_rig(cameras, config.disparity.baseline, config.disparity.rectification, build_region(config.region))
    birth = _birth_prior(settings.birth)
    _check_birth_rate(settings, cameras, path)
    hysteresis = Hysteresis(settings.extraction.confirm, settings.extraction.release)
    if isinstance(settings, PmbConfig):
        pmb = PmbSettings(
            survival_per_s=settings.survival_per_s,
            birth=birth,
            recycle_below=settings.recycle_below,
            prune_weight=settings.prune_weight,
            merge_distance=settings.merge_distance,
            max_components=settings.max_components,
            hypothesis_distance=settings.hypothesis_distance,
            least_share=settings.least_share,
            split_missed=settings.missed == "split",
            hysteresis=hysteresis,
        )
        return PmbFilter(rig, motion, sets, pmb, threads)
    phd = PhdSettings(
        survival_per_s=settings.survival_per_s,
        birth=birth,
        prune_weight=settings.prune_weight,
        merge_distance=settings.merge_distance,
        merge_mutual=settings.merge_rule == "mutual",
        split_missed=settings.missed == "split",
        max_components=settings.max_components,
        hysteresis=hysteresis,
    )
    return PhdFilter(rig, motion, sets, phd, threads)


def _labelled_filter(config: Config, cameras: tuple[Camera, ...], path: Path | str, threads: int) -> DisparityFilter:
    """Return a filter with labelled tracks, whatever kind the configuration has."""
    settings = config.filter
    if isinstance(settings, PhdConfig):
        labelled = PmbConfig(kind="pmb", survival_per_s=settings.survival_per_s, birth=settings.birth)
        config = config.model_copy(update={"filter": labelled})
    return build_filter(config, cameras, path, threads)


# Key of the filter's sample sets among the purposes of a seed (simulated runs count from 0).
SAMPLES_KEY = 2**31


def _check_birth_rate(settings: PhdConfig | PmbConfig, cameras: tuple[Camera, ...], path: Path | str) -> None:
    """Refuse births so rare that every newborn component would be dropped at once."""
    for camera in cameras:
        born = camera.detector.p_detect * settings.birth.per_frame
        existence = born / (born + camera.detector.clutter_per_frame)
        if existence < settings.prune_weight:
            raise InputError(
                f"{path}: filter.birth.per_frame: expected births that outlive prune_weight "
                f"{settings.prune_weight:g}, found {settings.birth.per_frame:g}: beside the clutter of "
                f"{camera.name} a newborn weighs {existence:.2g}"
            )


def report_times(config: ReportConfig) -> ReportTimes:
    """Return when estimates are reported."""
    times = config.times
    return ReportTimes(
        times.camera if isinstance(times, CameraTimes) else None, times.grid if isinstance(times, GridTimes) else None
    )


def build_motion(config: MotionConfig) -> Motion:
    """Return the motion model of a configuration."""
    if config.model == "static":
        return Static()
    std = np.broadcast_to(np.asarray(config.acceleration_std, dtype=float), 3)
    return ConstantVelocity(std, config.max_speed)


def build_region(config: RegionConfig | None) -> NDArray[np.float64] | None:
    """Return the packed region (8,) of a configuration, infinite where it sets no limit."""
    if config is None:
        return None
    limits = np.tile([-np.inf, np.inf], 4)
    if config.box is not None:
        limits[:6] = [*config.box.x, *config.box.y, *config.box.z]
    if config.depth is not None:
        limits[6:] = config.depth
    return limits


def _birth_prior(config: BirthConfig) -> BirthPrior:
    prior = config.disparity
    disparity = None if prior is None else (prior.mean_px, prior.std_px)
    return BirthPrior(config.per_frame, disparity, config.depth_range, config.velocity_std)
