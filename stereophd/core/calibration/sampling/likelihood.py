"""Multi-object log-likelihood of a detection log given hypotheses of the poses (paper VII-B): the evidence.

The log-likelihoods of the events, which the filter conditional on a hypothesis returns, add up to that of the
log. With the PHD filter it is the paper's; with the PMB filter it is the sum over all associations of each
event (`stereophd.core.multi.association.exact_association`), which is much smoother in the cameras.

Scale. Scaling camera distances, depths and speeds together leaves the images unchanged, so detections do not constrain
the scale. The priors of the objects' depth and speed do, and strongly: if they are too broad, each of n objects
multiplies the evidence of cameras s times as far apart by a power of s. `Evidence` can therefore compare all hypotheses
at the scale of the prior mean, so that only the prior of the cameras constrains the scale.

Hypotheses of anything else than poses need events of their own: `calibration.sampling.recording_evidence`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.pairing.association import inflated
from stereophd.core.calibration.unknowns.parameters import ParameterSet, taken
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, predicted
from stereophd.core.disparity.events import Event, Rig, make_rig
from stereophd.core.geometry.layout import CENTER
from stereophd.core.multi.camera_hypotheses.batch import FilterBatch


@dataclass(frozen=True)
class Evidence:
    """Log-likelihood of a log as a function of the poses of cameras that stand still."""

    parameters: ParameterSet
    events: Sequence[Event]  # The log, in order of time
    batch: FilterBatch  # The conditional filters
    # Number of the reference camera. Given, the cameras of a hypothesis are brought to the nominal scale
    # (`at_nominal_scale`): for problems whose scale is free (`unknowns.scale.scale_is_free`), if the objects'
    # priors shall not decide on it.
    scale_reference: int | None = None
    scale: ScaleMeasurement | None = None  # What else is known of the scale; its normal density is one more factor

    @property
    def n_events(self) -> int:
        """Number of events."""
        return len(self.events)

    def after(self, values: Array, counts: Sequence[int], inflation: float = 1.0) -> Array:
        """Return the log-likelihoods (s, k) of values (k, m) after the first events, for each of several counts.

        `counts` are increasing, and at most the number of events; `inflation` is a factor on the noise of all
        detections. All counts come from one run of the filters.
        """
        total = log_density_of_scale(self.parameters, self.scale_reference, self.scale, values)
        spaces = hypothesis_spaces(self.parameters, values, self.batch.template.rig)
        if self.scale_reference is not None:
            nominal = hypothesis_spaces(self.parameters, self.parameters.prior_mean[None], self.batch.template.rig)
            spaces = at_nominal_scale(spaces, nominal[0], self.scale_reference)
        state, totals = self.batch.init(len(values)), np.empty((len(counts), len(values)))
        for number, event in enumerate(self.events[: counts[-1]]):
            totals[np.equal(counts, number)] = total
            state, log_likelihoods = self.batch.step(state, inflated(event, inflation), spaces)
            total = total + log_likelihoods
        totals[np.equal(counts, counts[-1])] = total
        return totals


def log_density_of_scale(
    parameters: ParameterSet, reference: int | None, scale: ScaleMeasurement | None, values: Array
) -> Array:
    """Log-density (k,) of what was measured of the scale, at values (k, m); 0 where nothing was."""
    if scale is None:
        return np.zeros(len(values))
    about = 0 if reference is None else reference
    scales = np.array([predicted(parameters, about, scale, row)[0] for row in values])
    return np.asarray(-0.5 * ((scales - scale.value) / scale.std) ** 2 - np.log(scale.std * np.sqrt(2.0 * np.pi)))


def hypothesis_spaces(parameters: ParameterSet, values: Array, rig: Rig) -> Array:
    """Packed disparity spaces (k, c, 30) of the cameras of parameter values (k, m), poses of cameras that stand still.

    The same as packing the cameras of `ParameterSet.build` row by row, for all rows at once: thousands of hypotheses
    that move after an event would spend more time on that than on the event.
    """
    packed = make_rig(parameters.cameras, rig.baseline, rig.rectification).packed
    spaces = np.repeat(packed[None], len(values), axis=0)
    for number, camera in enumerate(parameters.cameras):
        for quantity, index in parameters.unknown(camera.name):
            quantity.pack(spaces[:, number], camera, taken(values, index))
    return spaces


def extent(centers: Array, reference: int) -> Array:
    """Scale (...) of cameras with centres (..., c, 3): the root of the sum of squared distances to the reference."""
    return np.asarray(np.sqrt(((centers - centers[..., reference, None, :]) ** 2).sum(axis=(-1, -2))))


def at_nominal_scale(spaces: Array, nominal: Array, reference: int) -> Array:
    """Bring the cameras of hypotheses, packed spaces (k, c, 30), to the scale of nominal ones (c, 30).

    The reference camera stays where it is. The scale is the root of the sum of squared distances to it; with two
    cameras, their distance.
    """
    centers = spaces[:, :, CENTER : CENTER + 3]
    whole, sizes = extent(nominal[:, CENTER : CENTER + 3], reference), extent(centers, reference)
    # cameras in one place have no scale
    ratio = whole / np.where(sizes > 0.0, sizes, whole)
    scaled = spaces.copy()
    pivot = centers[:, reference, None]
    scaled[:, :, CENTER : CENTER + 3] = pivot + ratio[:, None, None] * (centers - pivot)
    return scaled
