"""Trajectory GOSPA: one distance of two sets of trajectories that counts errors, missed, false and switched tracks.

An assignment of tracks to objects is sought at all scans together. A scan costs what GOSPA (alpha 2) costs under it,
and between two scans each pair that begins or ends costs half of ``switch_cost**order``: an object that goes over from
one track to another costs a whole one. Assignments may be shared out (weights between 0 and 1), which makes the problem
a linear program and the distance a metric. Only couples of an object and a track that are nearer than the cutoff at
some scan can lower the cost; their weights are the variables.

Reference: A. F. Garcia-Fernandez, A. S. Rahmathullah, L. Svensson, "A metric on the space of finite sets of
trajectories for evaluation of multi-target tracking algorithms", IEEE Trans. Signal Processing 68, 2020.
"""

import math
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.matching.near_pairs import NearPairs, couples
from stereophd.core.metrics.scans import PointSets
from stereophd.errors import InputError

# Weights that the linear program may have: it takes about a minute.
MOST_WEIGHTS = 300_000
# Larger costs, as a power of ten, are infinite for the solver.
LARGEST_EXPONENT = 18


@dataclass(frozen=True)
class TrajectoryGospa:
    """The distance and its parts, each a sum over the scans, to the power of the order."""

    localisation: float
    missed: float
    false: float
    switched: float
    switches: float  # How many whole switches that is
    scans: int

    def mean(self, order: float) -> float:
        """Return the distance divided by the number of scans, under the root: it does not grow with their number."""
        total = self.localisation + self.missed + self.false + self.switched
        return float((total / max(self.scans, 1)) ** (1.0 / order))


def trajectory_gospa(
    estimates: PointSets, truth: PointSets, near: NearPairs, order: float, cutoff: float, switch_cost: float
) -> TrajectoryGospa:
    """Return the trajectory GOSPA distance of tracks and objects over all scans, which are in order of time.

    Estimates have identities; `near` holds all pairs nearer than the cutoff. A switch costs `switch_cost`, in the unit
    of the distance. Raises InputError when the linear program would be too large.
    """
    scans = estimates.scans
    if order * math.log10(max(cutoff, switch_cost)) > LARGEST_EXPONENT:
        raise InputError(
            f"`switch_cost`: expected powers of it and of the cutoff below 1e{LARGEST_EXPONENT}, found {switch_cost:g} "
            f"and {cutoff:g} with order {order:g}"
        )
    half, half_switch = cutoff**order / 2.0, switch_cost**order / 2.0
    both = couples(estimates, truth, near)
    count = len(both.objects)
    if count * scans > MOST_WEIGHTS:
        raise InputError(
            f"`switch_cost`: expected at most {MOST_WEIGHTS} weights of couples and scans, found {count} couples and "
            f"{scans} scans; choose a shorter time by `from_s` and `to_s`"
        )
    errors = (near.ratio * cutoff) ** order
    gain = np.zeros((count, scans))
    gain[both.number, near.scan] = errors - 2.0 * half
    weights, changes = _solve(gain, both.objects, both.tracks, half_switch)
    matched = weights[both.number, near.scan]
    assigned = float(matched.sum())
    switched = float(changes.sum())
    return TrajectoryGospa(
        localisation=float(errors @ matched),
        missed=half * (len(truth.label) - assigned),
        false=half * (len(estimates.label) - assigned),
        switched=half_switch * switched,
        switches=switched / 2.0,
        scans=scans,
    )


def _solve(gain: Array, objects: Integers, tracks: Integers, half_switch: float) -> tuple[Array, Array]:
    """Return the weights (c, k) of couples and how much they change between scans (c, k - 1), of least cost."""
    from scipy.optimize import linprog  # costly to import, and few evaluations need it
    from scipy.sparse import coo_array, csr_array, eye_array, hstack, kron, vstack

    count, scans = gain.shape
    if count == 0:
        return gain, gain[:, 1:]

    def once(of: Integers) -> csr_array:
        """Rows: an object (a track) has at most one partner at each scan."""
        number = np.unique(of, return_inverse=True)[1]
        sums = coo_array((np.ones(count), (number, np.arange(count))))
        return kron(sums, eye_array(scans), format="csr")

    step = eye_array(scans - 1, scans, k=1) - eye_array(scans - 1, scans)
    change = kron(eye_array(count), step, format="csr")
    limits = vstack([once(objects), once(tracks)], format="csr")
    slack = eye_array(count * (scans - 1), format="csr")
    rows = vstack(
        [
            hstack([limits, csr_array((limits.shape[0], slack.shape[0]))]),
            hstack([change, -slack]),
            hstack([-change, -slack]),
        ],
        format="csr",
    )
    most = np.concatenate([np.ones(limits.shape[0]), np.zeros(2 * slack.shape[0])])
    cost = np.concatenate([gain.ravel(), np.full(slack.shape[0], half_switch)])
    solution = linprog(cost, A_ub=rows, b_ub=most, bounds=(0.0, 1.0), method="highs").x
    weights = solution[: count * scans].reshape(count, scans)
    return weights, np.abs(np.diff(weights, axis=1))
