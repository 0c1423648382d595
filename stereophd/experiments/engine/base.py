"""A kind of scenario: one run of it, and the bound that no method can beat."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from importlib import import_module
from typing import TypeVar

from stereophd.config.loading import LoadedConfig
from stereophd.config.model import Config
from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.simulation.detections import SimulatedFrame
from stereophd.io.logs.reading import Frame

Scenario = TypeVar("Scenario")


@dataclass(frozen=True)
class Series:
    """Values of one quantity in one run."""

    quantity: str  # Its name. A quantity ``X_error`` also gives its root mean square over the runs, ``X_rmse``.
    unit: str  # Its unit, ``1`` for plain numbers
    values: Array  # (k,): NaN where it is not defined: left out of means
    times_s: Array | None = None  # (k,) or None: Their times, s; None: one value that belongs to the whole run

    def __post_init__(self) -> None:
        count = 1 if self.times_s is None else len(self.times_s)
        if self.values.shape != (count,):
            raise ValueError(f"{self.quantity}: expected {count} values, found shape {self.values.shape}")


@dataclass(frozen=True)
class Kind:
    """A kind of scenario."""

    # callable (LoadedConfig, int) -> sequence of Series: One run, of this number, of the method and case that the
    # configuration describes. Its random numbers come from the seed and the number alone: methods see the same data.
    # What is the method's work, and not making the data or scoring, it does under `method_clock`.
    run: Callable[[LoadedConfig, int], Sequence[Series]]
    # Bounds on the mean (or the root mean square) of quantities, where they are known.
    bounds: Callable[[LoadedConfig], Sequence[Series]]
    check: Callable[[LoadedConfig], None]  # Raises `InputError` where the configuration lacks what the kind needs
    # Memory that a run needs besides making its scene, bytes, estimated before it begins.
    memory: Callable[[LoadedConfig], float] = lambda loaded: 0.0


def scenario_of(config: Config, expected: type[Scenario]) -> Scenario:
    """Return the scenario of an experiment, which is of the expected kind."""
    assert config.experiment is not None
    scenario = config.experiment.scenario
    assert isinstance(scenario, expected)
    return scenario


# Processor times of the blocks under `method_clock` in the run that is being done, s.
_METHOD_SECONDS: ContextVar[list[float]] = ContextVar("method_seconds")


@contextmanager
def method_clock() -> Iterator[None]:
    """Count the CPU time of this block as the method's; a run without such a block counts as a whole."""
    start = time.thread_time()
    yield
    _METHOD_SECONDS.get([]).append(time.thread_time() - start)


@contextmanager
def method_seconds() -> Iterator[list[float]]:
    """Collect the times of the blocks under `method_clock` within this one."""
    seconds: list[float] = []
    token = _METHOD_SECONDS.set(seconds)
    try:
        yield seconds
    finally:
        _METHOD_SECONDS.reset(token)


def find_kind(name: str) -> Kind:
    """Return the kind of this name: `KIND` of the module of this package that has the name."""
    kind = import_module(f"stereophd.experiments.kinds.{name}").KIND
    assert isinstance(kind, Kind)
    return kind


def frames_in_order(cameras: Sequence[Camera], simulated: Iterable[SimulatedFrame]) -> list[Frame]:
    """Return the frames of a simulated scene as a log of them is read: in order of true time, then of the cameras."""
    frames = []
    for frame in simulated:
        time_s = cameras[frame.camera].clock.to_true(frame.log_time_s)
        frames.append(Frame(time_s, frame.camera, frame.frame, frame.pixels, None, frame.object_id))
    return sorted(frames, key=lambda frame: (frame.time_s, frame.camera))
