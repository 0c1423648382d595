"""Time of the association marginals of dense clusters: it must stay bounded, whatever the tracks look like.

    python benchmarks/dense_association.py --tracks 2000

Tracks stand at random places in a square; every track makes a detection, and a gate holds `neighbours` detections on
average, so that from some three on nearly all are one cluster. Prints a Markdown table: seconds of belief propagation
alone and of the package's association (the slowest of three events each), and the largest difference of a marginal
between the two. Ends with 1 if an event takes more than the limit.
"""

from __future__ import annotations

import argparse
import sys
import time

import common  # noqa: F401  (first: sets the number of threads)

# isort: split
import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.multi.association import belief, exact_association

NEIGHBOURS = (1.0, 3.0, 10.0, 30.0, 100.0)
EVENTS = 3
# Slowest event, s, of 2000 tracks with up to 100 detections in a gate.
LIMIT_S = 1.0
PEAK_ODDS = 1e4


def problem(count: int, neighbours: float, seed: int) -> tuple[Integers, Integers, Array, int, int]:
    """Return the pairs of one event: detections in order of their first coordinate."""
    rng = np.random.default_rng(seed)
    tracks = rng.random((count, 2))
    # density of detections is `count`: a gate of this radius holds `neighbours` of them
    radius = float(np.sqrt(neighbours / (np.pi * count)))
    sigma = radius / 3.0
    detections = tracks + sigma * rng.standard_normal((count, 2))
    detections = detections[np.argsort(detections[:, 0])]
    owners, wanted, odds = [], [], []
    for i, place in enumerate(tracks):
        squared = ((detections - place) ** 2).sum(axis=1) / sigma**2
        near = np.flatnonzero(squared < 9.0)
        owners.append(np.full(len(near), i))
        wanted.append(near)
        odds.append(PEAK_ODDS * np.exp(-0.5 * squared[near]))
    return np.concatenate(owners), np.concatenate(wanted), np.concatenate(odds), count, count


def slowest(function: object, problems: list[tuple[Integers, Integers, Array, int, int]]) -> float:
    """Seconds of the slowest problem, compiled."""
    worst = 0.0
    for one in problems:
        start = time.perf_counter()
        function(*one)  # type: ignore[operator]
        worst = max(worst, time.perf_counter() - start)
    return worst


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tracks", type=int, default=2000)
    options = parser.parse_args()
    warm = problem(5, 3.0, 0)
    slowest(belief.propagate_beliefs, [warm])
    slowest(exact_association.association_marginals, [warm])
    print("| detections a gate | pairs | belief propagation, s | cluster by cluster, s | largest difference |")
    print("|---|---|---|---|---|")
    worst = 0.0
    for neighbours in NEIGHBOURS:
        problems = [problem(options.tracks, neighbours, seed) for seed in range(EVENTS)]
        plain = slowest(belief.propagate_beliefs, problems)
        ours = slowest(exact_association.association_marginals, problems)
        worst = max(worst, ours)
        one = belief.propagate_beliefs(*problems[0])[0]
        other = exact_association.association_marginals(*problems[0])[0]
        print(
            f"| {neighbours:g} | {len(problems[0][0])} | {plain:.3f} | {ours:.3f} | {np.abs(one - other).max():.3f} |",
            flush=True,
        )
    met = worst <= LIMIT_S
    print(f"\nslowest event {worst:.2f} s, limit {LIMIT_S:g} s: {'met' if met else 'MISSED'}")
    sys.exit(0 if met else 1)


if __name__ == "__main__":
    main()
