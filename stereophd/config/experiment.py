"""The ``experiment`` section of a configuration: a scenario, methods, cases, a number of runs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from stereophd.config.base import Finite, Model, NonNegative, Positive, Vector3

# Dotted paths of any keys of the configuration, and the values they take.
Settings = dict[str, Any]


class OspaSettings(Model):
    """One OSPA distance."""

    order: Annotated[float, Field(ge=1, allow_inf_nan=False)] = Field(2.0, description="order p")
    cutoff: Positive = Field(description="cutoff c, length (mahalanobis: standard deviations)")
    base: Literal["euclidean", "mahalanobis"] = Field(
        "euclidean", description="distance of an estimate from an object; mahalanobis: in the estimate's covariance"
    )

    @property
    def quantity(self) -> str:
        """Name of the quantity in the results."""
        base = "" if self.base == "euclidean" else "mahalanobis_"
        return f"ospa_{base}p{self.order:g}_c{self.cutoff:g}"


class MultiObjectScenario(Model):
    """The scene of ``simulate``, tracked by ``filter``, scored by OSPA over time."""

    kind: Literal["multi_object"] = Field(description="what is run")
    tracker: Literal["filter", "known_association"] = Field(
        "filter",
        description="filter: the configuration's; known_association: least squares on all data so far with the true "
        "associations, a limit for all trackers of straight paths",
    )
    ospa: Annotated[tuple[OspaSettings, ...], Field(min_length=1)] = Field(description="distances that are reported")


class LocalisationScenario(Model):
    """A static object observed by one camera after another, located by ``filter`` (kind single)."""

    kind: Literal["localisation"] = Field(description="what is run")
    position: Vector3 = Field(description="of the object, in the world")
    sequence: Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        description="name of the camera of each observation"
    )
    rounds: Annotated[int, Field(ge=1)] = Field(1, description="how often the sequence is gone through")
    interval_s: Positive = Field(1.0, description="time between observations, for the figure")
    bound_with_prior: bool = Field(False, description="whether the bound counts the prior of the disparity")


class TrackingScenario(Model):
    """A moving object seen by all cameras at the same times, tracked by ``filter`` (kind single)."""

    kind: Literal["tracking"] = Field(description="what is run")
    position: Vector3 = Field(description="of the object at the first time")
    velocity: Vector3 = Field(description="of the object at the first time; it accelerates as ``motion`` says")
    steps: Annotated[int, Field(ge=1)] = Field(description="number of times")
    interval_s: Positive = Field(description="between them, s")
    bound_trajectories: Annotated[int, Field(ge=1)] = Field(
        100, description="drawn trajectories over which the information of the bound is averaged"
    )


class MoveScenario(Model):
    """A Gaussian carried from one disparity space to another as ``moments`` says; compared with a large sample."""

    kind: Literal["move"] = Field(description="what is run")
    home: str = Field(description="camera in whose disparity space it begins")
    destination: str = Field(description="camera to whose disparity space it is carried")
    point_px: Vector3 = Field(description="mean of u, v and d")
    std_px: tuple[Positive, Positive, Positive] = Field(description="their standard deviations")
    velocity: Vector3 = Field((0.0, 0.0, 0.0), description="mean velocity in the world")
    velocity_std: Positive = Field(description="standard deviation of each of its components")
    interval_s: NonNegative = Field(description="how long the object moves, s")
    reference_samples: Annotated[int, Field(ge=1000)] = Field(1_000_000, description="samples of the reference")


class CalibrationScenario(Model):
    """The scene of ``simulate``, its cameras calibrated as ``calibration`` says, from a guess that misses them."""

    kind: Literal["calibration"] = Field(description="what is run")
    every_s: Positive = Field(description="time between two looks at the estimate so far, s")
    bound_scenes: Annotated[int, Field(ge=1)] = Field(
        20, description="scenes (those of the first runs) over which the bound is averaged"
    )


Scenario = Annotated[
    MultiObjectScenario | LocalisationScenario | TrackingScenario | MoveScenario | CalibrationScenario,
    Field(discriminator="kind"),
]


class AxisConfig(Model):
    """One thing that differs between the cases; the cases are all combinations of the axes."""

    key: str | None = Field(None, description="dotted path of the key that takes the values")
    values: Annotated[tuple[Any, ...], Field(min_length=1)] | None = Field(None, description="values of that key")
    unit: str = Field("", description="of the values, for names and figures")
    settings: Annotated[dict[str, Settings], Field(min_length=1)] | None = Field(
        None, description="instead of key and values: name of the value -> the keys that it sets, and their values"
    )

    @model_validator(mode="after")
    def _one_form(self) -> AxisConfig:
        if (self.key is None) != (self.values is None) or (self.key is None) == (self.settings is None):
            raise ValueError("expected key and values, or settings")
        return self

    def points(self) -> list[tuple[str, Settings]]:
        """Return the name of each value, and what it sets."""
        if self.settings is not None:
            return list(self.settings.items())
        assert self.key is not None
        assert self.values is not None
        unit = f" {self.unit}" if self.unit else ""
        return [(f"{_plain(value)}{unit}", {self.key: value}) for value in self.values]


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else str(value)


class FigureConfig(Model):
    """What the figure shows: a panel a quantity, a line a method."""

    title: str | None = Field(None, description="title of the figure; the number of runs is added")
    quantities: Annotated[tuple[str, ...], Field(min_length=1)] | None = Field(
        None, description="names of quantities; default all that vary with time, or else all"
    )
    over: str | None = Field(
        None, description="the axis of the cases along the figure; default time, or else the first axis"
    )
    log: bool = Field(False, description="logarithmic scale of the quantities")
    most: Positive | None = Field(None, description="upper end of the scale of the quantities")


class ExperimentConfig(Model):
    """Monte Carlo runs of a scenario: every method in every case sees the same data in run k."""

    name: str | None = Field(None, description="name in the results; default the name of the file")
    scenario: Scenario = Field(description="what is run, by its kind")
    runs: Annotated[int, Field(ge=1)] = Field(description="number of runs of each method in each case")
    methods: Annotated[dict[str, Settings], Field(min_length=1)] = Field(
        description="name -> dotted paths of any keys of this file, and the values they take for this method"
    )
    cases: dict[str, AxisConfig] = Field(default_factory=dict, description="name of an axis -> what varies along it")
    windows: dict[str, tuple[Finite, Finite]] = Field(
        default_factory=dict, description="name -> first and last time, s: of every quantity also the mean over it"
    )
    table: tuple[str, ...] | None = Field(
        None, description="quantities of the table on the terminal; default those without time"
    )
    figure: FigureConfig = Field(default_factory=FigureConfig, description="what the figure shows")

    @model_validator(mode="after")
    def _order(self) -> ExperimentConfig:
        for name, (low, high) in self.windows.items():
            if low > high:
                raise ValueError(f"windows.{name}: expected first <= last time, found [{low:g}, {high:g}]")
        if self.figure.over is not None and self.figure.over not in self.cases:
            raise ValueError(f"figure.over: expected the name of an axis of cases, found {self.figure.over}")
        return self
