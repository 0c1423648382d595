"""Draw the figures of docs/method.md beside this file, from the package's own code.

    python docs/figures/make.py
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
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from stereophd.disparity.moments import PARTLY_IN_VIEW, Moved, move
from stereophd.disparity.samples import Method, draw_sample_sets
from stereophd.disparity.space import DisparitySpace
from stereophd.geometry.camera import Camera, Detector
from stereophd.geometry.lens import Lens
from stereophd.geometry.pose import Pose, rotation_from_vector
from stereophd.motion import ConstantVelocity

Array = NDArray[np.float64]

FOLDER = Path(__file__).resolve().parent
# Okabe and Ito's colours, told apart by everybody.
COLORS = {"qmc": "#0072B2", "particle": "#009E73", "unscented": "#D55E00", "linear": "#CC79A7"}
STYLES = {"qmc": "-", "particle": "--", "unscented": "-.", "linear": ":"}
TITLES = {
    "qmc": "qmc, 64 samples",
    "particle": "particle, 64 samples",
    "unscented": "unscented, 24 points",
    "linear": "linear",
}
SAMPLES = 64
CLOUD = 200_000
SHOWN = 2500
AXIS_NAMES = ("u, px", "v, px", "d, px")


def main() -> None:
    """Draw all figures."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 110})
    left, right = _camera("left", -20.0, -15.0), _camera("right", 20.0, 15.0)
    draw_moves(DisparitySpace(left), DisparitySpace(right), FOLDER / "moves.png")
    draw_split(DisparitySpace(left), DisparitySpace(right), FOLDER / "split.png")


def _camera(name: str, x: float, yaw_deg: float) -> Camera:
    """Return a camera of the paper's multi-object experiment (section VIII-C); lengths in cm."""
    rotation = rotation_from_vector(np.array([0.0, math.radians(yaw_deg), 0.0]))
    pose = Pose(rotation, np.array([x, 0.0, 0.0]))
    detector = Detector((math.sqrt(2.0), math.sqrt(2.0)), 0.95, 10.0)
    return Camera(name, 800, 600, 898.876, 888.889, 400.0, 300.0, pose, Lens("none"), detector)


def _gaussian(space: DisparitySpace, pixel: tuple[float, float], stds: Array, velocity: Array) -> tuple[Array, Array]:
    """Gaussian at a pixel: mean disparity 7 px and this velocity in the world, independent coordinates."""
    mean = np.zeros(6)
    mean[:3] = (*pixel, 7.0)
    world = space.to_world(mean[None])
    world[0, 3:] = velocity
    return space.from_world(world)[0], np.diag(stds**2)


def _carry(
    method: Method, mean: Array, covariance: Array, home: DisparitySpace, to: DisparitySpace, dt: float,
    motion: ConstantVelocity, p_detect: float = 1.0, samples: int = SAMPLES,
) -> Moved:  # fmt: skip
    sets = draw_sample_sets(method, samples, 12, np.random.SeedSequence(1))
    return move(
        mean[None], covariance[None], home.packed()[None], np.array([dt]), to.packed(), motion, sets, 0, p_detect
    )


def _cloud(
    mean: Array, covariance: Array, home: DisparitySpace, to: DisparitySpace, dt: float, motion: ConstantVelocity
) -> Array:
    """Carry pseudo-random samples over by the textbook: to the world, F x + noise, to the other space."""
    rng = np.random.default_rng(2)
    world = home.to_world(rng.multivariate_normal(mean, covariance, CLOUD))
    transition, noise = motion.transition(dt)
    world = world @ transition.T + rng.multivariate_normal(np.zeros(6), noise, CLOUD)
    return to.from_world(world)


def draw_moves(left: DisparitySpace, right: DisparitySpace, path: Path) -> None:
    """After the paper's Figures 4 and 7: a Gaussian before and after a move, by each method."""
    moving = np.array([2.0, 2.0, 0.5])  # cm/s, as in Figure 4
    cases = (
        (
            "Same camera, 6 s later (as Fig. 4)",
            left, left, 6.0, ConstantVelocity([math.sqrt(0.08)] * 3), moving,
            np.array([4.0, 4.0, 1.6, 0.3, 0.3, 0.05]), (330.0, 230.0), ((0, 1), (1, 2)),
        ),
        (
            "Left camera's space to the right's, at once (as Fig. 7)",
            left, right, 0.0, ConstantVelocity([0.0] * 3), 0.0 * moving,
            np.array([12.0, 12.0, 1.6, 0.3, 0.3, 0.05]), (430.0, 330.0), ((0, 1), (0, 2)),
        ),
    )  # fmt: skip
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 7.0), layout="constrained")
    for row, (title, home, to, dt, motion, velocity, stds, pixel, planes) in zip(axes, cases, strict=True):
        mean, covariance = _gaussian(home, pixel, stds, velocity)
        cloud = _cloud(mean, covariance, home, to, dt, motion)
        for axis, plane in zip(row, planes, strict=True):
            pick = np.array(plane)
            axis.plot(*cloud[:SHOWN, pick].T, ".", ms=1.5, color="0.72", label=f"cloud ({CLOUD:,} samples)")
            _ellipse(axis, cloud.mean(axis=0), np.cov(cloud.T), pick, color="black", lw=2.2, label="its moments")
            if home is to:
                _ellipse(axis, mean, covariance, pick, color="0.45", lw=1.0, label="before the move")
            for method in ("qmc", "particle", "unscented", "linear"):
                moved = _carry(method, mean, covariance, home, to, dt, motion)
                _ellipse(
                    axis, moved.means[0], moved.covariances[0], pick, color=COLORS[method],
                    ls=STYLES[method], lw=1.6, label=TITLES[method],
                )  # fmt: skip
            axis.set(xlabel=AXIS_NAMES[plane[0]], ylabel=AXIS_NAMES[plane[1]])
            _limits(axis, cloud[:, pick])
        row[0].set_title(title, loc="left", fontsize=10)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    _save(figure, path)


