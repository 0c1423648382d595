"""Draw the figures of docs/single_object.md beside this file, from the package's own code.

python docs/figures/make_single.py
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from stereophd.core.arrays import Array
from stereophd.core.bounds.cramer_rao import detection_information, disparity_jacobian, inverse_information
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector

FOLDER = Path(__file__).resolve().parent
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
SIGMAS = 2.0
CLOUD = 200_000


def main() -> None:
    """Draw all figures."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 110})
    draw_uncertainty(FOLDER / "uncertainty.png")
    draw_observation(FOLDER / "observation.png")


def _camera(name: str, x: float, yaw: float, sigma: float = 1.4) -> Camera:
    """Return a camera of the paper's Table I on the x axis; lengths in cm."""
    pose = Pose(rotation_from_vector(np.array([0.0, yaw, 0.0])), np.array([x, 0.0, 0.0]))
    return Camera(
        name, 800, 600, 898.876, 888.889, 400.0, 300.0, pose, Lens("none"), Detector((sigma, sigma), 1.0, 0.0)
    )


def draw_uncertainty(path: Path) -> None:
    """Draw the uncertainty of a position from two detections in both spaces (paper Figure 3)."""
    sigma, point = 8.0, np.array([0.0, 0.0, 150.0])
    left, right = _camera("left", 0.0, 0.0, sigma), _camera("right", 15.0, 0.0, sigma)
    space = DisparitySpace(left, 15.0)
    world = inverse_information(sum(detection_information(c, point[None])[0] for c in (left, right)))
    jacobian = disparity_jacobian(space, point)
    covariance = jacobian @ world @ jacobian.T
    mean = space.from_world(point[None])[0]
    figure, (one, two) = plt.subplots(1, 2, figsize=(9.0, 4.2), layout="constrained", width_ratios=(1, 1.25))

    _curve(one, mean, covariance, (0, 2), color=BLUE, label="Gaussian")
    one.set(xlabel="u, px", ylabel="d, px (baseline 15 cm)")
    one.set_title("Disparity space: Gaussian", loc="left", fontsize=10)

    circle = _circle()
    factor = np.linalg.cholesky(covariance[np.ix_([0, 2], [0, 2])])
    boundary = np.tile(mean, (circle.shape[1], 1))
    boundary[:, [0, 2]] += SIGMAS * (factor @ circle).T
    mapped = space.to_world(boundary)
    rng = np.random.default_rng(1)
    cloud = space.to_world(rng.multivariate_normal(mean, covariance, CLOUD))
    two.plot(cloud[:3000, 2], cloud[:3000, 0], ".", ms=1.2, color="0.78", label="samples", zorder=1)
    two.plot(mapped[:, 2], mapped[:, 0], color=BLUE, lw=1.8, label="the Gaussian of disparity space, mapped")
    _curve(two, point, world, (2, 0), color=ORANGE, ls="--", label="Gaussian in the world, to first order")
    for camera in (left, right):
        for sign in (-1.0, 1.0):
            pixel = camera.project(point[None]) + [[sign * SIGMAS * sigma, 0.0]]
            ends = camera.unproject(np.repeat(pixel, 2, axis=0), np.array([80.0, 260.0]))
            two.plot(ends[:, 2], ends[:, 0], color="0.4", lw=0.7, label=None)
    two.plot(point[2], point[0], "k+", ms=8)
    two.set(xlabel="z, cm", ylabel="x, cm", xlim=(95, 250), ylim=(-5.2, 7.5))
    two.set_title("The world: it is not (as Fig. 3)", loc="left", fontsize=10)
    two.legend(framealpha=1.0, edgecolor="white", loc="upper right", fontsize=8)
    _save(figure, path)


def draw_observation(path: Path) -> None:
    """After the paper's Figure 5: where the right camera sees a point of a ray of the left, by its inverse depth."""
    figure, axis = plt.subplots(figsize=(5.6, 3.9), layout="constrained")
    left = DisparitySpace(_camera("left", 0.0, 0.0))
    inverse_depth = np.linspace(-0.004, 0.02, 400)
    disparity = left.disparity_focal * left.baseline * inverse_depth
    states = np.column_stack([np.full(400, 400.0), np.full(400, 300.0), disparity])
    cases = ((0.0, "rectified", BLUE, "-"), (math.pi / 12, "turned inwards by 15 deg", ORANGE, "--"),
             (-math.pi / 12, "turned outwards by 15 deg", GREEN, "-."))  # fmt: skip
    for yaw, name, color, style in cases:
        right = DisparitySpace(_camera("right", 30.0, yaw))
        axis.plot(inverse_depth, left.map_to(right, states)[:, 0], color=color, ls=style, label=f"right camera {name}")
    axis.axvline(0.0, color="black", lw=0.6, ls=":")
    axis.text(0.0001, axis.get_ylim()[1], "infinity", va="top", fontsize=8)
    axis.set(xlabel="inverse depth before the left camera, 1/cm", ylabel="u in the right camera, px")
    axis.legend(frameon=False, fontsize=8)
    _save(figure, path)


def _circle() -> Array:
    angle = np.linspace(0.0, 2.0 * math.pi, 241)
    return np.stack([np.cos(angle), np.sin(angle)])


def _curve(axis: Axes, mean: Array, covariance: Array, plane: tuple[int, int], **style: Any) -> None:
    """Draw the ellipse of two standard deviations in a plane."""
    pick = np.array(plane)
    points = mean[pick, None] + SIGMAS * np.linalg.cholesky(covariance[np.ix_(pick, pick)]) @ _circle()
    axis.plot(*points, lw=1.6, **style)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main()
