"""Domain objects from a configuration: filters, motion models, regions, times of reports."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereophd.config.model import Config
from stereophd.config.report import CameraTimes, GridTimes, ReportConfig
from stereophd.config.tracking import RegionConfig
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.disparity.events import make_rig
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.births.undetected import LEAST_PRUNING
from stereophd.core.multi.build import make_filter
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.multi.filter_settings.phd import PhdSettings
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.numerics.random_streams import FILTER_SAMPLES
from stereophd.core.numerics.samples import draw_sample_sets
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.pipeline.tracking.loop import Estimator, ReportTimes

if TYPE_CHECKING:
    from stereophd.core.bodies.filter import BodyFilter


def build_motion(config: Config, path: Path | str) -> Motion:
    """Motion model of a configuration, read from `path`; InputError if objects move at no stated acceleration."""
    try:
        return config.motion.build()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def build_filter(config: Config, cameras: tuple[Camera, ...], path: Path | str, threads: int = 1) -> DisparityFilter:
    """Return the filter for many objects of a configuration, read from `path`; raises InputError if it has none."""
    settings = config.filter
    if settings is None:
        raise InputError(f"{path}: filter: expected a filter section, found none")
    if isinstance(settings, SingleSettings):
        raise InputError(f"{path}: filter.kind: expected a filter for many objects (pmb or phd), found single")
    if config.object.shape != "point":
        raise InputError(f"{path}: object.shape: expected point (only track takes boxes), found {config.object.shape}")
    motion = build_motion(config, path)
    seed = FILTER_SAMPLES.seed(config.seed)
    moments = config.moments
    sets = draw_sample_sets(moments.method, moments.samples, motion.sample_rows, seed, moments.max_nonlinearity)
    rig = make_rig(
        cameras,
        config.disparity.baseline,
        config.disparity.rectification,
        None if config.region is None else config.region.packed(),
    )
    _check_birth_rate(settings, cameras, path)
    return make_filter(settings, rig, motion, sets, threads)


def build_bodies(config: Config, cameras: tuple[Camera, ...], path: Path | str) -> BodyFilter:
    """Return the filter of bodies that a configuration describes.

    Raises InputError unless the filter is `pmb`, objects move and no camera has a rolling shutter.
    """
    from stereophd.core.bodies.filter import BodyFilter  # needs parts of SciPy that are costly to import

    where, shape = "where object.shape is ellipsoid", config.object
    assert isinstance(shape, EllipsoidSettings)
    if not isinstance(config.filter, PmbSettings):
        kind = "none" if config.filter is None else config.filter.kind
        raise InputError(f"{path}: filter.kind: expected pmb {where}, found {kind}")
    motion = build_motion(config, path)
    if not motion.moves:
        raise InputError(f"{path}: motion.model: expected one whose objects move {where}, found {config.motion.model}")
    for camera in cameras:
        if camera.readout_s != 0.0:
            raise InputError(f"{path}: cameras.{camera.name}.readout_s: expected 0 {where}, found {camera.readout_s:g}")
    region = None if config.region is None else config.region.packed()
    rig = make_rig(cameras, config.disparity.baseline, config.disparity.rectification, region)
    return BodyFilter(rig, motion, shape, config.filter)


def build_labelled_filter(
    config: Config, cameras: tuple[Camera, ...], path: Path | str, threads: int
) -> Estimator[Any]:
    """Return a filter with labelled tracks for any kind of filter in the configuration."""
    if isinstance(config.object, EllipsoidSettings):
        return build_bodies(config, cameras, path)
    if isinstance(config.filter, PhdSettings):
        config = with_filter(config, PmbSettings)
    return build_filter(config, cameras, path, threads)


def with_filter(config: Config, kind: type[FilterSettings], **others: Any) -> Config:
    """Return a configuration whose filter for many objects is of a kind, with its births and survival."""
    settings = config.filter
    if not isinstance(settings, FilterSettings) or isinstance(settings, kind):
        return config
    made = kind(survival_per_s=settings.survival_per_s, birth=settings.birth, **others)
    return config.model_copy(update={"filter": made})


def _check_birth_rate(settings: FilterSettings, cameras: tuple[Camera, ...], path: Path | str) -> None:
    """Refuse births so rare that every newborn component would be dropped at once."""
    rate = settings.birth.per_s
    for camera in cameras:
        born = camera.detector.p_detect * rate
        existence = born / (born + camera.detector.expected_clutter)
        if existence < LEAST_PRUNING * settings.prune_weight:
            raise InputError(
                f"{path}: filter.birth.per_s: expected births that outlive prune_weight "
                f"{settings.prune_weight:g}, found {rate:g}: with the clutter of "
                f"{camera.name} a newborn weighs {existence:.2g}"
            )


def report_times(config: ReportConfig, region: RegionConfig | None = None) -> ReportTimes:
    """Return when estimates are reported."""
    times = config.times
    return ReportTimes(
        times.camera if isinstance(times, CameraTimes) else None,
        times.grid if isinstance(times, GridTimes) else None,
        config.max_position_std,
        whole_run=config.smooth is not None,
        region=None if region is None or region.polygon is None else region.polygon.half_spaces(),
    )