def draw_split(left: DisparitySpace, right: DisparitySpace, path: Path) -> None:
    """After the paper's Figure 8: a Gaussian across the edge of the image, detected and missed part."""
    figure, (one, two) = plt.subplots(1, 2, figsize=(9.0, 3.9), layout="constrained")
    _split_along_u(one, left)
    _split_between_cameras(two, left, right)
    _save(figure, path)


def _split_along_u(axis: Axes, space: DisparitySpace) -> None:
    p_detect, edge, std = 0.9, 799.5, 20.0
    stds = np.array([std, 5.0, 0.5, 0.1, 0.1, 0.01])
    mean, covariance = _gaussian(space, (edge + 5.0, 300.0), stds, np.zeros(3))
    motion = ConstantVelocity([0.0] * 3)
    moved = _carry("qmc", mean, covariance, space, space, 0.0, motion, p_detect, samples=1024)
    assert moved.status[0] == PARTLY_IN_VIEW
    u = np.linspace(mean[0] - 4 * std, mean[0] + 4 * std, 801)
    whole = _normal(u, mean[0], std**2)
    seen = p_detect * (u <= edge)
    detected = p_detect * moved.fraction[0]
    parts = (
        ("detected", COLORS["qmc"], seen, detected, moved.means[0], moved.covariances[0]),
        ("missed", COLORS["unscented"], 1 - seen, 1 - detected, moved.missed_means[0], moved.missed_covariances[0]),
    )
    axis.plot(u, whole, color="0.6", lw=1.0, label="whole")
    for name, color, weight, total, part_mean, part_covariance in parts:
        axis.fill_between(u, weight * whole, color=color, alpha=0.18, lw=0)
        fitted = total * _normal(u, part_mean[0], part_covariance[0, 0])
        axis.plot(u, fitted, color=color, lw=1.6, label=f"{name}, weight {total:.2f}")
    axis.axvline(edge, color="black", lw=0.8, ls=":")
    axis.text(edge - 2, axis.get_ylim()[1], "image", ha="right", va="top")
    axis.set(xlabel="u, px", ylabel="density, 1/px", ylim=(0, None))
    axis.set_title(f"Across the edge, p_D = {p_detect} inside (as Fig. 8)", loc="left", fontsize=10)
    axis.legend(frameon=False, loc="upper left", fontsize=8)


def _split_between_cameras(axis: Axes, left: DisparitySpace, right: DisparitySpace) -> None:
    """A detection of the left camera with its depth hardly known, in the right camera's image."""
    stds = np.array([1.4, 1.4, 3.0, 0.1, 0.1, 0.01])
    mean, covariance = _gaussian(left, (400.0, 330.0), stds, np.zeros(3))
    motion = ConstantVelocity([0.0] * 3)
    cloud = _cloud(mean, covariance, left, right, 0.0, motion)
    moved = _carry("qmc", mean, covariance, left, right, 0.0, motion, 0.95, samples=256)
    assert moved.status[0] == PARTLY_IN_VIEW
    shown = cloud[:SHOWN]
    inside = (shown[:, 0] >= -0.5) & (shown[:, 0] <= 799.5)
    for mask, color, name in ((~inside, "0.7", "out of view"), (inside, COLORS["particle"], "in view")):
        axis.plot(*shown[mask][:, [0, 2]].T, ".", ms=2.5, color=color, label=f"samples {name}")
    pick = np.array([0, 2])
    _ellipse(
        axis, moved.means[0], moved.covariances[0], pick, color=COLORS["qmc"], lw=1.6,
        label=f"part in view, {moved.fraction[0]:.2f}",
    )  # fmt: skip
    for edge in (-0.5, 799.5):
        axis.axvline(edge, color="black", lw=0.8, ls=":")
    axis.set(xlabel="u in the right camera, px", ylabel="d in the right camera, px", xlim=(-700, 1100), ylim=(-2, 22))
    axis.set_title("A newborn of the left camera, for the right one", loc="left", fontsize=10)
    axis.legend(frameon=False, loc="upper right", fontsize=8)


def _normal(x: Array, mean: float, variance: float) -> Array:
    return np.exp(-0.5 * (x - mean) ** 2 / variance) / math.sqrt(2.0 * math.pi * variance)


def _ellipse(axis: Axes, mean: Array, covariance: Array, pick: NDArray[np.int64], **style: Any) -> None:
    """Draw the ellipse of two standard deviations in a plane."""
    values, vectors = np.linalg.eigh(covariance[np.ix_(pick, pick)])
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    width, height = 4.0 * np.sqrt(values[::-1])
    axis.add_patch(Ellipse(tuple(mean[pick]), width, height, angle=angle, fill=False, **style))


def _limits(axis: Axes, points: Array) -> None:
    low, high = np.quantile(points, [0.002, 0.998], axis=0)
    margin = 0.12 * (high - low)
    axis.set(xlim=(low[0] - margin[0], high[0] + margin[0]), ylim=(low[1] - margin[1], high[1] + margin[1]))


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main()
