"""The plan of an experiment: methods by cases, and their configurations."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from stereophd.config.experiment import ExperimentConfig, Settings
from stereophd.config.loading import LoadedConfig, variant
from stereophd.experiments.engine.base import find_kind
from stereophd.experiments.engine.work import BOUND_METHOD, Part


def cases_of(settings: ExperimentConfig) -> list[tuple[str, tuple[str, ...], list[tuple[str, Settings]]]]:
    """Return the cases: name, name of the value along each axis, and what they set (and where it is written)."""
    axes = [(axis, config.points()) for axis, config in settings.cases.items()]
    cases = []
    for point in product(*(points for _, points in axes)):
        names = tuple(name for name, _ in point)
        text = ", ".join(f"{axis} {name}" for (axis, _), name in zip(axes, names, strict=True)) or "all"
        changes = [(f"experiment.cases.{axis}", own) for (axis, _), (_, own) in zip(axes, point, strict=True)]
        cases.append((text, names, changes))
    return cases


def check_experiment(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless every method in every case of the ``experiment`` section, if any, can be run."""
    if loaded.config.experiment is not None:
        plan_parts(loaded, loaded.config.experiment)


def memory_of(parts: Sequence[Part]) -> float:
    """Return the memory that the largest run needs besides making its scene, bytes: an estimate."""
    return max((find_kind(part.kind).memory(part.config) for part in parts), default=0.0)


def plan_parts(loaded: LoadedConfig, settings: ExperimentConfig) -> list[Part]:
    """Return all parts, and check their configurations: methods by cases, and the bounds of the cases."""
    parts = []
    methods: list[tuple[str, list[tuple[str, Settings]]]] = [
        (name, [(f"experiment.methods.{name}", own)]) for name, own in settings.methods.items()
    ]
    for method, changes in [*methods, (BOUND_METHOD, [])]:
        for case, _, own in cases_of(settings):
            config = variant(loaded, [*own, *changes])
            assert config.config.experiment is not None
            kind = config.config.experiment.scenario.kind
            if method != BOUND_METHOD:
                find_kind(kind).check(config)
            parts.append(Part(method, case, kind, config))
    return parts
