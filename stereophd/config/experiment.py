"""The ``experiment`` section of a configuration: its scenario, its methods, its cases and the number of runs."""

from typing import Annotated, Any, Literal, Self

from annotated_types import Interval
from pydantic import Field, model_validator

from stereophd.core.settings import (
    FINITE,
    LARGEST_COUNT,
    Count,
    Duration,
    Pixel,
    Positive,
    PositiveDuration,
    PositiveLength,
    PositivePixels,
    Time,
    Vector3,
    parameter,
)
from stereophd.validated import Model, ascending

# How often something is repeated within a run, or drawn for a bound.
Repeats = Annotated[int, Interval(ge=1, le=1_000_000)]

# Dotted paths of any keys of the configuration, and the values they take.
Settings = dict[str, Any]


class OspaSettings(Model):
    """One OSPA distance."""

    order: Annotated[float, Interval(ge=1, le=100), FINITE] = parameter("order p", default=2.0)
    cutoff: PositiveLength = parameter("cutoff c, length (mahalanobis: standard deviations)")
    base: Literal["euclidean", "mahalanobis"] = parameter(
        "distance of an estimate from an object; mahalanobis: in the estimate's covariance", default="euclidean"
    )

    @property
    def quantity(self) -> str:
        """Name of the quantity in the results."""
        base = "" if self.base == "euclidean" else "mahalanobis_"
        return f"ospa_{base}p{self.order:g}_c{self.cutoff:g}"


class MultiObjectScenario(Model):
    """A scenario in which ``filter`` tracks the scene of ``simulate``, and OSPA over time scores it."""

    kind: Literal["multi_object"] = parameter("what is run")
    tracker: Literal["filter", "known_association"] = parameter(
        "filter: the configuration's; known_association: least squares on all data so far with the true associations,"
        " a limit for all trackers of straight paths",
        default="filter",
    )
    tentative: bool = parameter("whether tentative objects are scored too, not only confirmed ones", default=False)
    ospa: Annotated[tuple[OspaSettings, ...], Field(min_length=1)] = parameter("distances that are reported")


class LocalisationScenario(Model):
    """A static object observed by one camera after another, located by ``filter`` (kind single)."""

    kind: Literal["localisation"] = parameter("what is run")
    position: Vector3 = parameter("position of the object in the world", unit="length")
    sequence: Annotated[tuple[str, ...], Field(min_length=1)] = parameter("name of the camera of each observation")
    rounds: Repeats = parameter("how often the sequence is repeated", default=1)
    interval_s: PositiveDuration = parameter("time between observations, for the figure", default=1.0, unit="s")
    bound_with_prior: bool = parameter("whether the bound counts the prior of the disparity", default=False)


class TrackingScenario(Model):
    """A moving object seen by all cameras at the same times, tracked by ``filter`` (kind single)."""

    kind: Literal["tracking"] = parameter("what is run")
    position: Vector3 = parameter("position of the object at the first time", unit="length")
    velocity: Vector3 = parameter("velocity of the object at the first time; it accelerates according to ``motion``")
    steps: Repeats = parameter("number of times")
    interval_s: PositiveDuration = parameter("time between two of them", unit="s")
    bound_trajectories: Repeats = parameter(
        "drawn trajectories over which the information of the bound is averaged", default=100
    )


class MoveScenario(Model):
    """A Gaussian moved from one disparity space to another by ``moments``, compared with a large sample."""

    kind: Literal["move"] = parameter("what is run")
    home: str = parameter("camera in whose disparity space it begins")
    destination: str = parameter("camera to whose disparity space it is carried")
    point_px: tuple[Pixel, Pixel, Pixel] = parameter("mean of u, v and d", unit="px")
    std_px: tuple[PositivePixels, PositivePixels, PositivePixels] = parameter("their standard deviations", unit="px")
    velocity: Vector3 = parameter("mean velocity in the world", default=(0.0, 0.0, 0.0))
    velocity_std: PositiveLength = parameter("standard deviation of each of its components")
    interval_s: Duration = parameter("how long the object moves", unit="s")
    reference_samples: Annotated[int, Interval(ge=1000, le=LARGEST_COUNT)] = parameter(
        "samples of the reference", default=1_000_000
    )


