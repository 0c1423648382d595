"""The world seen from above and from the side: which axes, how far, and what the cameras see."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import ConvexHull

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera

# A view is never drawn narrower or flatter than this: long, thin scenes get wider margins.
LARGEST_ASPECT = 2.0
MARGIN = 0.06


@dataclass(frozen=True)
class SceneView:
    """A projection along a world axis."""

    # `horizontal`, `vertical`: World axes (0 x, 1 y, 2 z) drawn to the right and upwards.
    horizontal: int
    vertical: int
    inverted: bool = False  # The vertical axis points down on the page
    title: str = field(default="From above", compare=False)

    def project(self, points: Array) -> Array:
        """Return the drawn coordinates (n, 2) of world points (n, 3)."""
        return points[:, [self.horizontal, self.vertical]]


# A view is drawn to this many times the farthest depth, beyond what the axes show.
VIEW_MARGIN = 3.0


def down_axis(cameras: Sequence[Camera]) -> tuple[int, bool]:
    """Return the world axis nearest to vertical, and whether it points down.

    Cameras are held upright as a rule, so the mean of their downward axes gives it. Without cameras it is the
    convention of the world: y down.
    """
    if not cameras:
        return 1, True
    down = np.mean([camera.pose.rotation[1] for camera in cameras], axis=0)
    axis = int(np.abs(down).argmax())
    return axis, bool(down[axis] > 0)


def views(cameras: Sequence[Camera], points: Array) -> dict[str, SceneView]:
    """Return the ``top`` and ``side`` views of a scene whose points (n, 3) are known.

    From above nothing is mirrored; from the side the longer horizontal axis is drawn.
    """
    vertical, is_down = down_axis(cameras)
    first, second = (axis for axis in range(3) if axis != vertical)
    # first x second is +vertical for the axes y of (z, x) and so on; seen from above it must point up.
    handed = 1 if (first, second) in ((0, 1), (1, 2)) else -1
    if handed != (-1 if is_down else 1):
        first, second = second, first
    extent = np.ptp(points, axis=0) if len(points) else np.ones(3)
    longer = first if extent[first] >= extent[second] else second
    return {"top": SceneView(first, second), "side": SceneView(longer, vertical, is_down, "From the side")}


def limits(points: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits of a view that shows all points (n, 2) with a margin, not too long and thin."""
    if len(points) == 0:
        return (-1.0, 1.0), (-1.0, 1.0)
    low, high = points.min(axis=0), points.max(axis=0)
    size = (high - low) * (1 + 2 * MARGIN)
    largest = float(size.max()) or 1.0
    size = np.maximum(size, largest / LARGEST_ASPECT)
    low, high = (low + high - size) / 2, (low + high + size) / 2
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def field_of_view(camera: Camera, depth: float, view: SceneView) -> Array:
    """Return the outline (n, 2) of what a camera sees up to a depth, its convex hull as drawn in a view."""
    u = np.array([-0.5, camera.width / 2 - 0.5, camera.width - 0.5])
    v = np.array([-0.5, camera.height / 2 - 0.5, camera.height - 0.5])
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    far = camera.unproject(pixels, np.full(len(pixels), depth))
    corners = np.concatenate([camera.pose.center[None], far[np.isfinite(far).all(axis=1)]])
    drawn = view.project(corners)
    shape = drawn - drawn[0]  # far from the origin, rounding would flatten it
    # a lens may reach so little of the image that all lie on a line
    return drawn[ConvexHull(shape).vertices] if np.linalg.matrix_rank(shape) == 2 else drawn


def viewing_depth(camera: Camera, points: Array) -> float:
    """Return a depth to draw a camera's view to: well past the farthest of the points (n, 3) before it, or 0.

    The axes cut the view; its far end inside the picture would look like a limit of range.
    """
    depth = camera.pose.to_camera(points)[:, 2] if len(points) else np.zeros(0)
    return VIEW_MARGIN * float(max(depth.max(initial=0.0), 0.0))
