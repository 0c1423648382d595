"""Estimate the detectors of cameras from a log (``detector: estimate``), in a few passes of the filter."""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera, Detector
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
from stereophd.pipeline.tracking.loop import FORGET_EVERY, Estimator, RunState, run_estimator

# Frames of a log that are looked at, stretches of it that a filter runs over, events and detections of them all: more
# add little, and the time stays bounded for logs of any length.
MOST_FRAMES, STRETCHES, MOST_EVENTS, MOST_DETECTIONS = 20_000, 6, 1500, 12_000
# Frames of each camera in a stretch, at least: in fewer no track is settled.
LEAST_FRAMES = 10
# Passes end when no value changes by more than this share (probabilities of detection: of the misses) or this part
# of its standard error.
MOST_PASSES = 5
CONVERGED = 0.02
CONVERGED_ERRORS = 0.5
# Stated error of the noise from rays from which the filter is asked for another, and by how many of them at most.
LEAST_UNSURE, MOST_ERRORS = 0.2, 2.0
# Detections of a tentative object that chance gives.
CHANCE_PAIR = 2
# After the last of them, changes below this share are no finding.
NEARLY_CONVERGED = 0.15


LOGGER = logging.getLogger("stereophd")


class _Settled:
    """Labels that are confirmed and were seen by two cameras; the counts of the frames since their last detection."""

    def __init__(self) -> None:
        self.seen_by: dict[int, set[int]] = {}
        self.confirmed: set[int] = set()
        self._waiting: dict[int, dict[int, list[float]]] = {}

    def labels(self) -> NDArray[np.int64]:
        """Return the labels that are confirmed and were seen by two cameras."""
        found = [label for label in self.confirmed if len(self.seen_by.get(label, ())) > 1]
        return np.array(found, dtype=np.int64)

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
                sums[index].detected += hits
                sums[index].missed += misses

    def keep(self, labels: Collection[int]) -> None:
        """Forget all labels but these."""
        self.confirmed &= set(labels)
        self.seen_by = {label: cameras for label, cameras in self.seen_by.items() if label in labels}
        self._waiting = {label: waiting for label, waiting in self._waiting.items() if label in labels}


class _Watched:
    """A filter in the loop that also collects the evidence of every event on the detectors."""

    def __init__(self, estimator: Estimator[Any]) -> None:
        self.rig = estimator.rig
        points = isinstance(estimator, DisparityFilter)  # boxes are not left out by the region
        shares = estimator.rig.shares_of_view() if points else [1.0] * len(estimator.rig.cameras)
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
            sighting = observe(sums, prediction, event, camera.at(event.time_s), space, settled, not event.own_noise)
            return after, info, estimates, sighting
        # imported here: what it needs of SciPy is costly to import
        from stereophd.core.bodies.filter import BodyFilter
        from stereophd.pipeline.detectors.bodies import observe_bodies

        assert isinstance(self._estimator, BodyFilter)
        predicted = self._estimator.predict(state, event)
        sighting = observe_bodies(sums, predicted, info, event, camera.at(event.time_s), self._estimator.shape, settled)
        return after, info, estimates, sighting

    def forecast(self, state: Any, info: Info, time_s: float) -> tuple[Info, Estimates]:
        """Return the objects at a time between two events."""
        return self._estimator.forecast(state, info, time_s)

    def _forget(self, alive: set[int]) -> None:
        """Forget all labels but these."""
        self._settled.keep(alive)
        for each in self.sums:
            each.previous = {label: residual for label, residual in each.previous.items() if label in alive}


