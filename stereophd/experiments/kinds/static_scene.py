"""Feature correspondence: points that stand still, seen in several views, unlabelled and among clutter (paper VI).

Run k is the scene of run k of several runs of ``simulate``, tracked with ``motion.model: static``. The landmarks after
the last view are scored: the number of points found, their accuracy relative to the bound, and the assignment of the
detections of each view to landmarks (one to one, of least squared Mahalanobis distance).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.config.experiment import StaticSceneScenario
from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.bounds.cramer_rao import static_point_information
from stereophd.core.bounds.known_association import AssociatedDetections, sight
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import projective
from stereophd.core.metrics.distances.ospa import score_scans
from stereophd.core.metrics.matching.near_pairs import least_cost
from stereophd.core.metrics.scans import PointSets
from stereophd.core.simulation.detections import CLUTTER_ID
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Kind, Series, method_clock, scenario_of
from stereophd.experiments.kinds.multi_object import associated, filtered_points, scene_truth, simulated
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.simulation import simulate_section

# Squared Mahalanobis distance beyond which a detection is not that of a landmark: 99.99 % of a pixel's.
GATE = 18.4


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless there are cameras, a filter, a scene, and a static motion model."""
    config = loaded.config
    simulate_section(loaded)
    if build_filter(config, loaded.build_cameras(), loaded.path).motion.moves:
        raise InputError(f"{loaded.path}: motion.model: expected static, found {config.motion.model}")


