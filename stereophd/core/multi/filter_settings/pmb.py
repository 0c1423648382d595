"""Settings of the Poisson multi-Bernoulli filter (``filter.kind: pmb``)."""

from typing import Annotated, Literal

from annotated_types import Interval

from stereophd.core.multi.filter_settings.common import MISSED, ExistenceHysteresis, FilterSettings, Missed
from stereophd.core.settings import FINITE, NOT_NAN, Count, NonNegative, Positive, parameter, settings


@settings
class PmbSettings(FilterSettings):
    """Poisson multi-Bernoulli filter (Williams 2015): labelled tracks."""

    kind: Literal["pmb"] = parameter("the filter", default="pmb")
    prune_weight: Positive = parameter(
        "tracks of a smaller existence are dropped",
        default=1e-3,
        advice="lower keeps more alternatives and takes more time; newborns that are light because frames follow each "
        "other closely lower it by themselves.",
    )
    merge_distance: NonNegative = parameter(
        "squared Mahalanobis distance, in both covariances, below which two tracks are one", default=4.0
    )
    max_components: Count | None = parameter(
        "the most probable tracks are kept, and a warning states how many were left out; null: as many as an eighth "
        "of the memory holds",
        default=None,
        advice="several times the number of objects, where the time of an event must be bounded.",
    )
    max_hypotheses: Count | None = parameter(
        "bound on the hypotheses of all tracks together: beyond it the likeliest are kept, what the others decided "
        "remains undecided, and a warning is given if that is much; null: sixteen for each detection of the event, "
        "at least 8192",
        default=None,
        advice="it acts where hundreds of objects appear at once; a larger bound resolves the ambiguity in fewer "
        "frames, but makes each of these frames slower.",
    )
    hypothesis_distance: Annotated[float, Interval(ge=0), NOT_NAN] = parameter(
        "squared Mahalanobis distance, in both covariances, below which two hypotheses of one track merge; "
        ".inf: one Gaussian a track",
        default=4.0,
        advice="smaller keeps more hypotheses of a track apart: better where objects cross, slower.",
    )
    least_share: Annotated[float, Interval(ge=0, lt=1), FINITE] = parameter(
        "hypotheses of a smaller share of their track are dropped", default=1e-3
    )
    exchange_above: Annotated[float, Interval(gt=0), NOT_NAN] = parameter(
        "two tracks in one epipolar plane swap the detections of a camera where this explains their last events "
        "better by this many nats (log-odds); .inf: never",
        default=5.0,
        advice="lower: crosswise pairs are corrected sooner, but more pairs that were right are swapped.",
    )
    missed: Missed = parameter(
        MISSED, default="keep", advice="split for objects that are never hidden, keep where they hide behind others."
    )
    extraction: ExistenceHysteresis = parameter("which tracks are reported", default_factory=ExistenceHysteresis)


SETTINGS = PmbSettings
