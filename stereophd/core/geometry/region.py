"""Where objects can be: half-spaces of the world, and a range of depth before the camera that saw an object last.

A region is packed as (2 + 4 h,): the nearest and the farthest depth, then the outward unit normal n and the offset o of
every half-space; positions x with n x <= o are inside. A box and a prism over a convex polygon are such half-spaces.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from stereophd.core.arrays import Array, Booleans

AXES = ("x", "y", "z")
# Corners of a polygon may miss its plane, or its convex hull, by this share of its size.
EVEN = 1e-3


def pack_region(depth: tuple[float, float], half_spaces: Array) -> Array:
    """Return the packed region of a range of depth and half-spaces (h, 4)."""
    return np.concatenate([depth, half_spaces.ravel()])


def half_spaces(region: Array) -> Array:
    """Return the half-spaces (h, 4) of a packed region."""
    return region[2:].reshape(-1, 4)


def box_half_spaces(limits: Mapping[str, tuple[float, float]]) -> Array:
    """Return the half-spaces (h, 4) between two values of some axes (`AXES`)."""
    axes = np.eye(3)[[AXES.index(axis) for axis in limits]].reshape(-1, 3)
    low, high = np.array(list(limits.values())).reshape(-1, 2).T
    return np.concatenate([np.column_stack([-axes, -low]), np.column_stack([axes, high])])


def prism_half_spaces(corners: Sequence[Sequence[float]], up: Sequence[float], heights: tuple[float, float]) -> Array:
    """Return the half-spaces (2 + k, 4) of a prism over a convex polygon of k corners in a plane: ends, then sides.

    The heights are those over the plane, on the side of `up`. Raises ValueError for corners that are no convex polygon
    in a plane, in order, or a plane that `up` lies in.
    """
    if len(corners) < 3:
        raise ValueError(f"expected three corners or more, found {len(corners)}")
    points, upward = np.array(corners, dtype=np.float64), np.array(up, dtype=np.float64)
    sides = np.roll(points, -1, axis=0) - points
    area = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    size = float(np.ptp(points, axis=0).max())
    if not np.linalg.norm(area) > EVEN * size**2:
        raise ValueError("expected the corners of a convex polygon in order, found corners on a line")
    normal = area / np.linalg.norm(area)
    if not abs(normal @ upward) > EVEN * np.linalg.norm(upward):
        raise ValueError("expected an `up` that leaves the plane of the corners, found one within it")
    if normal @ upward < 0.0:
        normal, points, sides = -normal, points[::-1], -np.roll(sides[::-1], -1, axis=0)
    level = float((points @ normal).mean())
    outward = np.cross(sides, normal)
    outward /= np.maximum(np.linalg.norm(outward, axis=1), 1e-300)[:, None]
    offsets = (outward * points).sum(axis=1)
    if np.abs(points @ normal - level).max() > EVEN * size:
        raise ValueError("expected corners in a plane, found corners beside it")
    if (points @ outward.T - offsets).max() > EVEN * size:
        raise ValueError("expected the corners of a convex polygon in order, found others")
    ends = np.array([[*-normal, -(level + heights[0])], [*normal, level + heights[1]]])
    return np.concatenate([ends, np.column_stack([outward, offsets])])


def are_inside(positions: Array, spaces: Array) -> Booleans:
    """Whether positions (n, 3) are inside all half-spaces (h, 4)."""
    return np.asarray((positions @ spaces[:, :3].T <= spaces[:, 3]).all(axis=1))


def rays_meet(center: Array, directions: Array, region: Array) -> Booleans:
    """Whether rays from a centre (3,) in directions (n, 3) of the world, of depth 1, pass through a packed region."""
    spaces = half_spaces(region)
    along = directions @ spaces[:, :3].T
    room = spaces[:, 3] - spaces[:, :3] @ center
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = room / along
    # a ray along the border of a half-space is inside it or not, at any depth
    low = np.where(along < 0.0, reach, np.where((along == 0.0) & (room < 0.0), np.inf, -np.inf))
    high = np.where(along > 0.0, reach, np.inf)
    nearest, farthest = max(region[0], 0.0), region[1]
    return np.asarray(low.max(axis=1, initial=nearest) < high.min(axis=1, initial=farthest))
