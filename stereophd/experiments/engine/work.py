"""The plan of an experiment, and its unit of work: some runs of one method in one case, done by one process."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from stereophd.config.experiment import ExperimentConfig, Settings
from stereophd.config.loading import LoadedConfig, variant
from stereophd.core.numerics.random_streams import run_number
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Series, find_kind, method_seconds
from stereophd.pipeline.arithmetic import within_arithmetic

# Number of the "run" that computes the bounds of a case, and the name of its "method".
BOUND_RUN = -1
BOUND_METHOD = ""


@dataclass(frozen=True)
class Part:
    """One method in one case, as a configuration; the bounds of a case are a part without a method."""

    method: str
    case: str
    kind: str
    config: LoadedConfig


@dataclass(frozen=True)
class Chunk:
    """Runs of one part."""

    part: Part
    runs: tuple[int, ...]


@dataclass(frozen=True)
class RunResult:
    """A run; without series where no bound is known, or it failed."""

    method: str
    case: str
    run: int
    seed: int  # That of the table; 0 of bounds and of a run that gave nothing
    series: tuple[Series, ...]
    cpu_s: float  # Processor time of the method, s
    error: str | None = None  # What ended it, if anything did
    users: bool = False  # Whether the error is one of the configuration: the run would fail again


def run_chunk(chunk: Chunk) -> list[RunResult]:
    """Do the runs of a chunk; an error of one run leaves the others."""
    return [_run(chunk.part, run) for run in chunk.runs]


def _run(part: Part, run: int) -> RunResult:
    start = time.thread_time()
    seconds: list[float] = []
    series: Sequence[Series] = ()
    error, users = None, False
    try:
        kind = find_kind(part.kind)
        with method_seconds() as seconds, within_arithmetic(str(part.config.path)):
            series = kind.bounds(part.config) if run == BOUND_RUN else kind.run(part.config, run)
    except Exception as failure:  # any failure is reported, and the run tried again
        error, users = f"{type(failure).__name__}: {failure}", isinstance(failure, InputError)
        if users:
            error = str(failure)
    cpu_s = sum(seconds) if seconds else time.thread_time() - start
    seed = run_number(part.config.config.seed, run) if series and run != BOUND_RUN else 0
    return RunResult(part.method, part.case, run, seed, tuple(series), cpu_s, error, users)


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


def experiment_section(loaded: LoadedConfig) -> ExperimentConfig:
    """Return the section ``experiment``; InputError if there is none."""
    if loaded.config.experiment is None:
        raise InputError(f"{loaded.path}: experiment: expected a section `experiment`, found none")
    return loaded.config.experiment


def memory_of(parts: Sequence[Part]) -> float:
    """Return the memory that the largest run needs besides making its scene, bytes: an estimate."""
    return max((find_kind(part.kind).memory(part.config) for part in parts), default=0.0)


def plan_parts(loaded: LoadedConfig, settings: ExperimentConfig) -> list[Part]:
    """Return all parts: methods by cases, and the bounds of the cases; InputError for one that cannot be run."""
    parts = []
    methods: list[tuple[str, list[tuple[str, Settings]]]] = [
        (name, [(f"experiment.methods.{name}", own)]) for name, own in settings.methods.items()
    ]
    for method, changes in [*methods, (BOUND_METHOD, [])]:
        for case, _, own in cases_of(settings):
            config = variant(loaded, [*own, *changes])
            kind = experiment_section(config).scenario.kind
            if method != BOUND_METHOD:
                find_kind(kind).check(config)
            parts.append(Part(method, case, kind, config))
    return parts
