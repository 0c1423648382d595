"""Cramer-Rao bound of points that stand still, seen in several views, which detection is of which point being known.

The information of a point x is the sum over its detections of H^T R^-1 H, H the derivative of the pixel with respect to
x (R. Hartley and A. Zisserman, "Multiple View Geometry in Computer Vision", section 5.2), plus that of the prior of its
disparity before the camera that saw it first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.bounds.known_association import AssociatedDetections
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.projection import projective
from stereophd.core.multi.filter_settings.common import BirthPrior


def static_point_information(
    detections: AssociatedDetections,
    positions: Array,
    first: Sequence[DisparitySpace | None],
    prior: BirthPrior,
) -> Array:
    """Return the information (n, 3, 3) of points, in 1 / length^2; the inverse bounds the covariance of estimates.

    True positions (n, 3) are in the world. `first` has the space of the camera that saw each point first; None of a
    point that no camera saw, whose information is 0.
    """
    information = np.zeros((len(positions), 3, 3))
    slopes = detections.whitening @ projective(detections.projection, positions[detections.row])[1]
    np.add.at(information, detections.row, np.swapaxes(slopes, 1, 2) @ slopes)
    for row, space in enumerate(first):
        if space is None:
            continue
        _, std = prior.disparity_moments(space.packed())
        slope = projective(space.projective_matrix, positions[row : row + 1])[1][0, 2]
        information[row] += np.outer(slope, slope) / std**2
    return information
