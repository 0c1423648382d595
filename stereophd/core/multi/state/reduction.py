"""Mixture reduction: components near each other in the covariances of both are merged."""

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.linear_algebra import cholesky, squared_distance
from stereophd.core.numerics.moments import add_part
from stereophd.core.numerics.sorting import copy_gaussian


@compiled
def merge_sorted(mixture: GaussianMixture, shares: Array, distance: float) -> tuple[Array, Array, Array, Integers]:
    """Merge components in falling order of their weights.

    Components are compared only with those at home in the same camera at the same time. One is merged into a heavier
    one below a squared Mahalanobis distance in the covariances of both. In that of the lighter alone (Vo and Ma 2006,
    Table II) a component of known depth would absorb every light one of unknown depth, and its own depth would be
    unknown too. `shares` (n,) are what each component counts for the mean and the covariance of a merged one; the
    weights for its moments as a part of the intensity. Returns the merged weights, means and covariances, and the index
    of the heaviest part of each.
    """
    weights, means, covariances, cameras, times, _, _, _ = mixture
    count, size = means.shape
    used = np.zeros(count, dtype=np.bool_)
    factored = np.zeros(count, dtype=np.bool_)
    factors = np.empty((count, size, size))
    out_weights = np.empty(count)
    out_means, out_covariances = np.zeros((count, size)), np.zeros((count, size, size))
    leaders = np.empty(count, dtype=np.int64)
    members = np.empty(count, dtype=np.int64)
    difference = np.empty(size)
    scratch = np.empty(size)
    first, reaches = means[:, 0].copy(), distance * covariances[:, 0, 0]
    candidates = np.empty(count, dtype=np.int64)
    merged = 0
    for leader in range(count):
        if used[leader]:
            continue
        members[0] = leader
        n_members = 1
        begin = leader + 1
        _mark_candidates(
            cameras[leader], times[leader], first[leader], reaches[leader],
            cameras[begin:], times[begin:], first[begin:], reaches[begin:], candidates[begin:]
        )  # fmt: skip
        for k in range(begin, count):
            if candidates[k] == 0 or used[k]:
                continue
            near = True
            for a in range(size):
                difference[a] = means[k, a] - means[leader, a]
                # a squared Mahalanobis distance is at least that of each coordinate alone
                reach = min(covariances[k, a, a], covariances[leader, a, a])
                if difference[a] * difference[a] > distance * reach:
                    near = False
                    break
            if not near:
                continue
            if not factored[k]:
                factored[k] = cholesky(covariances[k], factors[k])
                if not factored[k]:
                    continue
            if squared_distance(difference, factors[k], scratch) > distance:
                continue
            if not factored[leader]:
                factored[leader] = cholesky(covariances[leader], factors[leader])
            if factored[leader] and squared_distance(difference, factors[leader], scratch) <= distance:
                members[n_members] = k
                n_members += 1
        if n_members == 1:
            # most are alone: the sums below, of one part
            out_weights[merged], leaders[merged] = weights[leader], leader
            copy_gaussian(means, covariances, leader, out_means, out_covariances, merged)
            merged += 1
            continue
        total, whole = 0.0, 0.0
        for m in range(n_members):
            used[members[m]] = True
            total += weights[members[m]]
            whole += shares[members[m]]
        mean, covariance = out_means[merged], out_covariances[merged]
        for m in range(n_members):
            for a in range(size):
                mean[a] += shares[members[m]] / whole * means[members[m], a]
        for m in range(n_members):
            k = members[m]
            add_part(shares[k] / whole, means[k], covariances[k], mean, covariance)
        out_weights[merged] = total
        leaders[merged] = leader
        merged += 1
    return out_weights[:merged], out_means[:merged], out_covariances[:merged], leaders[:merged]


@compiled
def _mark_candidates(
    camera: int,
    time: float,
    place: float,
    reach: float,
    cameras: Integers,
    times: Array,
    first: Array,
    reaches: Array,
    candidates: Integers,
) -> None:
    """Mark components (n,) at home at the same place and time that the first coordinate does not rule out.

    One loop without branches and over whole arrays, which the compiler turns into vector instructions, rules out most
    components. `reach` and `reaches` are the largest squares of differences of the first coordinate.
    """
    for k in range(len(first)):
        square = (first[k] - place) * (first[k] - place)
        candidates[k] = (cameras[k] == camera) & (times[k] == time) & (square <= reaches[k]) & (square <= reach)
