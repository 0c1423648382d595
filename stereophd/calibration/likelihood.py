"""Multi-object log-likelihood of a detection log given camera hypotheses (paper VII-B): the evidence.

The log-likelihoods of the events, which the filter conditional on a hypothesis returns, add up to that of the
log. With the PHD filter it is the paper's; with the PMB filter it is the Bethe value of the association problems,
which is much smoother in the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.calibration.batch import FilterBatch
from stereophd.calibration.parameters import CENTER as CENTER_NAMES
from stereophd.calibration.parameters import ROTATION as ROTATION_NAMES
from stereophd.calibration.parameters import ParameterSet
from stereophd.geometry.layout import CENTER, ROTATION
from stereophd.multi.events import Event, Rig, make_rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Evidence:
    """Log-likelihood of a log as a function of parameter values.

    Attributes
    ----------
    parameters : ParameterSet
    events : sequence of Event
        The log, in order of time.
    batch : FilterBatch
        The conditional filters.
    """

    parameters: ParameterSet
    events: Sequence[Event]
    batch: FilterBatch

    def __call__(self, values: Array) -> Array:
        """Return the log-likelihoods (k,) of values (k, m)."""
        total = np.zeros(len(values))
        spaces = hypothesis_spaces(self.parameters, values, self.batch.template.rig)
        state = self.batch.init(len(values))
        for event in self.events:
            state, log_likelihoods = self.batch.step(state, event, spaces)
            total += log_likelihoods
        return total


def hypothesis_spaces(parameters: ParameterSet, values: Array, rig: Rig) -> Array:
    """Packed disparity spaces (k, c, 30) of the cameras of parameter values (k, m).

    The same as packing the cameras of `ParameterSet.build` row by row, for all rows at once where the parameters
    are poses: thousands of hypotheses that move after an event would spend more time on that than on the event.
    """
    if {parameter.name for parameter in parameters.parameters} - {*CENTER_NAMES, *ROTATION_NAMES}:
        return np.stack([make_rig(parameters.build(row), rig.baseline, rig.rectification).packed for row in values])
    packed = make_rig(parameters.cameras, rig.baseline, rig.rectification).packed
    spaces = np.repeat(packed[None], len(values), axis=0)
    # a column of zeros stands for the quantities that are known
    padded = np.concatenate([values, np.zeros((len(values), 1))], axis=1)
    for number, camera in enumerate(parameters.cameras):
        center = padded[:, parameters.index(camera.name, CENTER_NAMES)]
        turn = _rotations(padded[:, parameters.index(camera.name, ROTATION_NAMES)])
        spaces[:, number, CENTER : CENTER + 3] += center
        spaces[:, number, ROTATION : ROTATION + 9] = (turn @ camera.pose.rotation).reshape(-1, 9)
    return spaces


def _rotations(vectors: Array) -> Array:
    """Rotation matrices (k, 3, 3) of rotation vectors (k, 3), rad (`stereophd.geometry.pose`)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    # sin(a) / a and (1 - cos a) / a^2, to full precision at a = 0
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * cross @ cross
    )
