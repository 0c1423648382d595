"""Estimation of one object on disparity space: Algorithms 1 and 2 of the paper (V-A, V-B).

The state is a Gaussian in the disparity space of a camera, where its detections are linear (eq. 4): a
Kalman update is all that they take. Between events the Gaussian is carried by the moves of
`stereophd.core.disparity.moments`, the same as those of the multi-object filters: over time, and (Algorithm 2)
into the disparity space of the next event's camera. With one object and no clutter a detection is of the
object, so that samples out of the camera's view are left out of the Gaussian (V-B).
"""

import math
from dataclasses import dataclass, field

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event, Rig
from stereophd.core.disparity.moments import Sources, move, world_moments
from stereophd.core.disparity.moved import OUT_OF_VIEW
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.layout import CX, CY, HEIGHT, LENS_CODE, LENS_NONE, WIDTH
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.samples import SampleSets
from stereophd.core.single.base import SingleEstimate, SingleEstimator, first_density
from stereophd.core.single.gaussian import UNSEEN, GaussianState, linear_update, state_in_world, unseen_state

IMPORTANT = np.array([True])
# H of eq. 4, by the size of the state.
OBSERVATION = {size: np.eye(2, size) for size in (3, 6)}
# How far (px) the image is widened on all sides where its border must have no effect.
WIDE = 1e7
# Over an image, the divisor of the map between the disparity spaces of rectified cameras is 1 to this.
RECTIFIED_TOLERANCE = 1e-6


def _sources(motion: Motion, state: GaussianState, home: Array, time_s: float) -> Sources:
    """Return a state as it is carried from its home space to a time."""
    intervals = motion.arrays(np.array([time_s - state.home_s]))
    return Sources(state.mean[None], state.covariance[None], home[None], intervals)


@dataclass(frozen=True)
class DisparityEstimator(SingleEstimator[GaussianState]):
    """Algorithm 2: any cameras, the state in the disparity space of the camera that saw the object last."""

    sets: SampleSets  # Samples of the moves, and with them the method

    def init(self) -> GaussianState:
        """Return the state before the first detection."""
        return unseen_state()

    def _detected(self, state: GaussianState, event: Event, space: Array, time_s: float) -> tuple[GaussianState, float]:
        """Carry the state into the event's disparity space and update it (Algorithm 2).

        A detection that no sample of the state can have made starts it anew.
        """
        moved = None if state.camera == UNSEEN else self._moved(state, space, event.camera, time_s)
        if moved is None:
            means, covariances = self.prior.moments(event.points, event.covariances, space, self.state_size)
            mean, covariance, log_likelihood = means[0], covariances[0], first_density(self.rig, event)
        else:
            mean, covariance, log_density = linear_update(
                moved[0], moved[1], OBSERVATION[self.state_size], moved[0][:2], event.points[0], event.covariances[0]
            )
            log_likelihood = log_density + math.log(event.areas[0])
        after = GaussianState(event.time_s, time_s, state.n_events + 1, mean, covariance, event.camera)
        return after, log_likelihood

    def _moved(self, state: GaussianState, space: Array, camera: int, time_s: float) -> tuple[Array, Array] | None:
        """Mean and covariance in `space`: of the part in view, else of the part in front of the camera."""
        still = time_s == state.home_s or (not self.motion.moves and not self.rig.moving)
        if still and camera == state.camera:
            return state.mean, state.covariance
        for shift in (0.0, WIDE):
            moved = move(
                _sources(self.motion, state, self._home(state), time_s),
                space if shift == 0.0 else widened(space),
                self.sets,
                state.n_events,
                important=IMPORTANT,
            )
            if moved.status[0] != OUT_OF_VIEW:
                mean = moved.means[0]
                mean[:2] -= shift
                return mean, moved.covariances[0]
        return None

    def _home(self, state: GaussianState) -> Array:
        return self.rig.space(state.camera, state.home_s)

    def estimate(self, state: GaussianState) -> SingleEstimate | None:
        """Return the mean and covariance in the world by moments, and the mode in disparity space, mapped."""
        if state.camera == UNSEEN:
            return None
        return world_estimate(state, self._home(state), self.motion, self.sets)


