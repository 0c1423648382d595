"""Estimate the detectors of cameras from a log (``detector: estimate``), in a few runs of the filter."""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.pipeline.detectors.statistics import (
    DetectorEstimate,
    DetectorSums,
    NoisePrior,
    Sighting,
    estimate_detector,
    observe,
)
from stereophd.pipeline.stream import EventStream
from stereophd.pipeline.tracking.knocked import NO_TEST
from stereophd.pipeline.tracking.loop import FORGET_EVERY, Estimator, RunState, run_estimator

# Frames of a log that are looked at, stretches of it that a filter runs over, events of them all, and detections, of
# boxes half as many, which have twice the numbers: more add little, and the time stays bounded for logs of any length.
MOST_FRAMES, STRETCHES, MOST_EVENTS, MOST_DETECTIONS, MOST_BOXES = 20_000, 6, 1500, 12_000, 6000
# Frames of each camera in a stretch, at least: in fewer no track is settled.
LEAST_FRAMES = 10
# Log-likelihood that a change must gain, and runs of the filter at most.
LEAST_GAIN, MOST_RUNS = 0.5, 100
# Detections of a tentative object that chance gives.
CHANCE_PAIR = 2

LOGGER = logging.getLogger("stereophd")


class _Settled:
    """Labels that are confirmed and were seen by two cameras; the counts of the frames since their last detection."""

    def __init__(self) -> None:
        self.seen_by: dict[int, set[int]] = {}
        self.confirmed: set[int] = set()
        self._waiting: dict[int, dict[int, list[float]]] = {}
        self._counts: dict[tuple[int, int], NDArray[np.float64]] = {}

    def labels(self) -> NDArray[np.int64]:
        """Return the labels that are confirmed and were seen by two cameras."""
        return np.array([label for label in self.confirmed if len(self.seen_by.get(label, ())) > 1], dtype=np.int64)

    def count(self, label: int, camera: int, detected: float, missed: float, sums: list[DetectorSums]) -> None:
        """Keep the counts of a frame for a track until the track is detected again."""
        if detected + missed <= 0.0:  # the camera never misses by its settings: nothing to estimate
            return
        waiting = self._waiting.setdefault(label, {}).setdefault(camera, [0.0, 0.0])
        # seen again later, it existed all the time
        waiting[0] += detected / (detected + missed)
        waiting[1] += missed / (detected + missed)
        if detected > missed:
            for index, (hits, misses) in self._waiting.pop(label).items():
                if (label, index) not in self._counts:
                    self._counts[label, index] = np.zeros(2)
                    sums[index].looks.append(self._counts[label, index])
                self._counts[label, index] += hits, misses

    def keep(self, labels: Collection[int]) -> None:
        """Forget all labels but these."""
        self.confirmed &= set(labels)
        self.seen_by = {label: cameras for label, cameras in self.seen_by.items() if label in labels}
        self._waiting = {label: waiting for label, waiting in self._waiting.items() if label in labels}


