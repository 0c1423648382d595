"""Settings of the Gaussian-mixture PHD filter (``filter.kind: phd``)."""

from typing import Literal

from stereophd.core.multi.filter_settings.common import MISSED, FilterSettings, Missed
from stereophd.core.settings import NonNegative, Positive, parameter, settings


@settings
class PhdSettings(FilterSettings):
    """Gaussian-mixture PHD filter (paper VI, Table III)."""

    kind: Literal["phd"] = parameter("the filter", default="phd")
    prune_weight: Positive = parameter(
        "components below this weight are dropped",
        default=1e-6,
        advice="lower keeps more alternatives and takes more time.",
    )
    merge_distance: NonNegative = parameter(
        "squared Mahalanobis distance, in the covariances of both, below which components merge",
        default=7.0,
        advice="larger merges more: faster, and objects close together become one.",
    )
    merge_moments: Literal["label", "intensity"] = parameter(
        "what counts for mean and covariance of a merged component. label: the probabilities of the alternatives for "
        "one object; intensity: the weights (textbook)",
        default="label",
        advice="intensity states covariances that are too large, the more so the lower the probability of detection.",
    )
    missed: Missed = parameter(
        MISSED, default="split", advice="split for objects that are never hidden, keep where they hide behind others."
    )


SETTINGS = PhdSettings
