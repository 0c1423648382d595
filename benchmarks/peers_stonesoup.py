"""Two trackers built on Stone Soup for `peers.py`: global nearest neighbours, and a GM-PHD filter.

Both have the same models: white acceleration, an extended Kalman filter in the world, a pinhole camera of known pose,
and births by triangulation of what no object explains (the detections of two cameras of one time whose rays meet).
They know the detector and the process noise as the PMB filter does. When tracks are confirmed and ended, the gate, the
process noise and the weight of births were chosen for the lowest OSPA over four scenes (seeds 101 to 104). Scans come
as (time, detections of camera 0, of camera 1).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import count

import numpy as np
from scipy.optimize import linear_sum_assignment
from stonesoup.base import Property
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.deleter.time import UpdateTimeDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
from stonesoup.measures import Mahalanobis
from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, TaggedWeightedGaussianState
from stonesoup.types.track import Track
from stonesoup.types.update import GaussianStateUpdate
from stonesoup.updater.kalman import ExtendedKalmanUpdater
from stonesoup.updater.pointprocess import PHDUpdater

from stereophd.core.arrays import Array

START = datetime(2026, 1, 1)
POSITION, VELOCITY = [0, 2, 4], [1, 3, 5]
# Gates, in standard deviations: of an association, and of rays that meet.
GATE, RAYS_MEET = 4.0, 3.0


class Pinhole(NonLinearGaussianMeasurement):
    """A camera: world states (x, vx, y, vy, z, vz) to pixels."""

    projection: Array = Property(doc="World to homogeneous pixels, (3, 4)")

    @property
    def ndim_meas(self) -> int:
        """Size of a pixel."""
        return 2

    def function(self, state, noise=False, **kwargs):  # type: ignore[no-untyped-def]
        """Pixels of states."""
        vectors = np.asarray(state.state_vector, dtype=float)
        homogeneous = self.projection[:, :3] @ vectors[POSITION] + self.projection[:, 3:]
        pixels = homogeneous[:2] / homogeneous[2]
        return (StateVector if pixels.shape[1] == 1 else StateVectors)(pixels)

    def jacobian(self, state, **kwargs):  # type: ignore[no-untyped-def]
        """Of the pixel in the state, (2, 6)."""
        out = np.zeros((2, 6))
        out[:, POSITION] = _slope(self.projection, np.asarray(state.state_vector, dtype=float)[POSITION, 0])[1]
        return out


@dataclass(frozen=True)
class Knowledge:
    """What a tracker is told of the scene.

    Attributes
    ----------
    projections : two arrays (3, 4)
    noise : array (2, 2)
        Of a pixel.
    p_detect, clutter_density : float
        The latter per square pixel.
    survival : float
        From one scan to the next.
    acceleration_std, velocity_std : float
        Process noise, and spread of the velocities of new objects.
    depths : tuple of float
        Least and greatest depth of new objects before camera 0.
    """

    projections: tuple[Array, Array]
    noise: Array
    p_detect: float
    clutter_density: float
    survival: float
    acceleration_std: float
    velocity_std: float
    depths: tuple[float, float]

    def models(self) -> tuple[list[Pinhole], KalmanPredictor, ExtendedKalmanUpdater, DistanceHypothesiser]:
        """Cameras, predictor, updater and the gate."""
        cameras = [
            Pinhole(ndim_state=6, mapping=POSITION, noise_covar=self.noise, projection=p) for p in self.projections
        ]
        axis = ConstantVelocity(self.acceleration_std**2)
        predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([axis, axis, axis]))
        updater = ExtendedKalmanUpdater(None)
        return cameras, predictor, updater, DistanceHypothesiser(predictor, updater, Mahalanobis(), GATE)

    def triangulate(self, left: Array, right: Array) -> Iterator[tuple[int, int, Array, Array]]:
        """Yield pairs of pixels whose rays meet, each pixel at most once, with state (6, 1) and covariance (6, 6)."""
        costs = np.full((len(left), len(right)), 2.0 * RAYS_MEET**2)
        found: dict[tuple[int, int], tuple[Array, Array]] = {}
        for i, j in np.ndindex(costs.shape):
            point, information, residual = _meet(self.projections, (left[i], right[j]), self.noise)
            depth = float(self.projections[0][2, :3] @ point + self.projections[0][2, 3])
            if residual <= RAYS_MEET**2 and self.depths[0] <= depth <= self.depths[1]:
                costs[i, j] = residual
                found[i, j] = (point, information)
        for i, j in zip(*linear_sum_assignment(costs), strict=True):
            if (i, j) in found:
                mean, covariance = np.zeros((6, 1)), np.zeros((6, 6))
                mean[POSITION, 0] = found[i, j][0]
                covariance[np.ix_(POSITION, POSITION)] = np.linalg.inv(found[i, j][1])
                covariance[VELOCITY, VELOCITY] = self.velocity_std**2
                yield int(i), int(j), mean, covariance


def _slope(projection: Array, point: Array) -> tuple[Array, Array]:
    """Pixel (2,) of a point, and its Jacobian (2, 3)."""
    homogeneous = projection[:, :3] @ point + projection[:, 3]
    pixel = homogeneous[:2] / homogeneous[2]
    return pixel, (projection[:2, :3] - pixel[:, None] * projection[2, :3]) / homogeneous[2]


def _meet(projections: tuple[Array, Array], pixels: tuple[Array, Array], noise: Array) -> tuple[Array, Array, float]:
    """Most probable meeting point of two rays, its information (3, 3), and the squared residual (one degree)."""
    rows = np.concatenate([z[:, None] * p[2] - p[:2] for p, z in zip(projections, pixels, strict=True)])
    point = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)[0]
    weight = np.linalg.inv(noise)
    for _ in range(2):
        information, gradient, cost = np.zeros((3, 3)), np.zeros(3), 0.0
        for projection, pixel in zip(projections, pixels, strict=True):
            predicted, slope = _slope(projection, point)
            information += slope.T @ weight @ slope
            gradient += slope.T @ weight @ (pixel - predicted)
            cost += float((pixel - predicted) @ weight @ (pixel - predicted))
        point = point + np.linalg.solve(information, gradient)
    return point, information, cost


Scan = tuple[float, Array, Array]


def _detections(scan: Scan, cameras: Sequence[Pinhole]) -> tuple[datetime, list[list[Detection]]]:
    now = START + timedelta(seconds=scan[0])
    found = [
        [Detection(StateVector(pixel), timestamp=now, measurement_model=camera) for pixel in pixels]
        for camera, pixels in zip(cameras, scan[1:], strict=True)
    ]
    return now, found


def _pixels(detections: Sequence[Detection]) -> Array:
    return np.array([np.asarray(d.state_vector, dtype=float).ravel() for d in detections]).reshape(-1, 2)


def run_gnn(scans: Sequence[Scan], known: Knowledge, confirm: int = 6, patience_s: float = 2.5) -> list[Array]:
    """Global nearest neighbours; tracks are reported from `confirm` detections on. Positions (k, 3) of every scan."""
    cameras, _, updater, hypothesiser = known.models()
    associator = GNNWith2DAssignment(hypothesiser)
    lasting = UpdateTimeDeleter(timedelta(seconds=patience_s))
    brief = UpdateTimeDeleter(timedelta(seconds=0.5 * min(np.diff([scan[0] for scan in scans]), default=1.0)))
    confirmed: set[Track] = set()
    tentative: set[Track] = set()
    out = []
    for scan in scans:
        now, per_camera = _detections(scan, cameras)
        rest = []
        for detections in per_camera:
            left = set(detections)
            for group in (confirmed, tentative):  # confirmed tracks choose first
                if not group:
                    continue
                for track, hypothesis in associator.associate(group, left, now).items():
                    if hypothesis:
                        track.append(updater.update(hypothesis))
                        left.discard(hypothesis.measurement)
                    else:
                        track.append(hypothesis.prediction)
            rest.append([d for d in detections if d in left])
        confirmed -= lasting.delete_tracks(confirmed, timestamp=now)
        tentative -= brief.delete_tracks(tentative, timestamp=now)
        ready = {t for t in tentative if 1 + sum(isinstance(s, GaussianStateUpdate) for s in t) >= confirm}
        confirmed |= ready
        tentative -= ready
        for _, j, mean, covariance in known.triangulate(_pixels(rest[0]), _pixels(rest[1])):
            prior = GaussianState(mean, covariance, now)
            hypothesis = SingleHypothesis(prior, rest[1][j])
            tentative.add(Track([GaussianStateUpdate(mean, covariance, hypothesis, timestamp=now)]))
        out.append(np.array([np.asarray(t.state_vector, dtype=float)[POSITION, 0] for t in confirmed]).reshape(-1, 3))
    return out


def run_phd(
    scans: Sequence[Scan],
    known: Knowledge,
    birth_weight: float = 0.05,
    confirm: float = 0.8,
    release: float = 0.01,
) -> list[Array]:
    """GM-PHD filter with hysteresis by tag. Positions (k, 3) of every scan."""
    cameras, _, updater, hypothesiser = known.models()
    hypotheses = GaussianMixtureHypothesiser(hypothesiser, order_by_detection=True)
    updaters = [
        PHDUpdater(updater, known.clutter_density, prob_detection=known.p_detect, prob_survival=survival)
        for survival in (known.survival, 1.0)
    ]
    reducer = GaussianMixtureReducer(prune_threshold=1e-3, merge_threshold=4.0, max_number_components=100)
    tags = count()
    reported: set[str] = set()
    mixture: list[TaggedWeightedGaussianState] = []
    out = []
    for scan in scans:
        now, per_camera = _detections(scan, cameras)
        for one, detections in zip(updaters, per_camera, strict=True):
            if mixture:
                mixture = reducer.reduce(one.update(hypotheses.hypothesise(mixture, detections, now)).components)
        reported = {c.tag for c in mixture if c.weight >= (release if c.tag in reported else confirm)}
        shown = [c for c in mixture if c.tag in reported]
        out.append(np.array([np.asarray(c.state_vector, dtype=float)[POSITION, 0] for c in shown]).reshape(-1, 3))
        rest = [_unexplained(_pixels(d), shown, camera) for d, camera in zip(per_camera, cameras, strict=True)]
        mixture = list(mixture) + [
            TaggedWeightedGaussianState(
                StateVector(mean), covariance, timestamp=now, weight=birth_weight, tag=f"object {next(tags)}"
            )
            for _, _, mean, covariance in known.triangulate(*rest)
        ]
    return out


def _unexplained(pixels: Array, shown: Sequence[TaggedWeightedGaussianState], camera: Pinhole) -> Array:
    """Detections that are not near to any reported object."""
    radius = GATE * float(np.sqrt(np.trace(camera.noise_covar) / 2.0))
    free = np.ones(len(pixels), dtype=bool)
    for component in shown:
        place = np.asarray(camera.function(component), dtype=float).ravel()
        free &= ((pixels - place) ** 2).sum(axis=1) > radius**2
    return pixels[free]
