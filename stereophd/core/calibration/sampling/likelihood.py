"""Multi-object log-likelihood of a recording given hypotheses of the cameras (paper VII-B): the evidence.

The log-likelihoods of the events, which the filter conditional on a hypothesis returns, add up to that of the
recording. With the PHD filter it is the paper's; with the PMB filter it is the sum over all associations of each
event (`stereophd.core.multi.association.exact_association`), which is much smoother in the cameras.

A hypothesis is about anything that is unknown of the cameras (ours; the paper's camera states have up to 16 dimensions,
VII-A). Poses leave the events of a recording as they are. A lens changes the pixels, and a clock the times and with
them the order of the events: such a hypothesis has events of its own. All hypotheses are judged by the same data, raw
pixels, with densities over the image. A detection at which the lens of a hypothesis cannot be inverted is clutter under
it: its density is that of clutter.

Scale. Scaling camera distances, depths and speeds together leaves the images unchanged, so detections do not constrain
the scale. The priors of the objects' depth and speed do, and strongly: if they are too broad, each of n objects
multiplies the evidence of cameras s times as far apart by a power of s. `Evidence` can therefore compare all hypotheses
at the scale of the prior mean, so that only the prior of the cameras constrains the scale.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.pairing.association import inflated
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import TIMES
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, enlarged, predicted
from stereophd.core.disparity.events import Event, make_rig
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.base import DisparityFilter, FilterState
from stereophd.core.multi.births.undetected import Undetected
from stereophd.core.multi.filter_settings.pmb import PmbSettings

# False detections a frame below which a lens that cannot be inverted would make the recording impossible.
LEAST_CLUTTER = 1e-6

Item = TypeVar("Item")
Result = TypeVar("Result")
# Expected births of an event, what it leaves undetected, and its burst of clutter (`DisparityFilter.expected_births`).
Births = tuple[float, Undetected, int]


@dataclass(frozen=True)
class ConditionalFilters:
    """Filters of many hypotheses, each of cameras of its own.

    They report nothing. Components are moved by samples, the same in the same turn: a rule that gives way to samples at
    a threshold would make the likelihood jump. The share of undetected objects that other cameras would have seen is no
    continuous function of the cameras, so that births are those of the template.
    """

    template: DisparityFilter  # At the cameras of the prior mean
    threads: int = 1  # Hypotheses are shared out over this many threads; results do not depend on it

    @cached_property
    def _silent(self) -> DisparityFilter:
        settings, sets = self.template.settings, replace(self.template.sets, method="particle")
        if isinstance(settings, PmbSettings):  # no pair of tracks is tested for an exchange
            return replace(self.template, sets=sets, settings=replace(settings, exchange_above=math.inf))
        return replace(self.template, sets=sets)

    def of(self, cameras: tuple[Camera, ...]) -> DisparityFilter:
        """Return the filter conditional on cameras."""
        rig = self.template.rig
        return self._silent.conditional_on(make_rig(cameras, rig.baseline, rig.rectification, rig.region))

    def births(self, undetected: Undetected | None, before_s: float | None, event: Event) -> Births:
        """Return the births of an event, the last one of which was at a time `before_s`, None before the first."""
        elapsed = 0.0 if before_s is None else max(event.time_s - before_s, 0.0)
        return self.template.expected_births(undetected, elapsed, event)

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Call a function for each hypothesis."""
        return list(map(function, items) if self.threads == 1 else self._pool.map(function, items))

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.threads)


def filtered(one: DisparityFilter, state: FilterState, event: Event, births: Births) -> tuple[FilterState, float]:
    """Return the state of a conditional filter after an event, and the log-likelihood of the event's detections."""
    after, info = one.update(state, one.predict(state, event, births), event)
    return after, info.log_likelihood


class _Given(NamedTuple):
    """An event as a hypothesis has it."""

    event: Event
    births: Births
    log_density_of_lost: float