class _Watched:
    """A filter in the loop that also collects the evidence of every event on the detectors."""

    def __init__(self, estimator: Estimator[Any]) -> None:
        self.rig = estimator.rig
        shares = [1.0] * len(estimator.rig.cameras)  # boxes are not left out by the region
        if isinstance(estimator, DisparityFilter):
            estimator, shares = replace(estimator, claims=True), estimator.rig.shares_of_view()
        self.sums = [DetectorSums(view=share) for share in shares]
        self.own_noise = False
        self._estimator = estimator
        self._settled = _Settled()
        self._n_events = 0

    def init(self) -> Any:
        """Return the state before the first event of a stretch, whose labels begin anew."""
        self._settled = _Settled()
        self._forget(set())
        return self._estimator.init()

    def step(self, state: Any, event: Event) -> tuple[Any, Info, Estimates]:
        """Return the state after an event, which is compared with its prediction."""
        sums, settled = self.sums, self._settled
        self.own_noise |= event.own_noise
        state, info, estimates, sighting = self._look(state, event)
        probabilities = zip(sighting.detected.tolist(), sighting.missed.tolist(), strict=True)
        for label, (detected, missed) in zip(sighting.labels.tolist(), probabilities, strict=True):
            settled.count(label, event.camera, detected, missed, sums)
        # of settled tracks as probably as they made it, where another detection, or none, may have been theirs
        sums[event.camera].attributed += float((sighting.detected - np.isin(sighting.labels, info.detected)).sum())
        sums[event.camera].doubtful += float((sighting.detected * (1.0 - sighting.detected)).sum())
        for label in info.detected.tolist():
            settled.seen_by.setdefault(label, set()).add(event.camera)
        settled.confirmed.update(estimates.labels.tolist())
        if self._n_events % FORGET_EVERY == 0:
            self._forget(set(state.labels.tolist()))
        self._n_events += 1
        return state, info, estimates

    def _look(self, state: Any, event: Event) -> tuple[Any, Info, Estimates, Sighting]:
        """Return the state after an event, and what the event shows of the settled tracks."""
        sums, settled, camera = self.sums[event.camera], self._settled.labels(), self.rig.cameras[event.camera]
        after, info, estimates = self._estimator.step(state, event)
        if isinstance(self._estimator, DisparityFilter):
            prediction = self._estimator.predict(state, event)
            space = self.rig.space(event.camera, event.time_s)
            sighting = observe(
                sums, prediction, event, info.claims, camera.at(event.time_s), space, settled, not event.own_noise
            )
            return after, replace(info, claims=None), estimates, sighting
        from stereophd.core.bodies.filter import BodyFilter  # needs parts of SciPy that are costly to import
        from stereophd.pipeline.detectors.bodies import observe_bodies

        assert isinstance(self._estimator, BodyFilter)
        predicted = self._estimator.predict(state, event)
        sighting = observe_bodies(sums, predicted, info, event, camera.at(event.time_s), self._estimator.shape, settled)
        return after, info, estimates, sighting

    def forecast(self, state: Any, info: Info, time_s: float) -> tuple[Info, Estimates]:
        """Return the objects at a time between two events."""
        return self._estimator.forecast(state, info, time_s)

    def _forget(self, alive: set[int]) -> None:
        self._settled.keep(alive)
        for each in self.sums:
            each.previous = {label: residual for label, residual in each.previous.items() if label in alive}


