"""Association marginals and evidence, cluster by cluster: exact where that is affordable.

Tracks i and detections j are tied by the odds psi_ij of "i made j" against "i was missed and j is new or clutter". The
pairs fall into clusters that share no track and no detection, and the problem is the product of theirs. A cluster is
solved exactly by the recursion of `multi.association.frontier` if its cost is within a limit. Otherwise it is split
at its weakest links: the probability of a pair is at most psi / (1 + psi). Pairs of small odds are therefore left out
and get p = psi p_i0 p_0j, to first order, afterwards; this changes the other marginals by about psi. A cluster that is
still too large at the last level is solved by loopy belief propagation (`stereophd.core.multi.association.belief`).

Belief propagation is overconfident where associations are ambiguous: for two tracks and two detections with joint odds
3:1 and single odds 1000 it returns 0.997 instead of 0.75, and it loses up to ln 2 of the evidence per pair.
"""

import math

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.multi.association.belief import propagate_beliefs
from stereophd.core.multi.association.frontier import eliminate, make_plan, make_table
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import picked

# Odds below which pairs are left out of a cluster: always (the first), and to split a cluster that is too large.
WEAK_LINKS = (1e-6, 1e-4, 1e-3)
# Columns that the recursion may remember at a time, and multiplications of one pass: some 0.1 ms.
MOST_WIDTH = 12
MOST_COST = 30_000.0
# Larger clusters may cost more in all, but not more a pair: the cost of an event stays proportional to its pairs.
MOST_COST_A_PAIR = 1_000.0
# Products of as many larger odds as the frontier is wide leave the range of floating-point numbers.
MOST_ODDS = 1e20
# Below this cost it does not pay to try detections as rows in place of tracks.
CHEAP = 300.0


@compiled
def association_marginals(
    tracks: Integers, detections: Integers, odds: Array, n_tracks: int, n_detections: int
) -> tuple[Array, Array, Array, float]:
    """Marginal association probabilities of sparse pairs, as those of `stereophd.core.multi.association.belief`.

    The log evidence is that of the sum over all associations of the product of their odds: exact where every
    cluster is.
    """
    pair, missed, unclaimed = np.zeros(len(odds)), np.ones(n_tracks), np.ones(n_detections)
    solved = np.zeros(len(odds), dtype=np.bool_)
    todo = np.arange(len(odds))
    numbers = np.full(n_tracks + n_detections, -1, dtype=np.int64)
    log_evidence = 0.0
    for level in range(len(WEAK_LINKS)):
        last = level + 1 == len(WEAK_LINKS)
        members, bounds = _clusters(tracks, detections, odds, todo, WEAK_LINKS[level], n_tracks, n_detections)
        remaining = 0
        for c in range(len(bounds) - 1):
            cluster = members[bounds[c] : bounds[c + 1]]
            is_solved, value = _solve(tracks, detections, odds, cluster, last, numbers, pair, missed, unclaimed)
            log_evidence += value
            for p in cluster:
                solved[p] = is_solved
                if not is_solved:
                    todo[remaining] = p
                    remaining += 1
        todo = todo[:remaining]
        if remaining == 0:
            break
    log_evidence += _add_weak_pairs(tracks, detections, odds, solved, pair, missed, unclaimed)
    return pair, missed, unclaimed, log_evidence


@compiled
def _clusters(
    tracks: Integers,
    detections: Integers,
    odds: Array,
    candidates: Integers,
    weakest: float,
    n_tracks: int,
    n_detections: int,
) -> tuple[Integers, Integers]:
    """Candidates of odds above the weakest, ordered by cluster, and where each cluster begins (one more: the end)."""
    parent = np.arange(n_tracks + n_detections)
    pairs = np.empty(len(candidates), dtype=np.int64)
    count = 0
    for p in candidates:
        if odds[p] > weakest:
            pairs[count] = p
            count += 1
            a, b = _root(parent, tracks[p]), _root(parent, n_tracks + detections[p])
            parent[max(a, b)] = min(a, b)
    # the number of each cluster, then a sort by counting
    number = np.full(n_tracks + n_detections, -1, dtype=np.int64)
    bounds = np.zeros(count + 1, dtype=np.int64)
    n_clusters = 0
    for i in range(count):
        root = _root(parent, tracks[pairs[i]])
        if number[root] < 0:
            number[root] = n_clusters
            n_clusters += 1
        bounds[number[root] + 1] += 1
    for c in range(n_clusters):
        bounds[c + 1] += bounds[c]
    free = bounds.copy()
    members = np.empty(count, dtype=np.int64)
    for i in range(count):
        c = number[_root(parent, tracks[pairs[i]])]
        members[free[c]] = pairs[i]
        free[c] += 1
    return members, bounds[: n_clusters + 1]


