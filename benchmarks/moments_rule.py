"""Accuracy and cost of the low-order rule and of samples against the non-linearity of the move.

    python benchmarks/moments_rule.py --cases 400

Gaussians of objects before the paper's converging cameras, from well localised to hardly known, are carried from one
camera to the other over 1 s. Beside the measure of non-linearity (`moments.max_nonlinearity` compares with it) stands
the Kullback-Leibler divergence (nats, median of the bin) of each method's Gaussian from that of 131,072 samples, and
the time of a move, relative to 64 quasi-random samples. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import IN_VIEW, Sources
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.numerics.samples import SampleSets, draw_sample_sets

BINS = [0.0, 1e-3, 3e-3, 0.01, 0.03, 0.1, np.inf]
REFERENCE = 2**17
MOTION = ConstantVelocity([0.01] * 3, 6.0)


def camera(x: float, yaw: float) -> Camera:
    """One of the paper's cameras, with an image so large that nothing leaves it."""
    pose = Pose(rotation=rotation_from_vector(np.array([0.0, yaw, 0.0])), center=np.array([x, 0.0, 0.0]))
    detector = Detector((1.41, 1.41), 0.95, 10.0)
    return Camera("camera", 800_000, 600_000, 898.9, 888.9, 4e5, 3e5, pose=pose, lens=Lens("none"), detector=detector)


def divergence(mean: Array, covariance: Array, to_mean: Array, to_covariance: Array) -> float:
    """Kullback-Leibler divergence of a Gaussian from a reference, nats."""
    inverse = np.linalg.inv(to_covariance)
    apart = to_mean - mean
    log_ratio = np.linalg.slogdet(to_covariance)[1] - np.linalg.slogdet(covariance)[1]
    return float(0.5 * (np.trace(inverse @ covariance) + apart @ inverse @ apart - len(mean) + log_ratio))


def draw(rng: np.random.Generator, spaces: list[DisparitySpace]) -> tuple[Array, Array]:
    """A Gaussian at a random place, its disparity known to between 0.1 % and 50 %."""
    world = np.concatenate([rng.uniform([-30.0, -30.0, 80.0], [30.0, 30.0, 250.0]), rng.normal(0.0, 1.5, 3)])
    mean = spaces[0].from_world(world[None])[0]
    relative = np.exp(rng.uniform(np.log(1e-3), np.log(0.5)))
    spread = np.array([1.4, 1.4, relative * mean[2], 1.0, 1.0, relative * mean[2] * 0.02])
    root = np.tril(rng.normal(0.0, 0.3, (6, 6)), -1) + np.eye(6)
    root = spread[:, None] * root / np.linalg.norm(root, axis=1, keepdims=True)
    return mean, root @ root.T


def carried(mean: Array, covariance: Array, spaces: list[DisparitySpace], sets: SampleSets, turn: int) -> tuple:  # type: ignore[type-arg]
    """Status, mean and covariance of a Gaussian in the other camera."""
    sources = Sources(mean[None], covariance[None], spaces[0].packed()[None], MOTION.arrays(np.ones(1)))
    moved = move(sources, spaces[1].packed(), sets, turn)
    return moved.status[0], moved.means[0], moved.covariances[0]


def nonlinearity(mean: Array, covariance: Array, spaces: list[DisparitySpace], sets: SampleSets) -> float:
    """The measure, found by bisection over the limit at which the rule gives way to samples."""
    rule = carried(mean, covariance, spaces, replace(sets, max_nonlinearity=np.inf), 0)[2]
    low, high = 1e-6, 10.0
    for _ in range(30):
        middle = np.sqrt(low * high)
        same = np.array_equal(carried(mean, covariance, spaces, replace(sets, max_nonlinearity=middle), 0)[2], rule)
        low, high = (low, middle) if same else (middle, high)
    return float(high)


def cost(sets: SampleSets, mean: Array, covariance: Array, spaces: list[DisparitySpace]) -> float:
    """Seconds of a move of 200 components, the least of 20."""
    means, covariances = np.repeat(mean[None], 200, 0), np.repeat(covariance[None], 200, 0)
    homes, destination = np.repeat(spaces[0].packed()[None], 200, 0), spaces[1].packed()
    best = np.inf
    for _ in range(20):
        start = time.perf_counter()
        move(Sources(means, covariances, homes, MOTION.arrays(np.ones(200))), destination, sets, 0)
        best = min(best, time.perf_counter() - start)
    return best


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=400)
    options = parser.parse_args()
    rng = np.random.default_rng(20_261_121)
    spaces = [DisparitySpace(camera(-20.0, -0.26)), DisparitySpace(camera(20.0, 0.26))]
    methods = {
        "rule": draw_sample_sets("unscented", 64, 12, np.random.SeedSequence(1)),
        "64 quasi-random": draw_sample_sets("qmc", 64, 12, np.random.SeedSequence(1)),
        "256 quasi-random": draw_sample_sets("qmc", 256, 12, np.random.SeedSequence(1)),
        "64 pseudo-random": draw_sample_sets("particle", 64, 12, np.random.SeedSequence(1)),
    }
    reference = draw_sample_sets("qmc", REFERENCE, 12, np.random.SeedSequence(2))
    adaptive = draw_sample_sets("adaptive", 64, 12, np.random.SeedSequence(1))
    measures, divergences = [], []
    for number in range(options.cases):
        mean, covariance = draw(rng, spaces)
        status, to_mean, to_covariance = carried(mean, covariance, spaces, reference, 0)
        if status != IN_VIEW:
            continue
        measures.append(nonlinearity(mean, covariance, spaces, adaptive))
        found = [carried(mean, covariance, spaces, sets, number) for sets in methods.values()]
        divergences.append([divergence(m, c, to_mean, to_covariance) for _, m, c in found])
    bins = np.digitize(measures, BINS) - 1
    print("| non-linearity | cases | " + " | ".join(methods) + " |")
    print("|---" * (2 + len(methods)) + "|")
    for b in range(len(BINS) - 1):
        rows = np.array(divergences)[bins == b]
        if len(rows):
            cells = " | ".join(f"{value:.2g}" for value in np.median(rows, axis=0))
            print(f"| {BINS[b]:g} to {BINS[b + 1]:g} | {len(rows)} | {cells} |")
    mean, covariance = draw(rng, spaces)
    base = cost(methods["64 quasi-random"], mean, covariance * 1e-4, spaces)
    cells = " | ".join(f"{cost(sets, mean, covariance * 1e-4, spaces) / base:.2f}" for sets in methods.values())
    print(f"| time of a move, relative | | {cells} |")
    relative = cost(adaptive, mean, covariance * 1e-4, spaces) / base
    print(f"\nTime of an adaptive move that ends with the rule, relative: {relative:.2f}")


if __name__ == "__main__":
    main()
