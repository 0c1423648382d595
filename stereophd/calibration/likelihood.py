"""Multi-object log-likelihood of a detection log given many camera hypotheses (paper VII-B).

Each hypothesis has cameras of its own and, conditional on them, a multi-object filter of its own; the
log-likelihoods of the events that the filters return add up to the evidence of the hypothesis. All hypotheses
use the same sample sets in the same turn, so that the evidence is a smooth function of the cameras, and the
same value comes out of the same cameras every time.

`PhdBatch` runs the PHD filters of many hypotheses side by side, compiled, and keeps their intensities: that
is what the single-cluster filter needs. `phd_evidence` and `pmb_evidence` return the evidence alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereophd.calibration.parameters import CENTER as CENTER_NAMES
from stereophd.calibration.parameters import ROTATION as ROTATION_NAMES
from stereophd.calibration.parameters import ParameterSet
from stereophd.calibration.phd_kernels import EventArrays, MixtureArrays, PhdStep, SampleArrays, phd_events
from stereophd.disparity.moments import FEWEST_SAMPLES, NO_REGION, WIDE_DISPARITY, minimum_in_view
from stereophd.geometry.layout import CENTER, ROTATION
from stereophd.multi.base import IMPORTANT_WEIGHT
from stereophd.multi.birth import birth_moments
from stereophd.multi.events import Event, Rig, make_rig
from stereophd.multi.intensity import GaussianMixture
from stereophd.multi.phd import PhdFilter

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Hypotheses that a thread takes at a time: enough to hide the call, few enough to share them out evenly.
CHUNK = 8
SAMPLED_METHODS = ("qmc", "particle")


class Evidence(Protocol):
    """Log-likelihood of a log, (k,), of parameter values (k, m)."""

    def __call__(self, values: Array) -> Array: ...


@dataclass(frozen=True)
class HypothesesState:
    """Conditional PHD intensities of k camera hypotheses after an event; arrays only, to be stored as they are.

    Attributes
    ----------
    offsets : array (k + 1,) of int
        The components of hypothesis h are those from ``offsets[h]`` to ``offsets[h + 1]``.
    weights, means, covariances, cameras, times : arrays (n,), (n, d), (n, d, d), (n,), (n,)
        As in `stereophd.multi.intensity.GaussianMixture`, of all hypotheses one after the other.
    time_s : float or None
        Time of the last event, None before the first.
    n_events : int
        Events so far: picks the sample set.
    """

    offsets: Integers
    weights: Array
    means: Array
    covariances: Array
    cameras: Integers
    times: Array
    time_s: float | None
    n_events: int

    @property
    def size(self) -> int:
        """Number of hypotheses."""
        return len(self.offsets) - 1

    @property
    def counts(self) -> Integers:
        """Components of each hypothesis (k,)."""
        return np.diff(self.offsets)

    def take(self, hypotheses: Integers) -> HypothesesState:
        """Return the hypotheses with these indices (k',), which may repeat."""
        counts = self.counts[hypotheses]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        index = np.repeat(self.offsets[:-1][hypotheses] - offsets[:-1], counts) + np.arange(offsets[-1])
        return HypothesesState(
            offsets, self.weights[index], self.means[index], self.covariances[index], self.cameras[index],
            self.times[index], self.time_s, self.n_events,
        )  # fmt: skip

    def mixture(self, hypothesis: int) -> GaussianMixture:
        """Return the intensity of one hypothesis, without labels."""
        part = slice(self.offsets[hypothesis], self.offsets[hypothesis + 1])
        nobody = np.full(int(self.counts[hypothesis]), -1)
        return GaussianMixture(
            self.weights[part], self.means[part], self.covariances[part], self.cameras[part], self.times[part],
            nobody, nobody, np.zeros(len(nobody), dtype=bool),
        )  # fmt: skip


@dataclass(frozen=True)
class PhdBatch:
    """PHD filters conditional on camera hypotheses.

    The same as `PhdFilter.predict` and `PhdFilter.update` for each hypothesis (to the rounding of sums), without
    reporting objects: a component that a tracker would protect from being forgotten because it has been
    reported is not protected here.

    Attributes
    ----------
    phd : PhdFilter
        At the nominal cameras. Hypotheses share its intrinsics, lenses and detectors: only poses differ.
    threads : int
        Hypotheses are shared out over this many threads; results do not depend on it.
    """

    phd: PhdFilter
    threads: int = 1

    def __post_init__(self) -> None:
        if self.phd.sets.method not in SAMPLED_METHODS:
            raise ValueError(f"conditional filters: expected samples of {SAMPLED_METHODS}, found {self.phd.sets.method}")
        if self.phd.rig.moving:
            raise ValueError("conditional filters: expected cameras that stand still")

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.threads)

    def init(self, hypotheses: int) -> HypothesesState:
        """Return the state of k hypotheses before the first event: no objects."""
        size = self.phd.state_size
        return HypothesesState(
            np.zeros(hypotheses + 1, dtype=np.int64), np.empty(0), np.empty((0, size)), np.empty((0, size, size)),
            np.empty(0, dtype=np.int64), np.empty(0), None, 0,
        )  # fmt: skip

    def step(self, state: HypothesesState, event: Event, spaces: Array) -> tuple[HypothesesState, Array]:
        """Predict and update every hypothesis for one event.

        Parameters
        ----------
        state : HypothesesState
        event : Event
        spaces : array (k, c, 30)
            Packed disparity spaces of the cameras of each hypothesis (`hypothesis_spaces`).

        Returns
        -------
        state : HypothesesState
        log_likelihoods : array (k,)
            ln L^c of the event.
        """
        detections = self._detections(event)
        samples = self.phd.sets.turn(state.n_events)
        sets = SampleArrays(
            samples, np.ones(samples.shape[1]), self.phd.sets.reserve, self.phd.sets.reserve_weights
        )  # fmt: skip
        step = self._step(state, event)
        region = NO_REGION if self.phd.rig.region is None else self.phd.rig.region
        arrays = (state.weights, state.means, state.covariances, state.cameras, state.times)

        def run(first: int) -> tuple[Integers, MixtureArrays, Array]:
            offsets = state.offsets[first : first + CHUNK + 1]
            return phd_events(offsets, arrays, spaces[first : first + CHUNK], detections, sets, step, region)

        starts = range(0, state.size, CHUNK)
        if self.threads == 1 or len(starts) < 2:
            results = [run(first) for first in starts]
        else:
            results = list(self._pool.map(run, starts))
        counts = np.concatenate([counts for counts, _, _ in results])
        joined = [np.concatenate([mixture[i] for _, mixture, _ in results]) for i in range(5)]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        after = HypothesesState(offsets, *joined, event.time_s, state.n_events + 1)
        return after, np.concatenate([values for _, _, values in results])

    def _detections(self, event: Event) -> EventArrays:
        space = self.phd.rig.space(event.camera, event.time_s)
        means, covariances = birth_moments(event, space, self.phd.birth, self.phd.state_size)
        return EventArrays(event.points, event.covariances, event.areas, means, covariances)

    def _step(self, state: HypothesesState, event: Event) -> PhdStep:
        camera, settings, motion = self.phd.rig.cameras[event.camera], self.phd.settings, self.phd.motion
        elapsed = 0.0 if state.time_s is None else max(event.time_s - state.time_s, 0.0)
        return PhdStep(
            camera=int(event.camera),
            time_s=float(event.time_s),
            survival=float(settings.survival_per_s**elapsed),
            p_detect=float(camera.detector.p_detect),
            clutter=float(camera.detector.clutter_per_frame),
            births=float(settings.birth.per_frame),
            per_area=1.0 / (camera.width * camera.height),
            acceleration_std=np.array(motion.acceleration_std),
            max_speed=np.inf if motion.max_speed is None else float(motion.max_speed),
            minimum=minimum_in_view(self.phd.sets.size),
            reserve_minimum=FEWEST_SAMPLES,
            important=IMPORTANT_WEIGHT,
            wide=WIDE_DISPARITY,
            prune_weight=float(settings.prune_weight),
            merge_distance=float(settings.merge_distance),
            max_components=int(settings.max_components),
            mutual=bool(settings.merge_mutual),
        )


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
