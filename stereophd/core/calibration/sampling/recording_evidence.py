"""Multi-object log-likelihood of a recording given hypotheses of anything about the cameras (ours).

The paper's camera states have up to 16 dimensions (VII-A). Poses alone leave the undistorted pixels and the times of
the detections as they are, and `calibration.sampling.likelihood` filters all hypotheses side by side. A lens
changes the pixels, a clock the times and with them the order of the events, and the rates of a moving camera its
disparity spaces. Here every hypothesis therefore has events and a filter of its own, made of the raw recording.

All hypotheses are judged by the same data, raw pixels, with densities over the image. A detection at which the lens of
a hypothesis cannot be inverted is clutter under it: its density is that of clutter. The share of undetected objects
that other cameras would have seen is no continuous function of the cameras, so that it is that of the nominal cameras,
as in the batch.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.pairing.association import inflated
from stereophd.core.calibration.sampling.likelihood import extent, log_density_of_scale
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import TIMES
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, enlarged
from stereophd.core.disparity.events import Event, make_rig
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.numerics.threads import in_threads


@dataclass(frozen=True)
class RecordingEvidence:
    """Log-likelihood of a recording as a function of any parameters of the cameras.

    The filters move components by samples and report nothing, as those of
    `stereophd.core.calibration.sampling.likelihood.Evidence` do; of poses that stand still, both find the same values.
    """

    parameters: ParameterSet
    recording: Recording
    frames: Integers  # (n,) of int: Frames of the recording, in order of time by the clocks of the prior mean
    template: DisparityFilter  # At the cameras of the prior mean
    threads: int = 1  # Hypotheses are shared out over this many threads; results do not depend on it
    # Number of the reference camera. Given, the cameras of a hypothesis are brought to the scale of the prior mean,
    # about the reference.
    scale_reference: int | None = None
    scale: ScaleMeasurement | None = None  # What else is known of the scale; its normal density is one more factor

    @property
    def n_events(self) -> int:
        """Number of frames."""
        return len(self.frames)

    def after(self, values: Array, counts: Sequence[int], inflation: float = 1.0) -> Array:
        """See `calibration.sampling.likelihood.Evidence.after`; the first events are those of the first frames."""

        def run(row: Array) -> list[float]:
            return self._of_one(row, counts, inflation)

        rows = in_threads(run, values, self.threads)
        scale = log_density_of_scale(self.parameters, self.scale_reference, self.scale, values)
        return np.array(rows).reshape(len(values), len(counts)).T + scale

    def _of_one(self, values: Array, counts: Sequence[int], inflation: float) -> list[float]:
        """Log-likelihoods of one hypothesis after the first frames, for each of several counts."""
        cameras = self._at_nominal_scale(self.parameters.build(values))
        if any(quantity.affects == TIMES for quantity in self.parameters.quantities):
            # a later frame by the nominal clocks may be an earlier one by these
            return [self._filtered(cameras, self.frames[:count], [count], inflation)[0] for count in counts]
        return self._filtered(cameras, self.frames[: counts[-1]], counts, inflation)

    def _filtered(
        self, cameras: tuple[Camera, ...], frames: Integers, counts: Sequence[int], inflation: float
    ) -> list[float]:
        template = self.template
        rig = make_rig(cameras, template.rig.baseline, template.rig.rectification, template.rig.region)
        # a rule that gives way to samples at a threshold would make the likelihood jump
        sets = replace(template.sets, method="particle")
        conditional = replace(template, rig=rig, sets=sets, settings=self._settings)
        state, total, totals = conditional.init(), 0.0, []
        for number, event in enumerate(Scans.of(self.recording, cameras, frames).events):
            totals += [total] * list(counts).count(number)
            elapsed = 0.0 if state.time_s is None else max(event.time_s - state.time_s, 0.0)
            births = template.expected_births(state.undetected, elapsed, event)
            event = inflated(event, inflation)
            state, info = conditional.update(state, conditional.predict(state, event, births), event)
            total += info.log_likelihood + _log_density_of_lost(event, cameras[event.camera])
        return totals + [total] * list(counts).count(len(frames))

    @cached_property
    def _settings(self) -> FilterSettings:
        settings = self.template.settings
        # nothing is reported, so that no pair of tracks would be tested for an exchange
        return replace(settings, exchange_above=math.inf) if isinstance(settings, PmbSettings) else settings

    def _at_nominal_scale(self, cameras: tuple[Camera, ...]) -> tuple[Camera, ...]:
        reference = self.scale_reference
        if reference is None:
            return cameras
        whole, size = (
            float(extent(np.array([camera.pose.center for camera in rig]), reference))
            for rig in (self.parameters.cameras, cameras)
        )
        # cameras in one place have no scale
        return enlarged(cameras, reference, whole / size) if size > 0.0 else cameras


def _log_density_of_lost(event: Event, camera: Camera) -> float:
    """Log-density over the image of the detections that were left out of an event: clutter."""
    if event.not_invertible == 0:
        return 0.0
    clutter = camera.detector.expected_clutter / (camera.width * camera.height)
    return event.not_invertible * math.log(clutter)
