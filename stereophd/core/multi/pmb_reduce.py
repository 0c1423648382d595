"""Compiled reduction of the PMB filter.

Negligible hypotheses are dropped, those of one track that agree are merged, two tracks on one object are joined,
and improbable tracks are recycled into the intensity of undetected objects.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stereophd.core.multi.intensity import UNLABELLED, Parts
from stereophd.core.multi.parts import allocate_parts, copy_gaussian, copy_parts, take_parts
from stereophd.core.multi.pmb_update import group
from stereophd.core.multi.reduce import merge_sorted, squared_distance
from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.moment_kernels import cholesky

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# A track is never more certain than this: at existence 1 no number of misses could end it.
MOST_EXISTENCE = 1.0 - 1e-9


@compiled
def reduce_tracks(
    parts: Parts,
    recycle_below: float,
    prune_weight: float,
    merge_distance: float,
    max_tracks: int,
    hypothesis_distance: float,
    least_share: float,
) -> tuple[Parts, float]:
    """Reduce a mixture (`GaussianMixture.parts`); settings as in `stereophd.core.multi.pmb.PmbSettings`.

    Returns
    -------
    parts : tuple
        Tracks, ordered by label and then by falling weight, then the intensity of undetected objects.
    expected : float
        Sum of the existences of the tracks.
    """
    weights, labels = parts[0], parts[5]
    member, n_groups = group(labels)
    existence = np.zeros(n_groups)
    names = np.empty(n_groups, dtype=np.int64)
    for k in range(len(weights)):
        names[member[k]] = labels[k]
        existence[member[k]] += weights[k]
    _keep_most_probable(existence, names, max_tracks)
    hypotheses = _merge_hypotheses(
        _drop_negligible(parts, member, existence, prune_weight, least_share), hypothesis_distance
    )
    undetected = take_parts(parts, np.flatnonzero((labels == UNLABELLED) & (weights >= prune_weight)))
    held = existence[np.searchsorted(names, hypotheses[5])] >= recycle_below
    tracks = _join_tracks(take_parts(hypotheses, np.flatnonzero(held)), merge_distance, hypothesis_distance)
    recycled = take_parts(hypotheses, np.flatnonzero(~held & (hypotheses[0] >= prune_weight)))
    recycled[5][:] = UNLABELLED
    return _concatenate(tracks, undetected, recycled), tracks[0].sum()


@compiled
def _keep_most_probable(existence: Array, names: Integers, max_tracks: int) -> None:
    """Set the existence of all but the most probable tracks to 0."""
    if len(existence) <= max_tracks:
        return
    found = 0
    for g in np.argsort(-existence, kind="mergesort"):
        if names[g] != UNLABELLED:
            found += 1
            if found > max_tracks:
                existence[g] = 0.0


@compiled
def _drop_negligible(
    parts: Parts, member: Integers, existence: Array, prune_weight: float, least_share: float
) -> Parts:
    """Hypotheses worth keeping; what is dropped of a track goes to its other hypotheses: existence stays."""
    remains = np.zeros(len(existence))
    kept = np.zeros(len(member), dtype=np.bool_)
    for k in range(len(member)):
        whole = existence[member[k]]
        if parts[5][k] != UNLABELLED and parts[0][k] >= least_share * whole and whole >= prune_weight:
            kept[k] = True
            remains[member[k]] += parts[0][k]
    index = np.flatnonzero(kept)
    found = take_parts(parts, index)
    for i in range(len(index)):
        g = member[index[i]]
        found[0][i] *= min(existence[g], MOST_EXISTENCE) / remains[g]
    return found


@compiled
def _merge_hypotheses(parts: Parts, distance: float) -> Parts:
    """Merge hypotheses of one label that agree; ordered by label, then by falling weight."""
    order = np.argsort(-parts[0], kind="mergesort")
    order = order[np.argsort(parts[5][order], kind="mergesort")]
    found = take_parts(parts, order)
    weights, means, covariances, cameras, times, labels = found[0], found[1], found[2], found[3], found[4], found[5]
    leaders = np.empty(len(weights), dtype=np.int64)
    merged, start = 0, 0
    while start < len(weights):
        end = start + 1
        while end < len(weights) and labels[end] == labels[start]:
            end += 1
        leaders[merged] = start
        if end == start + 1:
            weights[merged] = weights[start]
            copy_gaussian(means, covariances, start, means, covariances, merged)
            merged += 1
        else:
            # what is written lies before what is still to be read
            w, m, c, heaviest = merge_sorted(
                weights[start:end], means[start:end], covariances[start:end], cameras[start:end], times[start:end],
                distance, True,
            )  # fmt: skip
            for i in range(len(w)):
                weights[merged] = w[i]
                copy_gaussian(m, c, i, means, covariances, merged)
                leaders[merged] = start + heaviest[i]
                merged += 1
        start = end
    chosen = leaders[:merged]
    return (
        weights[:merged], means[:merged], covariances[:merged], cameras[chosen], times[chosen], labels[chosen],
        found[6][chosen], found[7][chosen],
    )  # fmt: skip


@compiled
def _join_tracks(tracks: Parts, distance: float, hypothesis_distance: float) -> Parts:
    """Give tracks whose heaviest hypotheses agree one label: of two identities the older."""
    weights, labels = tracks[0], tracks[5]
    first = np.ones(len(labels), dtype=np.bool_)
    first[1:] = labels[1:] != labels[:-1]
    heads = np.flatnonzero(first)
    if len(heads) < 2 or distance <= 0.0:
        return tracks
    # an identity once reported counts more than existence, and of two the older keeps its name
    heads = heads[np.argsort(-weights[heads], kind="mergesort")]
    seniority = np.where(tracks[6][heads] >= 0, tracks[6][heads], np.iinfo(np.int64).max)
    heads = heads[np.argsort(seniority, kind="mergesort")]
    senior = _seniors(take_parts(tracks, heads), distance)
    if (senior == np.arange(len(heads))).all():
        return tracks
    for h in range(len(heads)):
        if senior[h] != h:
            head = heads[senior[h]]
            moved = np.flatnonzero(labels == labels[heads[h]])
            tracks[5][moved], tracks[6][moved], tracks[7][moved] = labels[head], tracks[6][head], tracks[7][head]
    member, n_groups = group(tracks[5])
    existence = np.zeros(n_groups)
    for k in range(len(weights)):
        existence[member[k]] += weights[k]
    for k in range(len(weights)):
        weights[k] /= max(existence[member[k]], 1.0)
    return _merge_hypotheses(tracks, hypothesis_distance)


@compiled
def _seniors(heads: Parts, distance: float) -> Integers:
    """For Gaussians in order of seniority: the first senior one that each agrees with, or itself."""
    means, covariances, cameras, times = heads[1], heads[2], heads[3], heads[4]
    senior = np.arange(len(means))
    pairs = [np.int64(0)]
    pairs.clear()
    order = np.argsort(means[:, 0], kind="mergesort")
    for i in range(len(order)):
        a = order[i]
        reach = math.sqrt(distance * covariances[a, 0, 0])
        for j in range(i + 1, len(order)):
            b = order[j]
            if means[b, 0] - means[a, 0] > reach:
                break
            if cameras[a] == cameras[b] and times[a] == times[b]:
                apart = means[a] - means[b]
                if _within(apart, covariances[a], distance) and _within(apart, covariances[b], distance):
                    pairs.append(min(a, b) * len(means) + max(a, b))
    pairs.sort()
    for pair in pairs:
        older, younger = pair // len(means), pair % len(means)
        if senior[older] == older and senior[younger] == younger:
            senior[younger] = older
    return senior


@compiled
def _within(difference: Array, covariance: Array, distance: float) -> bool:
    """Whether a difference (d,) is within a squared Mahalanobis distance."""
    for a in range(len(difference)):
        # a squared Mahalanobis distance is at least that of each coordinate alone
        if difference[a] * difference[a] > distance * covariance[a, a]:
            return False
    factor = np.empty_like(covariance)
    return cholesky(covariance, factor) and squared_distance(difference, factor, np.empty_like(difference)) <= distance


@compiled
def _concatenate(first: Parts, second: Parts, third: Parts) -> Parts:
    a, b, c = len(first[0]), len(second[0]), len(third[0])
    out = allocate_parts(a + b + c, first[1].shape[1])
    copy_parts(first, np.arange(a), out, 0)
    copy_parts(second, np.arange(b), out, a)
    copy_parts(third, np.arange(c), out, a + b)
    return out
