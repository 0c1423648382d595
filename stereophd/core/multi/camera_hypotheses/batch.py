"""Multi-object filters of many camera hypotheses side by side (paper VII-B).

Each hypothesis has cameras of its own and, conditional on them, a filter of its own. All use the same sample
sets in the same turn, so that likelihoods are smooth functions of the cameras, and the same value comes out of
the same cameras every time.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.moments import NO_REGION, draws_of_event
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.births.undetected import Undetected, prune_weight_for_births
from stereophd.core.multi.state.inputs import with_births, with_newborns
from stereophd.core.multi.state.mixture import GaussianMixture, concatenate, empty_mixture
from stereophd.core.numerics.threads import in_threads

# Hypotheses that a thread takes at a time: enough to hide the call, few enough to share them out evenly.
CHUNK = 8


@dataclass(frozen=True)
class BatchState:
    """Conditional mixtures of k camera hypotheses after an event."""

    # `begins`, `ends`: arrays (k,) of int: The components of hypothesis h are those from ``begins[h]`` to ``ends[h]``
    # of the mixture. Hypotheses may share components: resampling copies none.
    begins: Integers
    ends: Integers
    mixture: GaussianMixture  # Components of all hypotheses
    time_s: float | None  # Time of the last event, None before the first
    n_events: int  # Events so far: picks the sample set
    next_label: int  # First unused label, the same in all hypotheses
    # Objects that no camera has detected yet, the same in all hypotheses; None before the first event.
    undetected: Undetected | None = None

    @property
    def size(self) -> int:
        """Number of hypotheses."""
        return len(self.begins)

    @property
    def counts(self) -> Integers:
        """Components of each hypothesis (k,)."""
        return self.ends - self.begins

    def take(self, hypotheses: Integers) -> Self:
        """Return the hypotheses with these indices (k',), which may repeat."""
        return replace(self, begins=self.begins[hypotheses], ends=self.ends[hypotheses])

    def of(self, hypothesis: int) -> GaussianMixture:
        """Return the mixture of one hypothesis."""
        return self.mixture.take(np.arange(self.begins[hypothesis], self.ends[hypothesis]))


@dataclass(frozen=True)
class FilterBatch:
    """Filters conditional on camera hypotheses.

    The same as `predict` and `update` of the filter for each hypothesis (to the rounding of sums), without `extract`:
    no object is ever reported, so that none is protected from being forgotten for having been. All components are moved
    by samples, regardless of the template's method: a rule that gives way to another at a threshold would make the
    likelihood jump. In a region, new objects of all hypotheses have the depths inside it along the rays of the
    template's cameras. Raises ValueError when cameras move.
    """

    # At the nominal cameras. Hypotheses share its intrinsics, lenses and detectors: only poses differ.
    template: DisparityFilter
    threads: int = 1  # Hypotheses are shared out over this many threads; results do not depend on it

    def __post_init__(self) -> None:
        if self.template.rig.moving:
            raise ValueError("expected cameras that stand still")

    def init(self, hypotheses: int) -> BatchState:
        """Return the state of k hypotheses before the first event: no objects."""
        nothing = np.zeros(hypotheses, dtype=np.int64)
        return BatchState(nothing, nothing, empty_mixture(self.template.state_size), None, 0, 0)

    def step(self, state: BatchState, event: Event, spaces: Array) -> tuple[BatchState, Array]:
        """Predict and update every hypothesis for one event.

        Packed disparity spaces (k, c, 30) are those of the cameras of each hypothesis. Returns the state, and
        log-likelihoods (k,) of the event's detections.
        """
        template, mixture = self.template, state.mixture
        bare = template.event_numbers(state.time_s, event, state.next_label)
        births, undetected, burst = template.expected_births(state.undetected, bare.elapsed, event)
        arrays = with_newborns(*template.detections(event), template.state_size)
        settings: Any = template.reduction
        weight = prune_weight_for_births(settings.prune_weight, births, bare.p_detect, bare.clutter)
        numbers, reduction = with_births(bare, births, burst), settings._replace(prune_weight=weight)
        draws = draws_of_event(template.sets, state.n_events)
        motion = template.motion.arrays(event.time_s - mixture.times)
        region = NO_REGION if template.rig.region is None else template.rig.region

        def run(first: int) -> tuple[Integers, GaussianMixture, Array]:
            part = slice(first, first + CHUNK)
            return template.update_hypotheses(
                state.begins[part], state.ends[part], mixture, spaces[part], motion, draws, region, arrays, numbers,
                reduction,
            )  # fmt: skip

        results = in_threads(run, range(0, state.size, CHUNK), self.threads)
        ends = np.cumsum(np.concatenate([counts for counts, _, _ in results]))
        begins = np.concatenate([[0], ends[:-1]])
        label = state.next_label + len(event.points)
        components = concatenate([components for _, components, _ in results])
        after = BatchState(begins, ends, components, event.time_s, state.n_events + 1, label, undetected)
        return after, np.concatenate([values for _, _, values in results])
