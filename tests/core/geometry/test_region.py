"""Half-spaces of a box and of a prism over a polygon, and what rays and detections see of them."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.disparity.events import make_event, make_rig
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose
from stereophd.core.geometry.region import are_inside, box_half_spaces, pack_region, prism_half_spaces, rays_meet

# A pentagon on the floor of a hall with y down.
FLOOR = [[-2.0, 0.0, 6.0], [2.0, 0.0, 6.0], [3.0, 0.0, 9.0], [0.0, 0.0, 11.0], [-3.0, 0.0, 9.0]]


@pytest.mark.parametrize("order", [1, -1])
def test_a_polygon_and_its_heights(order: int) -> None:
    """In either order of the corners: a place over the floor, one beside it, one above, one below."""
    spaces = prism_half_spaces(FLOOR[::order], (0.0, -2.0, 0.0), (-0.5, 2.0))
    places = np.array([[0.0, -1.0, 8.0], [2.9, -1.0, 6.5], [0.0, -2.1, 8.0], [0.0, 0.6, 8.0], [0.0, 0.4, 6.0]])
    assert are_inside(places, spaces).tolist() == [True, False, False, False, True]
    np.testing.assert_allclose(np.linalg.norm(spaces[:, :3], axis=1), 1.0)


@pytest.mark.parametrize(
    ("corners", "up", "message"),
    [
        (FLOOR[:2], (0, -1, 0), "three corners"),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], (0, -1, 0), "on a line"),
        (FLOOR, (1, 0, 0), "`up`"),
        ([[0, 0, 0], [2, 0, 0], [2, 0, 2], [1, 0, 0.5]], (0, -1, 0), "convex"),
        ([[0, 0, 0], [2, 0, 2], [2, 0, 0], [0, 0, 1.5]], (0, -1, 0), "expected"),
        ([[0, 0, 0], [2, 0, 0], [2, 0, 2], [0, 1, 2]], (0, -1, 0), "plane"),
    ],
)
def test_corners_that_are_no_convex_polygon(corners: list[list[float]], up: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        prism_half_spaces(corners, up, (0.0, 1.0))


def test_rays_through_a_box_and_beside_it() -> None:
    """Against points along the rays; a ray on the border of an open side."""
    rng = np.random.default_rng(1)
    region = pack_region((2.0, 30.0), box_half_spaces({"x": (-1.0, 1.0), "z": (4.0, 6.0)}))
    directions = np.column_stack([rng.normal(0.0, 0.5, (200, 2)), np.ones(200)])
    center = np.array([0.3, 0.0, 0.0])
    depths = np.linspace(2.0, 30.0, 1500)
    places = center + depths[:, None, None] * directions
    expected = [are_inside(places[:, k], region[2:].reshape(-1, 4)).any() for k in range(200)]
    assert 20 < sum(expected) < 180
    assert rays_meet(center, directions, region).tolist() == expected
    assert rays_meet(np.zeros(3), np.array([[0.0, 0.0, 1.0], [9.0, 0.0, 1.0]]), region).tolist() == [True, False]


def test_detections_that_see_nothing_of_the_region_are_left_out() -> None:
    """A ball in a box before the camera: its middle, just beside it within the noise, and far beside it."""
    camera = Camera(
        name="cam", width=800, height=600, fx=500.0, fy=500.0, cx=399.5, cy=299.5, lens=Lens("none"),
        pose=Pose(np.eye(3), np.zeros(3)), detector=Detector((1.0, 1.0), 0.9, 1.0),
    )  # fmt: skip
    pixels = np.array([[399.5, 299.5], [502.0, 299.5], [520.0, 299.5]])
    event = make_event(camera, 0, 0.0, pixels, rows=np.array([7, 8, 9]))
    region = pack_region((-np.inf, np.inf), box_half_spaces({"x": (-1.0, 1.0), "y": (-1.0, 1.0), "z": (5.0, 6.0)}))
    rig = make_rig([camera], 1.0, "horizontal", region)
    seen = event.within(rig)
    assert seen.rows is not None
    assert (seen.rows.tolist(), seen.outside) == ([7, 8], 1)
    np.testing.assert_array_equal(seen.covariances, event.covariances[:2])
    # a square of 2 m at 5 m
    assert rig.shares_of_view()[0] == pytest.approx(200.0**2 / (800 * 600), rel=0.15)
    assert event.within(make_rig([camera], 1.0, "horizontal")) is event
