"""Detections of a camera that moves while its rolling shutter reads the image, in the axes of the camera at the frame.

A filter works in the disparity space of the camera at the time of the frame, at R_0, c_0. Row j is read when the camera
is at R_j, c_j. A pixel of ray r is turned to the axes of the frame by the homography K R_0 R_j^T K^-1, which is exact.
From the centre c_j a point at rest is then seen where the camera at c_0 would see it had it moved by -(c_j - c_0). With
D = R_0 (c_j - c_0) and the inverse depth rho = d / (f b) before the camera of the frame, the turned pixel z of (u, v)
satisfies

    z_u = u - rho (f_x D_x - (z_u - c_x) D_z),    z_v = v - rho (f_y D_y - (z_v - c_y) D_z):

for a detection, of which z is known, linear in the disparity d. An object moves on by tau_j (du, dv) besides
(`stereophd.core.multi.association.likelihoods`), so that its observation stays linear.
"""

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.space import BASELINE, VERTICAL
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.layout import CX, CY, FX, FY, ROTATION
from stereophd.core.geometry.pose import Pose

# Columns of the readings of detections: delay, and change of u and of v with the disparity.
READING_COLUMNS = 3
#: Those of the detections of a camera that reads all its rows at the time of the frame.
NO_READINGS = np.empty((0, READING_COLUMNS))


def travels(pose: Pose, times: Array, delays: Array) -> Array:
    """Displacements (n, 3) of a camera's centre in the world from times of frames (n,), s, until delays (n,) later."""
    return np.asarray(pose.motions(times + delays).centers - pose.motions(times).centers)


def turned_to_frame(
    camera: Camera, times: Array, delays: Array, points: Array, covariances: Array, areas: Array
) -> tuple[Array, Array, Array]:
    """Turn detections to the axes that their camera has at the times of their frames.

    Times of the frames, and delays of the detections after them, are (n,), s. Undistorted points (n, 2), covariances
    (n, 2, 2) and areas (n,) are those of an `Event`, in the axes of the camera at the rows, and are returned in the
    axes at the frames; a row of NaN points where the camera has turned by a quarter turn or more.
    """
    if camera.pose.path is None and not camera.pose.rotation_rate.any():
        return points, covariances, areas
    at_frame, at_row = camera.pose.motions(times).rotations, camera.pose.motions(times + delays).rotations
    turns = at_frame @ np.swapaxes(at_row, 1, 2)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rays = np.column_stack([(points - middle) / focal, np.ones(len(points))])
    turned = np.einsum("nij,nj->ni", turns, rays)
    depths = np.where(turned[:, 2] > 0.0, turned[:, 2], np.nan)
    slopes = turned[:, :2] / depths[:, None]
    jacobian = (turns[:, :2, :2] - slopes[:, :, None] * turns[:, 2, None, :2]) / depths[:, None, None]
    jacobian = jacobian * (focal[:, None] / focal)
    scale = np.abs(jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0])
    spread = jacobian @ covariances @ np.swapaxes(jacobian, 1, 2)
    return slopes * focal + middle, spread, areas * scale


def readings(delays: Array, travelled: Array | None, points: Array, space: Array) -> Array:
    """When, and from where, the detections of an event were read, for the compiled filters.

    Delays (m,) count from the time of the frame, s; `travelled` (m, 3) is the displacement of the camera's centre in
    the world until then, None of a camera that stands still. Undistorted points (m, 2) are in the axes of the camera at
    the frame, whose packed space is (30,). Returns (m, 3): delays, and the change of the pixel (u, v) with the
    disparity.
    """
    out = np.zeros((len(points), READING_COLUMNS))
    out[:, 0] = delays
    if travelled is not None:
        focal, middle = space[[FX, FY]], space[[CX, CY]]
        moved = travelled @ space[ROTATION : ROTATION + 9].reshape(3, 3).T
        scale = (space[FY] if space[VERTICAL] == 1.0 else space[FX]) * space[BASELINE]
        out[:, 1:] = ((points - middle) * moved[:, 2:] - focal * moved[:, :2]) / scale
    return out
