"""Settings that the filters for many objects share: births, extraction, and what every filter must declare."""

from typing import Annotated, Literal

from annotated_types import Interval

from stereophd.core.disparity.prior import DepthPrior, DepthRange, DisparityPrior
from stereophd.core.settings import (
    FINITE,
    NOT_NAN,
    SMALLEST_TIME_S,
    Count,
    NonNegative,
    Positive,
    PositiveFraction,
    PositiveLength,
    parameter,
    settings,
)

# Effect of a miss on a component that is partly in view.
Missed = Literal["split", "keep"]
MISSED = (
    "effect of a miss on a component that is partly in view. split: the part in view becomes less "
    "probable (paper VI-C); keep: the component keeps its shape and becomes less probable as a whole: real "
    "detectors miss an occluded object for many frames in a row, and each would squeeze the shape"
)

# A span of time above 0, or infinity, s.
TimeConstant = Annotated[float, Interval(ge=SMALLEST_TIME_S), NOT_NAN]

# More new objects in one frame, or a second, than any image can hold.
BirthRate = Annotated[float, Interval(ge=1e-30, le=1e6), FINITE]
# A weight is an expected number of objects: no threshold is beyond a thousand in one component.
WeightThreshold = Annotated[float, Interval(ge=1e-30, le=1e3), FINITE]


@settings
class BirthPrior(DepthPrior):
    """Observation-driven birth (paper VI-B): every detection may be a new object."""

    per_s: BirthRate = parameter(
        "expected number of objects per second that appear in the view of a camera, uniform over its image",
        unit="1/s",
        default=0.1,
        advice="new objects of a minute divided by 60. Larger: tracks start earlier, and more of them are false.",
    )
    initial: NonNegative | None = parameter(
        "expected number of objects in view of a camera at its first frame; without it, the detections of that frame "
        "beyond clutter",
        default=None,
    )
    max_per_frame: Count = parameter(
        "maximum number of detections of a frame that no known object explains; a frame with more is a burst of "
        "clutter: it starts no tracks, and a warning reports how many frames were affected",
        default=20_000,
        advice="above the number of objects in view of one camera; it bounds the time of a frame.",
    )
    disparity: DisparityPrior | None = parameter(
        "prior of the disparity, px at the baseline",
        default=None,
        advice="for the paper's scenes; depth_range states the same in plain lengths.",
    )
    depth_range: DepthRange | None = parameter(
        "near and far depth: two standard deviations either side in disparity",
        unit="length",
        default=None,
        advice="the nearest and the farthest depth at which objects appear, seen from the cameras; a narrow range "
        "settles new tracks sooner, a range that leaves out objects loses them.",
    )
    velocity_std: PositiveLength = parameter(
        "standard deviation of each component of velocity",
        unit="length/s",
        advice="the typical speed divided by 1.7 (three components make up a speed); rather too large than too small.",
    )

    def __post_init__(self) -> None:
        if self.has_depth:
            self.check_depth()

    @property
    def has_depth(self) -> bool:
        """Whether a prior of the depth is stated: points need one, the boxes of bodies none."""
        return self.disparity is not None or self.depth_range is not None


@settings
class Hysteresis:
    """Which components are reported as objects: thresholds with hysteresis."""

    confirm: WeightThreshold = parameter(
        "reported from this weight or existence on", default=0.8, advice="higher: fewer false tracks, later starts."
    )
    release: WeightThreshold = parameter(
        "a reported object stays reported until its weight or existence falls below this", default=0.001
    )
    tentative: WeightThreshold = parameter(
        "an object that is not confirmed is reported as tentative from this weight or existence on, if two cameras "
        "have detected it or the log has just begun; none is from `confirm` on",
        default=0.7,
    )

    def __post_init__(self) -> None:
        if self.release > self.confirm:
            raise ValueError(f"expected release <= confirm, found {self.release} > {self.confirm}")


@settings
class ExistenceHysteresis(Hysteresis):
    """Thresholds of existence between which a track is reported."""

    confirm: PositiveFraction = parameter(
        "reported from this existence on", default=0.98, advice="higher: fewer false tracks, later starts."
    )
    release: PositiveFraction = parameter(
        "a reported track stays reported until its existence falls below this",
        default=0.01,
        advice="lower: a track survives longer without detections.",
    )
    tentative: PositiveFraction = parameter(
        "a track that is not confirmed is reported as tentative from this existence on, if two cameras have detected "
        "it or the log has just begun; none is from `confirm` on",
        default=0.7,
    )


@settings
class FilterSettings:
    """What the settings of every kind of filter hold; `stereophd.core.multi.build` makes the filter."""

    kind: str = parameter("the word that names the filter: the name of its module in `filter_settings`")
    survival_per_s: PositiveFraction = parameter(
        "probability that an object survives one second",
        default=0.99,
        advice="exp(-1 / mean time in view, in s): 0.95 for objects that stay for 20 s.",
    )
    out_of_view_s: TimeConstant = parameter(
        "time constant with which the probability of existence decays while no camera can see the object; .inf: no "
        "decay",
        unit="s",
        default=5.0,
        advice="as long as an object may be hidden from every camera and still be the same one.",
    )
    birth: BirthPrior = parameter("prior of new objects")
    prune_weight: Positive = parameter("components below this weight are dropped: births must be heavier")
    max_components: Count | None = parameter(
        "the heaviest components are kept; null: as many as an eighth of the memory holds",
        default=1000,
        advice="several times the number of objects; it bounds time and memory.",
    )
    missed: Missed = parameter(MISSED)
    extraction: Hysteresis = parameter("what is reported as an object", default_factory=Hysteresis)
