"""The filters of a configuration as calibration uses them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stereophd.config.model import Config
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.multi.filter_settings.phd import PhdSettings
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.multi.pmb.filter import PmbFilter
from stereophd.core.numerics.samples import MomentsSettings
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.pipeline.build import build_filter

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig


def pmb_filter(loaded: LoadedConfig, cameras: tuple[Camera, ...]) -> PmbFilter:
    """Return the PMB filter of a configuration; of a PHD configuration, one with the same births and survival."""
    config = loaded.config
    settings = _filter_section(loaded)
    if not isinstance(settings, PmbSettings):
        settings = PmbSettings(survival_per_s=settings.survival_per_s, birth=settings.birth)
    built = build_filter(config.model_copy(update={"filter": settings}), cameras, loaded.path)
    assert isinstance(built, PmbFilter)
    return built


def phd_filter(loaded: LoadedConfig, cameras: tuple[Camera, ...], samples: int | None = None) -> PhdFilter:
    """Return the PHD filter of a configuration, with `samples` pseudo-random samples (default: the configuration's).

    For a PMB configuration it is the paper's filter, with the same births and survival.
    """
    config: Config = loaded.config
    settings = _filter_section(loaded)
    if not isinstance(settings, PhdSettings):
        settings = PhdSettings(survival_per_s=settings.survival_per_s, birth=settings.birth, merge_moments="intensity")
    update: dict[str, object] = {"filter": settings}
    if samples is not None:
        update["moments"] = MomentsSettings(method="particle", samples=samples)
    built = build_filter(config.model_copy(update=update), cameras, loaded.path)
    assert isinstance(built, PhdFilter)
    return built


def _filter_section(loaded: LoadedConfig) -> FilterSettings:
    if loaded.config.filter is None:
        raise InputError(f"{loaded.path}: filter: expected a filter section for calibrate, found none")
    if isinstance(loaded.config.filter, SingleSettings):
        raise InputError(
            f"{loaded.path}: filter.kind: expected phd or pmb for calibrate, found {loaded.config.filter.kind}"
        )
    return loaded.config.filter