@dataclass(frozen=True)
class Evidence:
    """Log-likelihood of a recording as a function of any parameters of the cameras."""

    parameters: ParameterSet
    recording: Recording
    frames: Integers  # (n,) of int: Frames of the recording, in order of time by the clocks of the prior mean
    filters: ConditionalFilters
    # Number of the reference camera. Given, the cameras of a hypothesis are brought to the scale of the prior mean,
    # about the reference: for problems whose scale is free (`unknowns.scale.scale_is_free`), if the objects' priors
    # shall not decide on it. The scale is the root of the sum of squared distances to the reference.
    scale_reference: int | None = None
    scale: ScaleMeasurement | None = None  # What else is known of the scale; its normal density is one more factor

    @property
    def n_events(self) -> int:
        """Number of frames."""
        return len(self.frames)

    def __call__(self, values: Array) -> Array:
        """Return the log-likelihoods (k,) of values (k, m)."""
        return np.asarray(self.after(values, [len(self.frames)])[0])

    def after(self, values: Array, counts: Sequence[int], inflation: float = 1.0) -> Array:
        """Return the log-likelihoods (s, k) of values (k, m) after the first frames, for each of several counts.

        `counts` are increasing, and at most the number of frames; `inflation` is a factor on the noise of all
        detections.
        """
        same = self.parameters.same_events
        shared = self._given(self.parameters.cameras, counts[-1], inflation) if same else None

        def run(row: Array) -> list[float]:
            cameras = self._at_nominal_scale(self.parameters.build(row))
            if any(quantity.affects == TIMES for quantity in self.parameters.quantities):
                # a later frame by the nominal clocks may be an earlier one by these
                return [self._totals(cameras, self._given(cameras, n, inflation), [n])[0] for n in counts]
            return self._totals(cameras, shared or self._given(cameras, counts[-1], inflation), counts)

        found = np.array(self.filters.map(run, values)).reshape(len(values), len(counts))
        return found.T + self._log_density_of_scale(values)

    def _given(self, cameras: tuple[Camera, ...], count: int, inflation: float) -> list[_Given]:
        """Return the events of the first frames as cameras make them."""
        undetected: Undetected | None = None
        before_s: float | None = None
        out = []
        for event in Scans.of(self.recording, cameras, self.frames[:count]).events:
            births = self.filters.births(undetected, before_s, event)
            undetected, before_s = births[1], event.time_s
            event = inflated(event, inflation)
            out.append(_Given(event, births, _log_density_of_lost(event, cameras[event.camera])))
        return out

    def _totals(self, cameras: tuple[Camera, ...], given: Sequence[_Given], counts: Sequence[int]) -> list[float]:
        """Log-likelihoods of one hypothesis after the first events, for each of several counts."""
        one = self.filters.of(cameras)
        state, totals = one.init(), [0.0]
        for event, births, lost in given:
            state, log_likelihood = filtered(one, state, event, births)
            totals.append(totals[-1] + (log_likelihood + lost))
        return [totals[count] for count in counts]

    def _at_nominal_scale(self, cameras: tuple[Camera, ...]) -> tuple[Camera, ...]:
        reference = self.scale_reference
        if reference is None:
            return cameras
        centers = np.array([[camera.pose.center for camera in rig] for rig in (self.parameters.cameras, cameras)])
        whole, size = np.sqrt(((centers - centers[:, reference, None]) ** 2).sum(axis=(-1, -2)))
        # cameras in one place have no scale
        return enlarged(cameras, reference, float(whole / size)) if size > 0.0 else cameras

    def _log_density_of_scale(self, values: Array) -> Array:
        """Log-density (k,) of what was measured of the scale, at values (k, m); 0 where nothing was."""
        if self.scale is None:
            return np.zeros(len(values))
        about, known = self.scale_reference or 0, self.scale
        scales = np.array([predicted(self.parameters, about, known, row)[0] for row in values])
        return np.asarray(-0.5 * ((scales - known.value) / known.std) ** 2 - np.log(known.std * np.sqrt(2.0 * np.pi)))


def _log_density_of_lost(event: Event, camera: Camera) -> float:
    """Log-density over the image of the detections that were left out of an event: clutter."""
    if event.not_invertible == 0:
        return 0.0
    clutter = max(camera.detector.clutter_per_frame, LEAST_CLUTTER) / (camera.width * camera.height)
    return event.not_invertible * math.log(clutter)
