"""Multi-object filters of many camera hypotheses side by side (paper VII-B).

Each hypothesis has cameras of its own and, conditional on them, a filter of its own. All use the same sample
sets in the same turn, so that likelihoods are smooth functions of the cameras, and the same value comes out of
the same cameras every time.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.batch_arrays import EventArrays, SampleArrays, Step
from stereophd.core.calibration.batch_kernels import phd_update, pmb_update, predict
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.moments import FEWEST_SAMPLES, NO_REGION, minimum_in_view
from stereophd.core.disparity.move_kernels import Look
from stereophd.core.multi.base import IMPORTANT_WEIGHT
from stereophd.core.multi.birth import birth_moments
from stereophd.core.multi.intensity import GaussianMixture, Parts, empty_mixture
from stereophd.core.multi.kinds.pmb import PmbSettings
from stereophd.core.multi.phd import PhdFilter
from stereophd.core.multi.pmb import PmbFilter

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Hypotheses that a thread takes at a time: enough to hide the call, few enough to share them out evenly.
CHUNK = 8


@dataclass(frozen=True)
class BatchState:
    """Conditional mixtures of k camera hypotheses after an event.

    Attributes
    ----------
    begins, ends : arrays (k,) of int
        The components of hypothesis h are those from ``begins[h]`` to ``ends[h]`` of the mixture. Hypotheses may
        share components: resampling copies none.
    mixture : GaussianMixture
        Components of all hypotheses.
    time_s : float or None
        Time of the last event, None before the first.
    n_events : int
        Events so far: picks the sample set.
    next_label : int
        First unused label, the same in all hypotheses.
    """

    begins: Integers
    ends: Integers
    mixture: GaussianMixture
    time_s: float | None
    n_events: int
    next_label: int

    @property
    def size(self) -> int:
        """Number of hypotheses."""
        return len(self.begins)

    @property
    def counts(self) -> Integers:
        """Components of each hypothesis (k,)."""
        return self.ends - self.begins

    def take(self, hypotheses: Integers) -> BatchState:
        """Return the hypotheses with these indices (k',), which may repeat."""
        return replace(self, begins=self.begins[hypotheses], ends=self.ends[hypotheses])

    def of(self, hypothesis: int) -> GaussianMixture:
        """Return the mixture of one hypothesis."""
        return self.mixture.take(np.arange(self.begins[hypothesis], self.ends[hypothesis]))


@dataclass(frozen=True)
class FilterBatch:
    """Filters conditional on camera hypotheses.

    The same as `predict` and `update` of the filter for each hypothesis (to the rounding of sums), without
    `extract`: no object is ever reported, so that none is protected from being forgotten for having been. All
    components are moved by samples, whatever the template's method is: a rule that gives way to another at a
    threshold would make the likelihood jump.

    Attributes
    ----------
    template : PhdFilter or PmbFilter
        At the nominal cameras. Hypotheses share its intrinsics, lenses and detectors: only poses differ.
    threads : int
        Hypotheses are shared out over this many threads; results do not depend on it.

    Raises
    ------
    ValueError
        Cameras move.
    """

    template: PhdFilter | PmbFilter
    threads: int = 1

    def __post_init__(self) -> None:
        if self.template.rig.moving:
            raise ValueError("expected cameras that stand still")

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.threads)

    def init(self, hypotheses: int) -> BatchState:
        """Return the state of k hypotheses before the first event: no objects."""
        nothing = np.zeros(hypotheses, dtype=np.int64)
        return BatchState(nothing, nothing, empty_mixture(self.template.state_size), None, 0, 0)

    def step(self, state: BatchState, event: Event, spaces: Array) -> tuple[BatchState, Array]:
        """Predict and update every hypothesis for one event.

        Parameters
        ----------
        state : BatchState
        event : Event
        spaces : array (k, c, 30)
            Packed disparity spaces of the cameras of each hypothesis.

        Returns
        -------
        state : BatchState
        log_likelihoods : array (k,)
            Of the event's detections.
        """
        detections, sets, step = self._detections(event), self._samples(state), self._step(state, event)
        region = NO_REGION if self.template.rig.region is None else self.template.rig.region
        parts = state.mixture.parts
        motion = self.template.motion.arrays(event.time_s - state.mixture.times)
        update = pmb_update if isinstance(self.template, PmbFilter) else phd_update

        def run(first: int) -> tuple[Integers, Parts, Array]:
            part = slice(first, first + CHUNK)
            begins, ends = state.begins[part], state.ends[part]
            weights, moved = predict(begins, ends, parts, spaces[part], sets, motion, step, region)
            return update(begins, ends, parts, weights, moved, detections, step)

        starts = range(0, state.size, CHUNK)
        results = [run(first) for first in starts] if self.threads == 1 else list(self._pool.map(run, starts))
        ends = np.cumsum(np.concatenate([counts for counts, _, _ in results]))
        begins = np.concatenate([[0], ends[:-1]])
        mixture = GaussianMixture(*(np.concatenate(values) for values in zip(*(r[1] for r in results), strict=True)))
        label = state.next_label + len(event.points)
        after = BatchState(begins, ends, mixture, event.time_s, state.n_events + 1, label)
        return after, np.concatenate([values for _, _, values in results])

    def _samples(self, state: BatchState) -> SampleArrays:
        sets = self.template.sets
        samples = sets.turn(state.n_events)
        first = Look(samples, np.ones(samples.shape[1]), minimum_in_view(samples.shape[1]))
        return SampleArrays(first, Look(sets.reserve, sets.reserve_weights, FEWEST_SAMPLES))

    def _detections(self, event: Event) -> EventArrays:
        template = self.template
        space = template.rig.space(event.camera, event.time_s)
        means, covariances = birth_moments(event, space, template.birth, template.state_size)
        return EventArrays(event.points, event.covariances, event.areas, event.delays, means, covariances)

    def _step(self, state: BatchState, event: Event) -> Step:
        template, settings = self.template, self.template.settings
        camera = template.rig.cameras[event.camera]
        elapsed = 0.0 if state.time_s is None else max(event.time_s - state.time_s, 0.0)
        return Step(
            camera=int(event.camera),
            time_s=float(event.time_s),
            survival=float(settings.survival_per_s**elapsed),
            elapsed=float(elapsed),
            out_of_view_s=float(settings.out_of_view_s),
            next_label=state.next_label,
            p_detect=float(camera.detector.p_detect),
            shape_p_detect=float(camera.detector.p_detect) if template.split_missed else 0.0,
            clutter=float(camera.detector.clutter_per_frame),
            births=float(settings.birth.per_frame),
            area=float(camera.width * camera.height),
            important=IMPORTANT_WEIGHT,
            prune_weight=float(settings.prune_weight),
            merge_distance=float(settings.merge_distance),
            max_components=int(settings.max_components),
            mutual=True if isinstance(settings, PmbSettings) else settings.merge_rule == "mutual",
            recycle_below=float(settings.recycle_below) if isinstance(settings, PmbSettings) else 0.0,
            hypothesis_distance=float(settings.hypothesis_distance) if isinstance(settings, PmbSettings) else 0.0,
            least_share=float(settings.least_share) if isinstance(settings, PmbSettings) else 0.0,
        )