class CalibrationScenario(Model):
    """A scenario in which ``calibration`` estimates the cameras of the scene of ``simulate`` from a wrong guess."""

    kind: Literal["calibration"] = parameter("what is run")
    every_s: PositiveDuration = parameter("time between two scores of the estimate so far", unit="s")
    bound_scenes: Repeats = parameter("scenes (those of the first runs) over which the bound is averaged", default=20)


class StaticSceneScenario(Model):
    """A scenario in which ``filter`` finds the correspondence of points that stand still in views of ``simulate``."""

    kind: Literal["static_scene"] = parameter("what is run")
    cutoff: PositiveLength = parameter(
        "a point without an estimate within this distance counts as missed", unit="length"
    )
    bound_scenes: Repeats = parameter("scenes (those of the first runs) over which the bound is averaged", default=20)


Scenario = Annotated[
    MultiObjectScenario
    | LocalisationScenario
    | TrackingScenario
    | MoveScenario
    | CalibrationScenario
    | StaticSceneScenario,
    Field(discriminator="kind"),
]


class AxisConfig(Model):
    """A setting that differs between the cases; the cases are all combinations of the axes."""

    key: str | None = parameter("dotted path of the key that takes the values", default=None)
    values: Annotated[tuple[Any, ...], Field(min_length=1)] | None = parameter("values of that key", default=None)
    unit: str = parameter("unit of the values, for names and figures", default="")
    settings: Annotated[dict[str, Settings], Field(min_length=1)] | None = parameter(
        "in place of key and values: for each name of a value, the keys that it sets and their values", default=None
    )

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if (self.key is None) != (self.values is None) or (self.key is None) == (self.settings is None):
            raise ValueError("expected key and values, or settings")
        return self

    def points(self) -> list[tuple[str, Settings]]:
        """Return the name of each value, and what it sets."""
        if self.settings is not None:
            return list(self.settings.items())
        unit = f" {self.unit}" if self.unit else ""
        return [(f"{_plain(value)}{unit}", {str(self.key): value}) for value in self.values or ()]


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else str(value)


class FigureConfig(Model):
    """What the figure shows: one panel per quantity, one line per method."""

    title: str | None = parameter("title of the figure; the number of runs is added", default=None)
    quantities: Annotated[tuple[str, ...], Field(min_length=1)] | None = parameter(
        "names of quantities; by default all that vary with time, or all if none does", default=None
    )
    over: str | None = parameter(
        "horizontal axis of the figure: the name of an axis of the cases; by default time, or the first axis if the "
        "quantities do not vary with time",
        default=None,
    )
    log: bool = parameter("logarithmic scale of the quantities", default=False)
    most: Positive | None = parameter("upper end of the scale of the quantities", default=None)


class ExperimentConfig(Model):
    """Monte Carlo runs of a scenario: every method in every case sees the same data in run k."""

    name: str | None = parameter("name in the results; by default the name of the file", default=None)
    scenario: Scenario = parameter("what is run; its kind determines the other keys")
    runs: Count = parameter("number of runs of each method in each case")
    methods: Annotated[dict[str, Settings], Field(min_length=1)] = parameter(
        "for each name of a method, dotted paths of any keys of this file and the values that they take for this method"
    )
    cases: dict[str, AxisConfig] = parameter("for each name of an axis, what varies along it", default_factory=dict)
    windows: dict[str, Annotated[tuple[Time, Time], ascending("first <= last time")]] = parameter(
        "for each name of a window, its first and last time, s: the results also give every quantity's mean over it",
        default_factory=dict,
    )
    table: tuple[str, ...] | None = parameter(
        "quantities of the table on the terminal; by default those that do not vary with time", default=None
    )
    figure: FigureConfig = parameter("what the figure shows", default_factory=FigureConfig)

    @model_validator(mode="after")
    def _order(self) -> Self:
        if self.figure.over is not None and self.figure.over not in self.cases:
            raise ValueError(f"figure.over: expected the name of an axis of cases, found {self.figure.over}")
        return self