def stretches(stream: EventStream) -> list[EventStream]:
    """Return stretches of a log in memory, spread over its first `MOST_FRAMES` frames: all of it if it is short."""
    frames = list(islice(stream.frames, MOST_FRAMES))
    detections = sum(len(frame.pixels) for frame in frames)
    most = int(min(MOST_EVENTS, len(frames) * MOST_DETECTIONS / max(detections, 1)))
    least = LEAST_FRAMES * len(stream.cameras)
    count = min(max(most // least, 1), STRETCHES)
    length = max(most // count, least)
    if count * length >= len(frames):
        return [EventStream(stream.cameras, frames)]
    starts = np.linspace(0, len(frames) - length, count).astype(int)
    return [EventStream(stream.cameras, frames[start : start + length]) for start in starts.tolist()]


def _pass(estimator: Estimator[Any], parts: Iterable[EventStream]) -> tuple[list[DetectorSums], bool]:
    """Run over stretches of a log once; return the sums of every camera, and whether the log states its own noise."""
    watched = _Watched(estimator)
    sums = {camera.name: own for camera, own in zip(estimator.rig.cameras, watched.sums, strict=True)}
    for part in parts:
        run = RunState(watched.init())
        for record in run_estimator(watched, part, run=run):
            sums[record.camera].frames += 1
            sums[record.camera].detections += record.n_detections
            sums[record.camera].outside += record.outside
            for counts in record.attributed.values():
                for name, count in counts.items():
                    sums[name].attributed += count
        for counts in run.attribution.pending.values():
            for name, count in counts.items():
                sums[name].undecided += count if sum(counts.values()) > CHANCE_PAIR else 0
    return watched.sums, watched.own_noise


def estimate_detectors(
    cameras: tuple[Camera, ...],
    priors: Mapping[str, NoisePrior],
    build_filter: Callable[[tuple[Camera, ...]], Estimator[Any]],
    parts: Sequence[EventStream],
) -> tuple[tuple[Camera, ...], dict[str, Any]]:
    """Estimate noise, probability of detection and clutter of cameras from a log.

    What tracks do not confirm goes back to what was known before them.

    Parameters
    ----------
    cameras : tuple of Camera
        With the values to start from (`stereophd.pipeline.detectors.ray_noise.starting_detectors`).
    priors : mapping
        Name -> what is known of the noise, of the cameras whose detectors are estimated; the others stay as they are.
    build_filter : callable
        Makes a labelled filter of cameras.
    parts : sequence of EventStream
        Stretches of the log (`stretches`).

    Returns
    -------
    cameras : tuple of Camera
        With the estimates in place.
    report : dict
        For ``report.json``: by camera the values, their standard errors and the numbers behind them, and whether the
        log states the noise of its detections.
    """
    cameras, priors = _most_probable(cameras, priors, build_filter, parts)
    started = cameras
    estimates: dict[str, DetectorEstimate] = {}
    passes, converged, nearly, own_noise = 0, False, False, False
    while passes < MOST_PASSES and not converged:
        passes += 1
        sums, own_noise = _pass(build_filter(cameras), [part.with_cameras(cameras) for part in parts])
        converged = nearly = True
        for camera, mine in zip(cameras, sums, strict=True):
            if camera.name in priors:
                prior = priors[camera.name]
                mine = mine.with_noise_of(sums) if prior.boxes else mine
                estimate = estimates[camera.name] = estimate_detector(mine, camera.detector, prior)
                converged = converged and _agree(camera.detector, estimate, prior, CONVERGED)
                nearly = nearly and _agree(camera.detector, estimate, prior, NEARLY_CONVERGED)
        cameras = _with_detectors(cameras, {name: estimate.detector for name, estimate in estimates.items()})
        texts = [_text(name, estimate) for name, estimate in estimates.items()]
        LOGGER.info("detectors, pass %d: %s", passes, "; ".join(texts))
    for camera in started:
        if camera.name in priors and not (estimates[camera.name].confirmed or own_noise):
            last = estimates[camera.name].detector
            prior = priors[camera.name]
            back = prior.put(last, prior.noise)
            estimates[camera.name] = replace(estimates[camera.name], detector=back, noise=prior.noise)
    estimates = {name: estimate.lasting(priors[name]) for name, estimate in estimates.items()}
    cameras = _with_detectors(cameras, {name: estimate.detector for name, estimate in estimates.items()})
    report = {name: _report(estimate, priors[name]) for name, estimate in estimates.items()}
    return cameras, {"passes": passes, "converged": nearly, "noise_in_log": own_noise, "cameras": report}


def _most_probable(
    cameras: tuple[Camera, ...],
    priors: Mapping[str, NoisePrior],
    build_filter: Callable[[tuple[Camera, ...]], Estimator[Any]],
    parts: Sequence[EventStream],
) -> tuple[tuple[Camera, ...], Mapping[str, NoisePrior]]:
    """Return cameras and priors with the noise at which the filter finds the log most probable, so many errors away.

    Where rays hardly know the noise, no tracks begin with a wrong one that could correct it.
    """
    if max((prior.spread for prior in priors.values()), default=0.0) < LEAST_UNSURE:
        return cameras, priors

    @cache
    def moved(errors: float) -> tuple[float, tuple[Camera, ...], Mapping[str, NoisePrior]]:
        """Return the evidence for so many errors more, and what it is for."""
        away = {name: replace(one, noise=one.noise * np.exp(errors * one.spread)) for name, one in priors.items()}
        noisy = {
            one.name: away[one.name].put(one.detector, away[one.name].noise) for one in cameras if one.name in away
        }
        used = _with_detectors(cameras, noisy)
        records = (record for part in parts for record in run_estimator(build_filter(used), part.with_cameras(used)))
        return sum(record.info.log_likelihood for record in records) - 0.5 * errors**2, used, away

    errors = 0.0
    for step in (1.0, -1.0):
        while abs(errors + step) <= MOST_ERRORS and moved(errors + step)[0] > moved(errors)[0]:
            errors += step
    return moved(errors)[1:]


def _with_detectors(cameras: tuple[Camera, ...], detectors: Mapping[str, Detector]) -> tuple[Camera, ...]:
    """Return cameras with other detectors."""
    return tuple(replace(camera, detector=detectors.get(camera.name, camera.detector)) for camera in cameras)


def _agree(present: Detector, estimate: DetectorEstimate, prior: NoisePrior, share: float) -> bool:
    """Whether a pass has changed nothing that matters."""
    new = estimate.detector

    def close(old: float, value: float, scale: float, error: float | None) -> bool:
        return error is None or abs(old - value) <= max(share * scale, CONVERGED_ERRORS * error)

    noise = estimate.noise.tolist()
    sigmas = zip(prior.of(present).tolist(), noise, noise, estimate.noise_error.tolist(), strict=True)
    clutter = new.clutter_per_frame
    return (
        all(close(*sigma) for sigma in sigmas)
        and close(present.p_detect, new.p_detect, 1.0 - new.p_detect, estimate.p_detect_error)
        and close(present.clutter_per_frame, clutter, clutter, estimate.clutter_error)
    )


def _text(name: str, estimate: DetectorEstimate) -> str:
    detector = estimate.detector
    return (
        f"{name} noise {', '.join(f'{value:.3g}' for value in estimate.noise.tolist())}, "
        f"p_detect {detector.p_detect:.3f}, clutter {detector.clutter_per_frame:.3g} per frame"
    )


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
