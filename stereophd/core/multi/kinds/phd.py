"""The word ``phd``: settings of the Gaussian-mixture PHD filter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from stereophd.core.multi.settings import MISSED, OUT_OF_VIEW, BirthPrior, Hysteresis, Missed, TimeConstant
from stereophd.core.settings import Count, NonNegative, Positive, PositiveFraction, parameter, settings

if TYPE_CHECKING:
    from stereophd.core.disparity.events import Rig
    from stereophd.core.motion.models import Motion
    from stereophd.core.multi.phd import PhdFilter
    from stereophd.core.numerics.samples import SampleSets


@settings
class PhdSettings:
    """Gaussian-mixture PHD filter (paper VI, Table III)."""

    kind: Literal["phd"] = parameter("the filter", default="phd")
    survival_per_s: PositiveFraction = parameter(
        "probability that an object survives one second",
        default=0.99,
        advice="exp(-1 / mean time in view, in s): 0.95 for objects that stay for 20 s.",
    )
    out_of_view_s: TimeConstant = parameter(
        OUT_OF_VIEW,
        unit="s",
        default=5.0,
        advice="as long as an object may be hidden from every camera and still be the same one.",
    )
    birth: BirthPrior = parameter("prior of new objects")
    prune_weight: Positive = parameter(
        "components below this weight are dropped",
        default=1e-6,
        advice="lower keeps more alternatives and takes more time.",
    )
    merge_distance: NonNegative = parameter(
        "squared Mahalanobis distance below which components merge",
        default=7.0,
        advice="larger merges more: faster, and objects close together become one.",
    )
    merge_rule: Literal["mutual", "vo_ma"] = parameter(
        "mutual: near in the covariances of both; vo_ma: in that of the lighter one only (textbook)", default="mutual"
    )
    max_components: Count = parameter(
        "the heaviest components are kept",
        default=1000,
        advice="several times the number of objects; it bounds time and memory.",
    )
    missed: Missed = parameter(
        MISSED, default="split", advice="split for objects that are never hidden, keep where they hide behind others."
    )
    extraction: Hysteresis = parameter("what is reported as an object", default_factory=Hysteresis)

    def build(self, rig: Rig, motion: Motion, sets: SampleSets, threads: int = 1) -> PhdFilter:
        """Return the filter."""
        from stereophd.core.multi.phd import PhdFilter

        return PhdFilter(rig, motion, sets, self, threads)


SETTINGS = PhdSettings
