"""Gaussian-mixture PHD filter on disparity space (paper VI).

``init / predict / update / extract`` over a frozen state; `step` is the four in a row. Prediction
is the particle move of every component into the disparity space of the event's camera (VI-B), split by
the field of view (VI-C); the update is eq. (5), with births from every detection; the log-likelihood of
an event is that of the conditional filter of VII-B.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereophd.disparity.moments import IN_VIEW, OUT_OF_VIEW, PARTLY_IN_VIEW, Moved, move, world_moments
from stereophd.disparity.samples import SampleSets
from stereophd.motion import Motion, Static
from stereophd.multi.association import kalman_updates, pair_likelihoods
from stereophd.multi.birth import BirthPrior, birth_moments
from stereophd.multi.events import Event, Rig
from stereophd.multi.extract import Hysteresis, select_objects
from stereophd.multi.intensity import Estimates, GaussianMixture, Info, concatenate, empty_mixture
from stereophd.multi.reduce import reduce_mixture

Array = NDArray[np.float64]

# Components from this weight on get more samples where only a corner of them is in view.
IMPORTANT_WEIGHT = 0.01


@dataclass(frozen=True)
class PhdSettings:
    """Parameters of the filter (paper, Table III).

    Attributes
    ----------
    survival_per_s : float
        Probability that an object survives one second.
    birth : BirthPrior
        Prior of new objects.
    prune_weight, merge_distance, max_components, merge_mutual : float, float, int, bool
        See `stereophd.multi.reduce.reduce_mixture`.
    hysteresis : Hysteresis
        Which components are reported.
    """

    survival_per_s: float
    birth: BirthPrior
    prune_weight: float = 1e-6
    merge_distance: float = 7.0
    max_components: int = 1000
    hysteresis: Hysteresis = field(default_factory=lambda: Hysteresis(0.5, 0.5))
    merge_mutual: bool = True


@dataclass(frozen=True)
class PhdState:
    """State after an event.

    Attributes
    ----------
    mixture : GaussianMixture
        The intensity.
    time_s : float or None
        Time of the last event, None before the first.
    n_events : int
        Events so far: picks the sample set.
    next_label, next_track : int
        First unused label and identity.
    """

    mixture: GaussianMixture
    time_s: float | None
    n_events: int
    next_label: int
    next_track: int


@dataclass(frozen=True)
class PhdPrediction:
    """The surviving intensity, and its components carried into the event's disparity space."""

    mixture: GaussianMixture
    moved: Moved