@compiled
def _root(parent: Integers, node: int) -> int:
    """Return the representative of a node's cluster, and shorten the way to it."""
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@compiled
def _solve(
    tracks: Integers,
    detections: Integers,
    odds: Array,
    cluster: Integers,
    last: bool,
    numbers: Integers,
    pair: Array,
    missed: Array,
    unclaimed: Array,
) -> tuple[bool, float]:
    """Fill in the marginals of one cluster; whether it was affordable, and the logarithm of its evidence."""
    single_track, single_detection, total, largest = True, True, 1.0, 0.0
    for p in cluster:
        largest = max(largest, odds[p])
        single_track = single_track and tracks[p] == tracks[cluster[0]]
        single_detection = single_detection and detections[p] == detections[cluster[0]]
        total += odds[p]
    if single_track or single_detection:
        for p in cluster:
            pair[p] = odds[p] / total
            others = (total - odds[p]) / total if len(cluster) > 1 else 1.0 / total
            missed[tracks[p]] = 1.0 / total if single_track else others
            unclaimed[detections[p]] = 1.0 / total if single_detection else others
        return True, math.log(total)
    rows, row_names = _renumber(tracks, cluster, numbers)
    columns, column_names = _renumber(detections, cluster, numbers)
    # Steps of one row and a frontier of at most w columns are a path decomposition of width w, and a graph that has one
    # has fewer than w edges for each node: no plan, and no search for one, for denser crowds.
    too_dense = len(cluster) > MOST_WIDTH * (len(row_names) + len(column_names))
    if too_dense and not last:
        return False, 0.0
    weights = picked(odds, cluster)
    value = math.nan
    if not too_dense:
        table, index = make_table(rows, columns, weights, len(row_names), len(column_names))
        plan, turned = make_plan(table, MOST_WIDTH), False
        if plan.cost > CHEAP:
            other_table, other_index = make_table(columns, rows, weights, len(column_names), len(row_names))
            other = make_plan(other_table, MOST_WIDTH)
            if other.cost < plan.cost:
                table, index, plan, turned = other_table, other_index, other, True
        if largest <= MOST_ODDS and plan.cost <= max(MOST_COST, MOST_COST_A_PAIR * len(cluster)):
            share, idle, free, value = eliminate(table, plan)
            for i in range(len(index)):
                pair[cluster[index[i]]] = share[i]
            by_track, by_detection = (free, idle) if turned else (idle, free)
    if not math.isfinite(value):
        if not last:
            return False, 0.0
        share, by_track, by_detection, value = propagate_beliefs(
            rows, columns, weights, len(row_names), len(column_names)
        )
        for i in range(len(cluster)):
            pair[cluster[i]] = share[i]
    for i in range(len(row_names)):
        missed[row_names[i]] = by_track[i]
    for j in range(len(column_names)):
        unclaimed[column_names[j]] = by_detection[j]
    return True, value


@compiled
def _renumber(names: Integers, cluster: Integers, numbers: Integers) -> tuple[Integers, Integers]:
    """Number the names of a cluster's pairs from 0 (p,), and the name of each number; `numbers` is scratch of -1."""
    out, distinct = np.empty(len(cluster), dtype=np.int64), np.empty(len(cluster), dtype=np.int64)
    count = 0
    for i in range(len(cluster)):
        name = names[cluster[i]]
        if numbers[name] < 0:
            numbers[name] = count
            distinct[count] = name
            count += 1
        out[i] = numbers[name]
    for i in range(count):
        numbers[distinct[i]] = -1
    return out, distinct[:count]


@compiled
def _add_weak_pairs(
    tracks: Integers,
    detections: Integers,
    odds: Array,
    solved: NDArray[np.bool_],
    pair: Array,
    missed: Array,
    unclaimed: Array,
) -> float:
    """Give the pairs left out their marginals to first order; return what they add to the log-evidence."""
    by_track, by_detection = np.zeros(len(missed)), np.zeros(len(unclaimed))
    log_evidence = 0.0
    has_weak = False
    for p in range(len(odds)):
        if not solved[p]:
            gain = odds[p] * missed[tracks[p]] * unclaimed[detections[p]]
            pair[p] = gain
            by_track[tracks[p]] += gain
            by_detection[detections[p]] += gain
            log_evidence += math.log1p(gain)
            has_weak = True
    if has_weak:
        for p in range(len(odds)):
            pair[p] /= 1.0 + by_track[tracks[p]]
        for i in range(len(missed)):
            missed[i] /= 1.0 + by_track[i]
        for j in range(len(unclaimed)):
            unclaimed[j] /= 1.0 + by_detection[j]
    return log_evidence
