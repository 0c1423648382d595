"""Many objects: a simulated scene, tracked, scored by OSPA over time (paper VIII-C, Figure 12).

Run k is the scene of run k of several runs of ``simulate``, tracked as ``track`` does and scored as ``evaluate`` does,
without the files between.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stereophd.config.experiment import MultiObjectScenario
from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array, Integers
from stereophd.core.bounds.known_association import AssociatedDetections, noiseless_paths, sight
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.distances.ospa import score_scans
from stereophd.core.metrics.scans import PointSets
from stereophd.core.metrics.truth.interpolation import DEFAULT_GAP_STEPS, Truth, align_truth, last_event_of_each_time
from stereophd.core.motion.base import Motion
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.numerics.random_streams import RUN_FRAMES, RUN_OBJECTS
from stereophd.core.simulation.detections import CLUTTER_ID, Scene, simulate_frames, truth_rows
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Kind, Series, frames_in_order, method_clock, scenario_of
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.simulation import build_scene, scene_motion, simulate_section
from stereophd.pipeline.stream import EventStream
from stereophd.pipeline.tracking.tracking_run import reported_records


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless the configuration has cameras, a filter and a scene to simulate."""
    config = loaded.config
    cameras = loaded.build_cameras()
    simulate_section(loaded)
    build_filter(config, cameras, loaded.path)
    if scenario_of(loaded.config, MultiObjectScenario).tracker == "known_association" and scene_motion(config).noisy:
        raise InputError(
            f"{loaded.path}: simulate.acceleration_std: expected 0 with the tracker known_association, which fits "
            "paths without noise, found another value"
        )


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return OSPA and the error of the number of objects over time, of one run."""
    config = loaded.config
    scene, frames = simulated(loaded, number)
    cameras, truth = scene.cameras, scene_truth(scene)
    event_times = np.array([frame.time_s for frame in frames])
    last = last_event_of_each_time(event_times)
    aligned = align_truth(truth, event_times[last], DEFAULT_GAP_STEPS * truth.step_s)
    scenario = scenario_of(config, MultiObjectScenario)
    with method_clock():
        if scenario.tracker == "filter":
            estimates = filtered_points(loaded, cameras, frames, last, scenario.tentative)
        else:
            estimates = _known(loaded, cameras, frames, event_times[last], aligned.points, scene.motion)
    usable = ~(aligned.outside | aligned.gap)
    return _scores(loaded, event_times[last][usable], estimates.keep_scans(usable), aligned.points.keep_scans(usable))


def simulated(loaded: LoadedConfig, number: int) -> tuple[Scene, list[Frame]]:
    """Return the scene of a run, and its frames in order of time."""
    seed = loaded.config.seed
    scene = build_scene(loaded.config, loaded.build_cameras(), RUN_OBJECTS.seed(seed, number))
    return scene, frames_in_order(scene.cameras, simulate_frames(scene, RUN_FRAMES.seed(seed, number)))


def scene_truth(scene: Scene) -> Truth:
    """Return the true states of the objects of a scene."""
    times, identifiers, states = (np.concatenate(part) for part in zip(*truth_rows(scene), strict=True))
    order = np.lexsort((times, identifiers))
    return Truth(times[order], identifiers[order], states[order, :3], states[order, 3:])


def filtered_points(
    loaded: LoadedConfig, cameras: Sequence[Camera], frames: Sequence[Frame], last: np.ndarray, tentative: bool = False
) -> PointSets:
    """Track with the configuration's filter; return what it reports after the events `last`, also tentatively."""
    config = loaded.config
    # detections can be chosen anew only by tracks that know theirs
    claims = config.report.smooth is not None and config.report.smooth.reassociate
    multi_filter = replace(build_filter(config, tuple(cameras), loaded.path), claims=claims)
    stream = EventStream(tuple(cameras), frames)
    # scored after every event, not at the times of reports
    report = config.report.model_copy(update={"times": "events"})
    records = reported_records(multi_filter, multi_filter.motion, stream, report, reach_back=True)
    estimates = [record.estimates for record in records]
    if tentative:
        estimates = [reported.with_tentative() for reported in estimates]
    if config.report.max_position_std is not None:
        estimates = [reported.certain(config.report.max_position_std) for reported in estimates]
    return points_of_estimates([estimates[event] for event in last.tolist()])


def points_of_estimates(estimates: Sequence[Estimates]) -> PointSets:
    """Return reported objects as sets of points, one per scan."""
    start = np.concatenate([[0], np.cumsum([len(scan.track_ids) for scan in estimates])]).astype(np.int64)
    every = estimates[0].join(*estimates[1:])
    return PointSets(start, every.states[:, :3], every.states[:, 3:], every.track_ids, every.covariances[:, :3, :3])


def associated(
    loaded: LoadedConfig, cameras: Sequence[Camera], frames: Sequence[Frame], labels: Integers
) -> tuple[AssociatedDetections, list[tuple[DisparitySpace, float, Array] | None]]:
    """Return the true detections of objects with these labels, and what saw each first, when, and where."""
    baseline, rectification = loaded.config.disparity.baseline, loaded.config.disparity.rectification
    parts = []
    first: list[tuple[DisparitySpace, float, Array] | None] = [None] * len(labels)
    for frame in frames:
        camera, time_s = cameras[frame.camera], frame.time_s
        assert frame.object_id is not None
        true = (frame.object_id != CLUTTER_ID) & np.isin(frame.object_id, labels)
        parts.append(sight(camera, time_s, frame.pixels[true], np.searchsorted(labels, frame.object_id[true])))
        for row, point in zip(parts[-1].row.tolist(), parts[-1].points, strict=True):
            if first[row] is None:
                first[row] = DisparitySpace(camera.at(time_s), baseline, rectification), time_s, point
    return parts[0].join(*parts[1:]), first


def _known(
    loaded: LoadedConfig,
    cameras: Sequence[Camera],
    frames: Sequence[Frame],
    times_s: Array,
    truth: PointSets,
    motion: Motion,
) -> PointSets:
    """Fit paths without noise to the detections of every object; those that exist and were seen are reported."""
    multi_filter = build_filter(loaded.config, tuple(cameras), loaded.path)
    labels = np.unique(truth.label)
    detections, first = associated(loaded, cameras, frames, labels)
    states, covariances, seen = noiseless_paths(detections, first, multi_filter.settings.birth, times_s, motion)
    exists = np.zeros(seen.shape, dtype=bool)
    exists[truth.scan, np.searchsorted(labels, truth.label)] = True
    scan, row = np.nonzero(seen & exists)
    start = np.searchsorted(scan, np.arange(len(times_s) + 1)).astype(np.int64)
    chosen = states[scan, row]
    return PointSets(start, chosen[:, :3], chosen[:, 3:], labels[row], covariances[scan, row][:, :3, :3])


def _scores(loaded: LoadedConfig, times_s: Array, estimates: PointSets, truth: PointSets) -> list[Series]:
    unit = loaded.config.units.length
    series = []
    for settings in scenario_of(loaded.config, MultiObjectScenario).ospa:
        mahalanobis = settings.base == "mahalanobis"
        scores = score_scans(estimates, truth, settings.order, settings.cutoff, mahalanobis=mahalanobis)
        series.append(Series(settings.quantity, "1" if mahalanobis else unit, scores.ospa.distance, times_s))
    surplus = (estimates.counts - truth.counts).astype(np.float64)
    return [*series, Series("cardinality_bias", "1", surplus, times_s)]


# No bounds: the limit of OSPA is the method of known association.
KIND = Kind(run, lambda loaded: [], check)