@dataclass(frozen=True)
class _Views:
    """The views of a run: frames in order of time, with the true points and what bounds their estimates."""

    cameras: tuple[Camera, ...]
    frames: list[Frame]
    labels: np.ndarray
    positions: Array
    detections: AssociatedDetections
    information: Array


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return the scores of one run: points found, their errors, and detections assigned to the right point."""
    views = _views(loaded, number)
    times = np.array([frame.time_s for frame in views.frames])
    with method_clock():
        points = filtered_points(loaded, views.cameras, views.frames, np.arange(len(times)))
    count = len(views.labels)
    start = count * np.arange(len(times) + 1)
    truth = PointSets(
        start, np.tile(views.positions, (len(times), 1)), np.zeros((count * len(times), 3)),
        np.tile(views.labels, len(times))
    )  # fmt: skip
    scenario = scenario_of(loaded.config, StaticSceneScenario)
    scores = score_scans(points, truth, 2.0, scenario.cutoff)
    unit, over = loaded.config.units.length, np.arange(len(times), dtype=np.float64)
    last = scores.pairs.scan == len(times) - 1
    pairs = np.column_stack([scores.pairs.estimate[last], scores.pairs.truth[last] % max(count, 1)])
    bias = (points.counts - count).astype(np.float64)
    return [
        Series("ospa", unit, scores.ospa.distance, over),
        Series("cardinality_bias", "1", bias, over),
        *_accuracy(points, views, pairs, unit),
        *_correspondence(points, views, pairs),
    ]


def _accuracy(points: PointSets, views: _Views, pairs: np.ndarray, unit: str) -> list[Series]:
    """Return counts of points after the last view, their error, its ratio to the bound, and NEES."""
    count, reported = len(views.labels), int(points.counts[-1])
    errors = points.position[pairs[:, 0]] - views.positions[pairs[:, 1]]
    squared = (errors**2).sum(axis=1)
    # an estimate may lie next to a point that too few views show: such a point has no bound
    shown = _determined(views.information[pairs[:, 1]])
    limit = _bounds_of(views.information[pairs[shown, 1]])
    assert points.covariance is not None
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(points.covariance[pairs[:, 0]]), errors)
    figures = {
        "points_found": len(pairs) / count if count else np.nan,
        "points_false": float(reported - len(pairs)),
        "position_error": _root(squared),
        "error_over_bound": _root(squared[shown]) / _root(limit),
        "error_over_bound_median": float(np.sqrt(np.median(squared[shown] / limit))) if shown.any() else np.nan,
        "nees": float(nees.mean()) if len(nees) else np.nan,
    }
    return [
        Series(name, unit if name == "position_error" else "1", np.array([value])) for name, value in figures.items()
    ]


def _correspondence(points: PointSets, views: _Views, pairs: np.ndarray) -> list[Series]:
    """Return the share of true detections assigned to the landmark of their point, and of wrong assignments among
    all."""
    first = int(points.start[-2])
    assert points.covariance is not None
    positions, covariances = points.position[first:], points.covariance[first:]
    point_of = np.full(len(positions), CLUTTER_ID - 1)
    point_of[pairs[:, 0] - first] = views.labels[pairs[:, 1]]
    right = given = true = 0
    for frame in views.frames:
        assert frame.object_id is not None
        rows, columns = _assigned(views.cameras[frame.camera], frame, positions, covariances)
        right += int((point_of[rows] == frame.object_id[columns]).sum())
        given += len(rows)
        true += int((frame.object_id != CLUTTER_ID).sum())
    return [
        Series("correspondence_right", "1", np.array([right / max(true, 1)])),
        Series("correspondence_wrong", "1", np.array([1.0 - right / given if given else np.nan])),
    ]


def _assigned(camera: Camera, frame: Frame, positions: Array, covariances: Array) -> tuple[np.ndarray, np.ndarray]:
    """Assign detections of a frame to landmarks one to one: rows of landmarks, and of detections."""
    rows = np.arange(len(frame.pixels))
    seen = sight(camera, frame.time_s, frame.pixels, rows)
    if not len(seen.points) or not len(positions):
        return rows[:0], rows[:0]
    visible = camera.at(frame.time_s).in_view(positions)
    pixels, slopes = projective(seen.projection[0], positions)
    noise = np.linalg.inv(np.swapaxes(seen.whitening, 1, 2) @ seen.whitening)
    spread = (slopes @ covariances @ np.swapaxes(slopes, 1, 2))[:, None] + noise[None]
    errors = seen.points[None] - pixels[:, None]
    distance = np.einsum("nmi,nmij,nmj->nm", errors, np.linalg.inv(spread), errors)
    landmarks, detections = np.nonzero(visible[:, None] & (distance < GATE))
    chosen = least_cost(landmarks, detections, distance[landmarks, detections], GATE)
    return landmarks[chosen], detections[chosen]


def _views(loaded: LoadedConfig, number: int) -> _Views:
    """Make the views of a run, and the information that they hold of the points."""
    scene, frames = simulated(loaded, number)
    truth = scene_truth(scene)
    labels, at = np.unique(truth.object_id, return_index=True)
    positions = truth.position[at]
    detections, first = associated(loaded, scene.cameras, frames, labels)
    prior = build_filter(loaded.config, scene.cameras, loaded.path).settings.birth
    spaces = [None if sighted is None else sighted[0] for sighted in first]
    information = static_point_information(detections, positions, spaces, prior)
    return _Views(scene.cameras, frames, labels, positions, detections, information)


def bounds(loaded: LoadedConfig) -> list[Series]:
    """Return the bound on the root mean square error after the last view, its variances averaged over scenes."""
    scenes = range(scenario_of(loaded.config, StaticSceneScenario).bound_scenes)
    variances = []
    for number in scenes:
        information = _views(loaded, number).information
        limits = _bounds_of(information[_determined(information)])
        variances.append(float(limits.mean()) if len(limits) else np.nan)
    unit = loaded.config.units.length
    return [Series("position_rmse", unit, np.array([float(np.sqrt(np.mean(variances)))]))]


def _determined(information: Array) -> NDArray[np.bool_]:
    """Return whether information (n, 3, 3) determines a position."""
    return np.asarray(np.linalg.matrix_rank(information) == 3, dtype=np.bool_)


def _bounds_of(information: Array) -> Array:
    """Return the bounds (n,) on the squared errors of positions with this information (n, 3, 3)."""
    return np.asarray(np.trace(np.linalg.inv(information), axis1=1, axis2=2))


def _root(squared: Sequence[float] | Array) -> float:
    return float(np.sqrt(np.mean(squared))) if len(squared) else float("nan")


KIND = Kind(run, bounds, check)
