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

from stereophd.core.arrays import Array
from stereophd.core.disparity.moments import Sources, move
from stereophd.core.disparity.moved import PARTLY_IN_VIEW, Moved
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.numerics.samples import Method, draw_sample_sets

FOLDER = Path(__file__).resolve().parent
# Okabe and Ito's colours, which most colour-blind readers can distinguish.
COLORS = {"qmc": "#0072B2", "particle": "#009E73", "unscented": "#D55E00", "linear": "#CC79A7"}
STYLES = {"qmc": "-", "particle": "--", "unscented": "-.", "linear": ":"}
TITLES: dict[Method, str] = {
    "qmc": "qmc, 64 samples",
    "particle": "particle, 64 samples",
    "unscented": "unscented, 24 points",
    "linear": "linear",
}
SAMPLES = 64
# The image of the first figure is this number of pixels larger on all sides, and its pixels are shown without them.
MARGIN = 1000
SHIFT = np.array([MARGIN, MARGIN, 0.0])
MAX_SPEED = 6.0  # cm/s
CLOUD = 200_000
SHOWN = 2500
AXIS_NAMES = ("u, px", "v, px", "d, px")


def main() -> None:
    """Draw all figures."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 110})
    # Figure 7: 200 cm apart, pi/8; the border of the image, which is not its subject, far out
    left, right = _camera("left", -100.0, -22.5, margin=MARGIN), _camera("right", 100.0, 22.5, margin=MARGIN)
    draw_moves(DisparitySpace(left), DisparitySpace(right), FOLDER / "moves.png")
    # the multi-object experiment of section VIII-C
    left, right = _camera("left", -20.0, -15.0), _camera("right", 20.0, 15.0)
    draw_split(DisparitySpace(left), DisparitySpace(right), FOLDER / "split.png")


def _camera(name: str, x: float, yaw_deg: float, margin: int = 0) -> Camera:
    """Return a camera of the paper's Table I, `margin` pixels wider on all sides; lengths in cm."""
    rotation = rotation_from_vector(np.array([0.0, math.radians(yaw_deg), 0.0]))
    pose = Pose(rotation, np.array([x, 0.0, 0.0]))
    detector = Detector((math.sqrt(2.0), math.sqrt(2.0)), 0.95, 10.0)
    size, center = (800 + 2 * margin, 600 + 2 * margin), (400.0 + margin, 300.0 + margin)
    return Camera(name, *size, 898.876, 888.889, *center, pose, Lens("none"), detector)


def _gaussian(space: DisparitySpace, position: Array, stds: Array, velocity: Array) -> tuple[Array, Array]:
    """Gaussian around the disparity point `position` (u, v, d), of an object with a velocity in the world.

    `stds` are of u, v, d (px) and of each component of velocity (length/s). By the moments of a cloud, as
    births have them in closed form: velocities in disparity space depend on the disparity.
    """
    rng = np.random.default_rng(3)
    points = position + rng.standard_normal((CLOUD, 3)) * stds[:3]
    world = space.to_world(points)
    velocities = velocity + rng.standard_normal((CLOUD, 3)) * stds[3]
    states = space.from_world(np.concatenate([world, velocities], axis=1))
    return states.mean(axis=0), np.cov(states.T)


def _carry(
    method: Method, mean: Array, covariance: Array, home: DisparitySpace, to: DisparitySpace, dt: float,
    motion: ConstantVelocity, p_detect: float = 1.0, samples: int = SAMPLES,
) -> Moved:  # fmt: skip
    sets = draw_sample_sets(method, samples, 12, np.random.SeedSequence(1))
    sources = Sources(mean[None], covariance[None], home.packed()[None], motion.arrays(np.array([dt])))
    return move(sources, to.packed(), sets, 0, p_detect)


def _cloud(
    mean: Array, covariance: Array, home: DisparitySpace, to: DisparitySpace, dt: float, motion: ConstantVelocity
) -> Array:
    """Carry pseudo-random samples over by the textbook: to the world, F x + noise, to the other space."""
    rng = np.random.default_rng(2)
    world = home.to_world(rng.multivariate_normal(mean, covariance, CLOUD))
    speed = np.linalg.norm(world[:, 3:], axis=1, keepdims=True)
    world[:, 3:] *= np.minimum(1.0, (motion.max_speed or np.inf) / speed)
    transition, noise, drift = motion.transition(dt)
    world = world @ transition.T + drift + rng.multivariate_normal(np.zeros(6), noise, CLOUD)
    return to.from_world(world)