@dataclass(frozen=True)
class PhdFilter:
    """The filter: cameras, motion, samples and settings.

    Attributes
    ----------
    rig : Rig
    motion : Motion
    sets : SampleSets
        Shared by all components of a step.
    settings : PhdSettings
    threads : int
        Threads of the sample trips; results do not depend on it.
    """

    rig: Rig
    motion: Motion
    sets: SampleSets
    settings: PhdSettings
    threads: int = 1

    def init(self) -> PhdState:
        """Return the state before the first event: no objects."""
        size = 3 if isinstance(self.motion, Static) else 6
        return PhdState(empty_mixture(size), None, 0, 0, 0)

    def predict(self, state: PhdState, event: Event) -> PhdPrediction:
        """Let objects survive, move and come into the event's disparity space."""
        elapsed = 0.0 if state.time_s is None else max(event.time_s - state.time_s, 0.0)
        mixture = state.mixture
        mixture = mixture.with_weights(mixture.weights * self.settings.survival_per_s**elapsed)
        moved = move(
            mixture.means,
            mixture.covariances,
            self.rig.spaces(mixture.cameras, mixture.times),
            event.time_s - mixture.times,
            self.rig.space(event.camera, event.time_s),
            self.motion,
            self.sets,
            state.n_events,
            self.rig.cameras[event.camera].detector.p_detect,
            mixture.weights >= IMPORTANT_WEIGHT,
            self.threads,
        )
        return PhdPrediction(mixture, moved)

    def update(self, state: PhdState, prediction: PhdPrediction, event: Event) -> tuple[PhdState, Info]:
        """Update with the detections of an event: eq. (5), then reduction."""
        settings, mixture, moved = self.settings, prediction.mixture, prediction.moved
        camera = self.rig.cameras[event.camera]
        p_detect = camera.detector.p_detect
        per_area = 1.0 / (camera.width * camera.height)
        detected = p_detect * moved.fraction * mixture.weights
        pairs = pair_likelihoods(
            moved.means, moved.covariances, moved.status != OUT_OF_VIEW, event.points, event.covariances,
            event.areas,
        )  # fmt: skip
        components, detections, densities = pairs
        # clutter, births and components compete for every detection
        born = p_detect * settings.birth.per_frame
        background = (camera.detector.clutter_per_frame + born) * per_area
        joint = detected[components] * densities
        totals = background + np.bincount(detections, weights=joint, minlength=len(event.points))
        log_likelihood = float(np.log(totals).sum() - camera.detector.clutter_per_frame - born - detected.sum())
        weights = joint / totals[detections]
        kept = weights >= settings.prune_weight
        updated = self._updated(prediction, event, components[kept], detections[kept], weights[kept])
        births = self._births(event, np.asarray(born * per_area / totals), state.next_label)
        whole = concatenate([_missed(prediction, event, p_detect), updated, births])
        reduced = reduce_mixture(
            whole, settings.prune_weight, settings.merge_distance, settings.max_components, settings.merge_mutual
        )
        info = Info(log_likelihood, float(reduced.weights.sum()), len(reduced))
        label = state.next_label + len(event.points)
        return PhdState(reduced, event.time_s, state.n_events + 1, label, state.next_track), info

    def extract(self, state: PhdState) -> tuple[PhdState, Estimates]:
        """Report the objects of a state, in the world at the state's time."""
        chosen = select_objects(state.mixture, self.settings.hysteresis, state.next_label, state.next_track)
        state = PhdState(chosen.mixture, state.time_s, state.n_events, chosen.next_label, chosen.next_track)
        parts = chosen.mixture.take(chosen.index)
        time_s = 0.0 if state.time_s is None else state.time_s
        means, covariances = world_moments(
            parts.means, parts.covariances, self.rig.spaces(parts.cameras, parts.times),
            time_s - parts.times, self.motion, self.sets, state.n_events,
        )  # fmt: skip
        finite = np.isfinite(means).all(axis=1)
        order = np.flatnonzero(finite)[np.argsort(parts.tracks[finite], kind="stable")]
        return state, Estimates(parts.tracks[order], means[order], covariances[order], chosen.existence[order])

    def step(self, state: PhdState, event: Event) -> tuple[PhdState, Info, Estimates]:
        """Predict, update and extract for one event."""
        state, info = self.update(state, self.predict(state, event), event)
        state, estimates = self.extract(state)
        return state, info, estimates

    def _updated(
        self,
        prediction: PhdPrediction,
        event: Event,
        components: NDArray[np.int64],
        detections: NDArray[np.int64],
        weights: Array,
    ) -> GaussianMixture:
        moved, mixture = prediction.moved, prediction.mixture
        means, covariances = kalman_updates(
            moved.means, moved.covariances, components, detections, event.points, event.covariances
        )
        return GaussianMixture(
            weights, means, covariances, np.full(len(weights), event.camera),
            np.full(len(weights), event.time_s), mixture.labels[components], mixture.tracks[components],
            mixture.reported[components],
        )  # fmt: skip

    def _births(self, event: Event, weights: Array, next_label: int) -> GaussianMixture:
        size = 3 if isinstance(self.motion, Static) else 6
        space = self.rig.space(event.camera, event.time_s)
        means, covariances = birth_moments(event, space, self.settings.birth, size)
        count = len(weights)
        return GaussianMixture(
            weights, means, covariances, np.full(count, event.camera), np.full(count, event.time_s),
            next_label + np.arange(count), np.full(count, -1), np.zeros(count, dtype=bool),
        )  # fmt: skip


def _missed(prediction: PhdPrediction, event: Event, p_detect: float) -> GaussianMixture:
    """The intensity of objects that the event did not detect.

    Components wholly in view stay in the event's space; others go home, where they are Gaussian.
    """
    mixture, moved = prediction.mixture, prediction.moved
    weights = mixture.weights * (1.0 - p_detect * moved.fraction)
    whole = moved.status == IN_VIEW
    partly = moved.status == PARTLY_IN_VIEW
    means, covariances = mixture.means.copy(), mixture.covariances.copy()
    means[whole], covariances[whole] = moved.means[whole], moved.covariances[whole]
    means[partly], covariances[partly] = moved.missed_means[partly], moved.missed_covariances[partly]
    return GaussianMixture(
        weights, means, covariances, np.where(whole, event.camera, mixture.cameras),
        np.where(whole, event.time_s, mixture.times), mixture.labels, mixture.tracks, mixture.reported,
    )  # fmt: skip
