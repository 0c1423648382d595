"""Estimation of one object on disparity space: Algorithms 1 and 2 of the paper (V-A, V-B).

The state is a Gaussian in the disparity space of a camera, where its detections are linear (eq. 4): a
Kalman update is all that they take. Between events the Gaussian is carried by the moves of
`stereophd.core.disparity.moments`, the same as those of the multi-object filters: over time, and (Algorithm 2)
into the disparity space of the next event's camera. With one object and no clutter a detection is of the
object, so that samples out of the camera's view are left out of the Gaussian (V-B).
"""

from dataclasses import dataclass, field

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event, Rig
from stereophd.core.disparity.moments import move, world_moments
from stereophd.core.disparity.moved import OUT_OF_VIEW, Sources
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.disparity.world_moments import states_in_world
from stereophd.core.geometry.layout import CX, CY, HEIGHT, LENS_CODE, LENS_NONE, WIDTH
from stereophd.core.numerics.samples import SampleSets
from stereophd.core.single.base import SingleEstimate
from stereophd.core.single.gaussian import Gaussian, GaussianEstimator, GaussianState, Observation

IMPORTANT = np.array([True])
# H of eq. 4, by the size of the state.
OBSERVATION = {size: np.eye(2, size) for size in (3, 6)}
# How far (px) the image is widened on all sides where its border must have no effect.
WIDE = 1e7
# Over an image, the divisor of the map between the disparity spaces of rectified cameras is 1 to this.
RECTIFIED_TOLERANCE = 1e-6


@dataclass(frozen=True)
class DisparityEstimator(GaussianEstimator):
    """Algorithm 2: any cameras, the state in the disparity space of the camera that saw the object last."""

    sets: SampleSets  # Samples of the moves, and with them the method

    def _first(self, event: Event, space: Array) -> Gaussian:
        means, covariances = self.prior.moments(event.points, event.covariances, space, self.state_size)
        return means[0], covariances[0]

    def _predicted(self, state: GaussianState, space: Array, time_s: float) -> Gaussian | None:
        """Return the Gaussian of the part in view, else of the part in front of the camera (Algorithm 2)."""
        still = time_s == state.home_s or not self.motion.moves
        if still and np.array_equal(space, state.home):
            return state.mean, state.covariance
        return self._moved(state, space, time_s, 0.0) or self._moved(state, space, time_s, WIDE)

    def _moved(self, state: GaussianState, space: Array, time_s: float, shift: float) -> Gaussian | None:
        """Carry a state to a time in a space, whose image is widened by a shift on all sides; None if out of view."""
        intervals = self.motion.arrays(np.array([time_s - state.home_s]))
        sources = Sources(state.mean[None], state.covariance[None], state.home[None], intervals)
        destination = widened(space) if shift else space
        moved = move(sources, destination, self.sets, state.n_events, important=IMPORTANT)
        if moved.status[0] == OUT_OF_VIEW:
            return None
        mean = moved.means[0]
        mean[:2] -= shift
        return mean, moved.covariances[0]

    def _observed(self, state: GaussianState, predicted: Gaussian, event: Event, space: Array) -> Observation:
        """Observe the pixel, a part of the state."""
        return predicted[0][:2], OBSERVATION[self.state_size], event.covariances[0]

    def _estimate(self, state: GaussianState) -> SingleEstimate:
        """Return the mean and covariance in the world by moments, and the mode in disparity space, mapped."""
        elapsed = np.array([state.time_s - state.home_s])
        means, covariances = world_moments(
            state.mean[None], state.covariance[None], state.home[None], elapsed, self.motion, self.sets, state.n_events
        )
        return SingleEstimate(
            means[0], states_in_world(state.mean[None], state.home, self.motion.arrays(elapsed))[0], covariances[0]
        )


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

    def _home(self, state: GaussianState | None, space: Array) -> Array:
        return np.asarray(self.rig.packed[0])

    def _first(self, event: Event, space: Array) -> Gaussian:
        mean, covariance = super()._first(event, space)
        whole = np.kron(np.eye(self.state_size // 3), np.linalg.inv(self.matrices[event.camera]))
        mean[:3] -= self.offsets[event.camera]
        return whole @ mean, whole @ covariance @ whole.T

    def _observed(self, state: GaussianState, predicted: Gaussian, event: Event, space: Array) -> Observation:
        """Observe a linear function of the shared state (Algorithm 1)."""
        matrix = np.zeros((2, self.state_size))
        matrix[:, :3] = self.matrices[event.camera][:2]
        return matrix @ predicted[0] + self.offsets[event.camera][:2], matrix, event.covariances[0]

    def _predicted(self, state: GaussianState, space: Array, time_s: float) -> Gaussian:
        """Return the particle prediction, whether or not the object is in the first camera's image."""
        moved = None
        if self.motion.moves and time_s != state.home_s:
            moved = self._moved(state, state.home, time_s, WIDE)
        return moved or (state.mean, state.covariance)


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
