"""The bound of static points: information from numerical derivatives, and points that no camera saw."""

import numpy as np

from stereophd.core.bounds.cramer_rao import static_point_information
from stereophd.core.bounds.known_association import sight
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.multi.filter_settings.common import BirthPrior


def test_information_is_that_of_pixels_and_disparity() -> None:
    moving = Pose(rotation_from_vector([0.0, -0.2, 0.0]), [-20.0, 0.0, 0.0], [4.0, 0.0, 1.0], [0.0, -0.02, 0.0])
    camera = Camera("one", 800, 600, 900.0, 880.0, 400.0, 300.0, moving, Lens(), Detector((1.5, 1.0), 0.9, 5.0))
    points = np.array([[3.0, -4.0, 120.0], [0.0, 5.0, 150.0], [1.0, 1.0, 100.0]])
    times = (0.0, 2.0, 5.0)
    seen = np.array([0, 1])  # nobody sees the third point
    parts = [sight(camera, t, camera.at(t).project(points[seen]), seen) for t in times]
    detections = parts[0].join(*parts[1:])
    space = DisparitySpace(camera.at(times[0]))
    prior = BirthPrior(velocity_std=1.0, disparity=DisparityPrior(mean_px=7.0, std_px=3.0))
    found = static_point_information(detections, points, [space, space, None], prior)
    assert not found[2].any()
    step = 1e-4
    for row in seen:
        expected = np.zeros((3, 3))
        ends = [points[row] + sign * step * np.eye(3) for sign in (1.0, -1.0)]
        for time_s in times:
            slope = (camera.at(time_s).project(ends[0]) - camera.at(time_s).project(ends[1])).T / (2 * step)
            expected += slope.T @ np.diag([1.5**-2, 1.0]) @ slope
        disparity = [space.from_world(end)[:, 2] for end in ends]
        slope = (disparity[0] - disparity[1]) / (2 * step)
        np.testing.assert_allclose(found[row], expected + np.outer(slope, slope) / 3.0**2, rtol=1e-6)