def draw_moves(left: DisparitySpace, right: DisparitySpace, path: Path) -> None:
    """After the paper's Figures 4 and 7: a Gaussian before and after a move, by each method."""
    cases = (
        (
            "Same camera, 15 s later: motion and its noise (as Fig. 4)",
            left, left, 15.0, ConstantVelocity([math.sqrt(0.08)] * 3, MAX_SPEED), np.array([2.0, 2.0, 0.5]),
            np.array([4.0, 4.0, 2.0, 0.5]), np.array([1130.0, 1080.0, 7.0]), ((0, 1), (1, 2)),
        ),
        (
            "Left camera's space to the right's, at once (as Fig. 7)",
            left, right, 0.0, ConstantVelocity([0.0] * 3, MAX_SPEED), np.zeros(3),
            np.array([15.0, 15.0, 1.0, 0.17]), np.array([1400.0, 1330.0, 4.0]), ((0, 1), (1, 2)),
        ),
    )  # fmt: skip
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 7.0), layout="constrained")
    for row, (title, home, to, dt, motion, velocity, stds, position, planes) in zip(axes, cases, strict=True):
        mean, covariance = _gaussian(home, position, stds, velocity)
        cloud = _cloud(mean, covariance, home, to, dt, motion)
        moved = {method: _carry(method, mean, covariance, home, to, dt, motion) for method in TITLES}
        for axis, plane in zip(row, planes, strict=True):
            pick = np.array(plane)
            axis.plot(*(cloud[:SHOWN, :3] - SHIFT)[:, pick].T, ".", ms=1.5, color="0.72", label=f"{CLOUD:,} samples")
            _ellipse(
                axis, cloud.mean(axis=0)[:3] - SHIFT, np.cov(cloud.T), pick, color="0.15", alpha=0.3, lw=5.0,
                label="their moments",
            )  # fmt: skip
            if home is to:
                _ellipse(axis, mean[:3] - SHIFT, covariance, pick, color="0.3", lw=1.0, label="before the move")
            for method, name in TITLES.items():
                _ellipse(
                    axis, moved[method].means[0, :3] - SHIFT, moved[method].covariances[0], pick,
                    color=COLORS[method], ls=STYLES[method], lw=1.6, label=name,
                )  # fmt: skip
            axis.set(xlabel=AXIS_NAMES[plane[0]], ylabel=AXIS_NAMES[plane[1]])
            _limits(axis, (cloud[:, :3] - SHIFT)[:, pick])
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
    position, stds = np.array([edge + 5.0, 300.0, 7.0]), np.array([std, 5.0, 0.5, 0.5])
    mean, covariance = _gaussian(space, position, stds, np.zeros(3))
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
    axis.text(edge - 2, 0.0198, "image", ha="right", va="bottom")
    axis.set(xlabel="u, px", ylabel="density, 1/px", ylim=(0, 0.0285))
    axis.set_title(f"Across the edge, p_D = {p_detect} inside (as Fig. 8)", loc="left", fontsize=10)
    axis.legend(frameon=False, loc="upper left", fontsize=8)


def _split_between_cameras(axis: Axes, left: DisparitySpace, right: DisparitySpace) -> None:
    """An object of the left camera, its depth hardly known, in the right camera's image."""
    position, stds = np.array([520.0, 330.0, 7.0]), np.array([30.0, 30.0, 3.0, 0.5])
    mean, covariance = _gaussian(left, position, stds, np.zeros(3))
    motion = ConstantVelocity([0.0] * 3)
    cloud = _cloud(mean, covariance, left, right, 0.0, motion)
    moved = _carry("qmc", mean, covariance, left, right, 0.0, motion, 0.95, samples=256)
    assert moved.status[0] == PARTLY_IN_VIEW
    shown = cloud[:SHOWN]
    inside = (shown[:, 0] >= -0.5) & (shown[:, 0] <= 799.5)
    for mask, color, name in ((~inside, "0.7", "out of view"), (inside, COLORS["particle"], "in view")):
        axis.plot(*shown[mask][:, [0, 2]].T, ".", ms=2.5, color=color, label=f"samples {name}", zorder=1)
    pick = np.array([0, 2])
    _ellipse(
        axis, moved.means[0], moved.covariances[0], pick, color=COLORS["qmc"], lw=1.6,
        label=f"part in view, {moved.fraction[0]:.2f}",
    )  # fmt: skip
    axis.axvline(799.5, color="black", lw=0.8, ls=":")
    axis.text(795.0, -4.0, "image", ha="right", va="bottom")
    axis.set(xlabel="u in the right camera, px", ylabel="d in the right camera, px", xlim=(100, 1150), ylim=(-4, 19))
    axis.set_title("From the left camera to the right, depth uncertain", loc="left", fontsize=10)
    axis.legend(frameon=False, loc="upper right", fontsize=8)


def _normal(x: Array, mean: float, variance: float) -> Array:
    return np.exp(-0.5 * (x - mean) ** 2 / variance) / math.sqrt(2.0 * math.pi * variance)


def _ellipse(axis: Axes, mean: Array, covariance: Array, pick: NDArray[np.int64], **style: Any) -> None:
    """Draw the ellipse of two standard deviations in a plane."""
    values, vectors = np.linalg.eigh(covariance[np.ix_(pick, pick)])
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    width, height = 4.0 * np.sqrt(values[::-1])
    axis.add_patch(Ellipse(tuple(mean[pick]), width, height, angle=angle, fill=False, zorder=3, **style))


def _limits(axis: Axes, points: Array) -> None:
    low, high = np.quantile(points, [0.002, 0.998], axis=0)
    margin = 0.12 * (high - low)
    axis.set(xlim=(low[0] - margin[0], high[0] + margin[0]), ylim=(low[1] - margin[1], high[1] + margin[1]))


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main()