@dataclass(frozen=True)
class RectifiedEstimator(DisparityEstimator):
    """Algorithm 1: cameras that are rectified with one another share the disparity space of the first.

    Cameras are rectified if they have the same orientation and their centres lie in a plane perpendicular to the
    optical axis. The map between their disparity spaces, projective in general, is then affine, and the detections of
    all cameras are linear in the same state (eq. 4). Intrinsic parameters may differ. A static object needs no samples.
    Raises ValueError if the cameras are not rectified, or move.
    """

    # `matrices`, `offsets`: arrays (c, 3, 3), (c, 3): From the first camera's disparity space to each camera's: ``y_i
    # = matrix y + offset``.
    matrices: Array = field(init=False)
    offsets: Array = field(init=False)

    def __post_init__(self) -> None:
        for name, maps in zip(("matrices", "offsets"), rectified_maps(self.rig), strict=True):
            object.__setattr__(self, name, maps)

    def _detected(self, state: GaussianState, event: Event, space: Array, time_s: float) -> tuple[GaussianState, float]:
        """Predict the state in the shared space, and update it (Algorithm 1)."""
        size = self.state_size
        if state.camera == UNSEEN:
            means, covariances = self.prior.moments(event.points, event.covariances, space, size)
            back = np.linalg.inv(self.matrices[event.camera])
            whole = np.kron(np.eye(size // 3), back)
            means[0, :3] -= self.offsets[event.camera]
            mean, covariance = whole @ means[0], whole @ covariances[0] @ whole.T
            log_likelihood = first_density(self.rig, event)
        else:
            mean, covariance = self._predicted(state, time_s)
            matrix = np.zeros((2, size))
            matrix[:, :3] = self.matrices[event.camera][:2]
            predicted = matrix @ mean + self.offsets[event.camera][:2]
            mean, covariance, log_density = linear_update(
                mean, covariance, matrix, predicted, event.points[0], event.covariances[0]
            )
            log_likelihood = log_density + math.log(event.areas[0])
        # the state's home is always the first camera
        return GaussianState(event.time_s, time_s, state.n_events + 1, mean, covariance, 0), log_likelihood

    def _predicted(self, state: GaussianState, time_s: float) -> tuple[Array, Array]:
        """Particle prediction, whether or not the object is in the first camera's image."""
        if not self.motion.moves or time_s == state.home_s:
            return state.mean, state.covariance
        home = self.rig.space(0, time_s)
        moved = move(_sources(self.motion, state, home, time_s), widened(home), self.sets, state.n_events)
        if moved.status[0] == OUT_OF_VIEW:
            return state.mean, state.covariance
        mean = moved.means[0]
        mean[:2] -= WIDE
        return mean, moved.covariances[0]


def rectified_maps(rig: Rig) -> tuple[Array, Array]:
    """Affine maps (c, 3, 3), (c, 3) from the first camera's disparity space to each camera's.

    Raises ValueError if the cameras are not rectified, or move.
    """
    if rig.moving:
        raise ValueError("rectified: expected cameras that do not move")
    spaces = [DisparitySpace(camera, rig.baseline, rig.rectification) for camera in rig.cameras]
    matrices, offsets = [], []
    for camera, space in zip(rig.cameras, spaces, strict=True):
        homography = space.projective_matrix @ spaces[0].inverse_projective_matrix
        homography = homography / homography[3, 3]
        # the spread of (u, v, d) over an image
        extent = np.array([camera.width, camera.height, spaces[0].disparity_focal])
        if not np.abs(homography[3, :3] * extent).max() < RECTIFIED_TOLERANCE:
            raise ValueError(
                f"rectified: expected {camera.name} to be rectified with {rig.cameras[0].name} (same orientation, "
                "centres in a plane across the optical axis)"
            )
        matrices.append(homography[:3, :3])
        offsets.append(homography[:3, 3])
    return np.array(matrices), np.array(offsets)


def widened(space: Array) -> Array:
    """Return the packed space with an image so wide that all in front of the camera is in view.

    Its pixels are shifted by `WIDE`.
    """
    wide = space.copy()
    wide[[CX, CY]] += WIDE
    wide[[WIDTH, HEIGHT]] += 2.0 * WIDE
    wide[LENS_CODE] = LENS_NONE
    return wide


def world_estimate(state: GaussianState, home: Array, motion: Motion, sets: SampleSets) -> SingleEstimate:
    """Estimate in the world at the state's time, of a Gaussian in the packed space `home`."""
    dt = state.time_s - state.home_s
    means, covariances = world_moments(
        state.mean[None], state.covariance[None], home[None], np.array([dt]), motion, sets, state.n_events
    )
    mode = state_in_world(state.mean, home, motion.arrays(np.array([dt])))
    return SingleEstimate(means[0], mode, covariances[0])