def stretches(stream: EventStream, most_detections: int = MOST_DETECTIONS) -> list[EventStream]:
    """Return stretches of a log in memory, spread over its first `MOST_FRAMES` frames: all of it if it is short."""
    frames = list(islice(stream.frames, MOST_FRAMES))
    detections = sum(len(frame.pixels) for frame in frames)
    most = int(min(MOST_EVENTS, len(frames) * most_detections / max(detections, 1)))
    least = LEAST_FRAMES * len(stream.cameras)
    count = min(max(most // least, 1), STRETCHES)
    length = max(most // count, least)
    if count * length >= len(frames):
        return [EventStream(stream.cameras, frames)]
    starts = np.linspace(0, len(frames) - length, count).astype(int)
    return [EventStream(stream.cameras, frames[start : start + length]) for start in starts.tolist()]


@dataclass(frozen=True)
class _Run:
    """What a run of the filter over stretches of a log shows of its detectors."""

    cameras: tuple[Camera, ...]
    estimates: dict[str, DetectorEstimate]  # What its tracks show
    log_likelihood: float
    own_noise: bool  # Whether the log states its own noise


def _run(
    build_filter: Callable[[tuple[Camera, ...]], Estimator[Any]],
    parts: Iterable[EventStream],
    cameras: tuple[Camera, ...],
    priors: Mapping[str, NoisePrior],
) -> _Run:
    """Run over stretches of a log once."""
    watched, likelihood = _Watched(build_filter(cameras)), 0.0
    sums = {camera.name: own for camera, own in zip(cameras, watched.sums, strict=True)}
    for part in parts:
        run = RunState(watched.init(), knocks=NO_TEST)
        for record in run_estimator(watched, part.with_cameras(cameras), run=run):
            likelihood += record.info.log_likelihood
            sums[record.camera].frames += 1
            sums[record.camera].detections += record.n_detections
            sums[record.camera].outside += record.outside
            for counts in record.attributed.values():
                for name, count in counts.items():
                    sums[name].attributed += count
        for counts in run.attribution.pending.values():
            for name, count in counts.items():
                sums[name].undecided += count if sum(counts.values()) > CHANCE_PAIR else 0
    estimates = {}
    for camera in cameras:
        if (prior := priors.get(camera.name)) is not None:
            shown = sums[camera.name].with_noise_of(watched.sums) if prior.boxes else sums[camera.name]
            estimates[camera.name] = estimate_detector(shown, camera.detector, prior)
    return _Run(cameras, estimates, likelihood, watched.own_noise)


def _with_estimates(cameras: tuple[Camera, ...], estimates: Mapping[str, DetectorEstimate]) -> tuple[Camera, ...]:
    known = {name: estimate.detector for name, estimate in estimates.items()}
    return tuple(replace(camera, detector=known.get(camera.name, camera.detector)) for camera in cameras)


def estimate_detectors(
    cameras: tuple[Camera, ...],
    priors: Mapping[str, NoisePrior],
    build_filter: Callable[[tuple[Camera, ...]], Estimator[Any]],
    parts: Sequence[EventStream],
) -> tuple[tuple[Camera, ...], dict[str, Any]]:
    """Estimate noise, probability of detection and clutter of cameras from a log.

    The filter runs with what the tracks of the run before show, as long as that makes the log more probable. A noise
    that its tracks do not confirm goes back to what was known before them.

    The cameras have the values to start from, and `priors`, name -> what is known of the noise, are those of the
    cameras whose detectors are estimated (`stereophd.pipeline.detectors.ray_noise.starting_detectors`); the others stay
    as they are. `build_filter` makes a labelled filter of cameras, `parts` are `stretches` of the log. Returns the
    cameras with the estimates in place, and a report for ``report.json``: by camera the values, their standard errors
    and the numbers behind them, and whether the log states the noise of its detections.
    """
    best, runs = _run(build_filter, parts, cameras, priors), 1
    while runs < MOST_RUNS:
        tried, runs = _run(build_filter, parts, _with_estimates(best.cameras, best.estimates), priors), runs + 1
        LOGGER.info("detectors, run %d: log-likelihood %.1f", runs, tried.log_likelihood)
        if tried.log_likelihood <= best.log_likelihood + LEAST_GAIN:
            break
        best = tried
    final = {}
    for camera in best.cameras:
        if (prior := priors.get(camera.name)) is not None:
            estimate = best.estimates[camera.name]
            noise = prior.of(camera.detector) if estimate.confirmed or best.own_noise else prior.noise
            # the run had another probability of detection than its tracks show: that of the run before
            apart = camera.detector.p_detect - estimate.detector.p_detect
            error = float(np.hypot(estimate.p_detect_error, apart))
            detector = prior.put(camera.detector, noise)
            estimate = replace(estimate, detector=detector, noise=noise, p_detect_error=error)
            final[camera.name] = estimate.lasting(prior)
    report = {name: _report(estimate, priors[name]) for name, estimate in final.items()}
    found = {"passes": runs, "converged": runs < MOST_RUNS, "noise_in_log": best.own_noise, "cameras": report}
    return _with_estimates(best.cameras, final), found


def _report(estimate: DetectorEstimate, prior: NoisePrior) -> dict[str, Any]:
    detector, noise = estimate.detector, "box_noise" if prior.boxes else "sigma_px"
    return {
        noise: estimate.noise.tolist(),
        "p_detect": detector.p_detect,
        "clutter_per_frame": detector.clutter_per_frame,
        f"{noise}_standard_error": estimate.noise_error.tolist(),
        "p_detect_standard_error": estimate.p_detect_error,
        "clutter_per_frame_standard_error": estimate.clutter_error,
        "residual_correlation": None if estimate.correlation is None else estimate.correlation.tolist(),
        **({} if prior.boxes else {"noise_of_rays_px": prior.noise.tolist()}),
        "residual_ratio": estimate.residual_ratio,
        "confirmed": estimate.confirmed,
        "residuals": estimate.residuals,
        "in_view": estimate.in_view,
        "frames": estimate.frames,
        "outside_region_per_frame": estimate.outside_per_frame,
    }
