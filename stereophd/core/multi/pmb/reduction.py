"""Compiled reduction of the PMB filter.

Negligible hypotheses and improbable tracks are dropped, hypotheses of one track that agree are merged, and two tracks
on one object are joined.
"""

import math

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.multi.pmb.hypotheses import Existences, PmbReduction
from stereophd.core.multi.state.mixture import (
    GaussianMixture,
    order_by_label,
    slice_components,
    take_components,
)
from stereophd.core.multi.state.reduction import merge_sorted
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.linear_algebra import cholesky, squared_distance
from stereophd.core.numerics.sorting import copy_gaussian, group, picked, places, stable_order

# A track is never more certain than this: at existence 1 no number of misses could end it.
MOST_EXISTENCE = 1.0 - 1e-9
# Comes after every identity.
LAST = np.iinfo(np.int64).max


@compiled
def reduce_tracks(mixture: GaussianMixture, known: Existences, settings: PmbReduction) -> tuple[GaussianMixture, float]:
    """Reduce a mixture after an update, of tracks of a known existence.

    What was dropped of a track goes to its other hypotheses. Returns tracks, ordered by label and then by falling
    weight, and the sum of their existences.
    """
    member, weights = np.searchsorted(known.names, mixture.labels), mixture.weights.copy()
    remains = np.zeros(len(known.existence))
    for k in range(len(member)):
        remains[member[k]] += weights[k]
    for k in range(len(member)):
        weights[k] *= min(known.existence[member[k]], MOST_EXISTENCE) / remains[member[k]]
    hypotheses = _merge_hypotheses(mixture, weights, settings.hypothesis_distance)
    out = _join_tracks(hypotheses, settings.merge_distance, settings.hypothesis_distance)
    return out, out.weights.sum()


@compiled
def _merge_hypotheses(mixture: GaussianMixture, given: Array, distance: float) -> GaussianMixture:
    """Merge hypotheses of one label that agree, with the weights given; ordered by label, then by falling weight."""
    order = order_by_label(given, mixture.labels)
    found = take_components(mixture, order)
    _, means, covariances, cameras, times, labels, tracks, reported = found
    weights = picked(given, order)
    found = GaussianMixture(weights, *found[1:])
    leaders = np.empty(len(weights), dtype=np.int64)
    merged, start = 0, 0
    while start < len(weights):
        end = start + 1
        while end < len(weights) and labels[end] == labels[start]:
            end += 1
        leaders[merged] = start
        if end == start + 1:
            weights[merged] = weights[start]
            if merged < start:
                copy_gaussian(means, covariances, start, means, covariances, merged)
            merged += 1
        else:
            # what is written lies before what is still to be read
            w, m, c, heaviest = merge_sorted(slice_components(found, start, end), weights[start:end], distance)
            for i in range(len(w)):
                weights[merged] = w[i]
                copy_gaussian(m, c, i, means, covariances, merged)
                leaders[merged] = start + heaviest[i]
                merged += 1
        start = end
    chosen = leaders[:merged]
    return GaussianMixture(
        weights[:merged], means[:merged], covariances[:merged], picked(cameras, chosen), picked(times, chosen),
        picked(labels, chosen), picked(tracks, chosen), picked(reported, chosen)
    )  # fmt: skip


@compiled
def _join_tracks(mixture: GaussianMixture, distance: float, hypothesis_distance: float) -> GaussianMixture:
    """Give tracks whose heaviest hypotheses agree one label: of two identities the older."""
    weights, labels, tracks, reported = mixture.weights, mixture.labels, mixture.tracks, mixture.reported
    first = np.ones(len(labels), dtype=np.bool_)
    for k in range(1, len(labels)):
        first[k] = labels[k] != labels[k - 1]
    heads = places(first)
    if len(heads) < 2 or distance <= 0.0:
        return mixture
    # an identity once reported counts more than existence, and of two the older keeps its name
    heads = picked(heads, stable_order(-picked(weights, heads)))
    seniority = picked(tracks, heads)
    for h in range(len(heads)):
        if seniority[h] < 0:
            seniority[h] = LAST
    heads = picked(heads, stable_order(seniority))
    senior = _seniors(mixture, heads, distance)
    changed = False
    for h in range(len(heads)):
        if senior[h] != h:
            changed = True
            head, k = heads[senior[h]], heads[h]
            label = labels[k]
            while k < len(labels) and labels[k] == label:
                labels[k], tracks[k], reported[k] = labels[head], tracks[head], reported[head]
                k += 1
    if not changed:
        return mixture
    member, n_groups = group(labels)
    existence = np.zeros(n_groups)
    for k in range(len(weights)):
        existence[member[k]] += weights[k]
    for k in range(len(weights)):
        weights[k] /= max(existence[member[k]], 1.0)
    return _merge_hypotheses(mixture, weights, hypothesis_distance)


@compiled
def _seniors(mixture: GaussianMixture, heads: Integers, distance: float) -> Integers:
    """For Gaussians (n,) of a mixture in order of seniority: the first senior one that each agrees with, or itself."""
    means, covariances, cameras, times = mixture.means, mixture.covariances, mixture.cameras, mixture.times
    count = len(heads)
    senior = np.arange(count)
    pairs = [np.int64(0)]
    pairs.clear()
    place = np.empty(count)
    for i in range(count):
        place[i] = means[heads[i], 0]
    order = stable_order(place)
    # with thousands of tracks whose depth is unknown, most of the time goes to pairs far apart: row after row in memory
    u, v, spread = picked(place, order), np.empty(count), np.empty(count)
    for i in range(count):
        v[i] = means[heads[order[i]], 1]
        spread[i] = distance * covariances[heads[order[i]], 1, 1]
    for i in range(count):
        a = heads[order[i]]
        reach = math.sqrt(distance * covariances[a, 0, 0])
        for j in range(i + 1, count):
            if u[j] - u[i] > reach:
                break
            if (v[j] - v[i]) * (v[j] - v[i]) > min(spread[i], spread[j]):
                continue
            b = heads[order[j]]
            if cameras[a] == cameras[b] and times[a] == times[b] and _may_agree(means, covariances, a, b, distance):
                apart = means[a] - means[b]
                if _within(apart, covariances[a], distance) and _within(apart, covariances[b], distance):
                    pairs.append(min(order[i], order[j]) * count + max(order[i], order[j]))
    found = np.empty(len(pairs), dtype=np.int64)
    for i in range(len(pairs)):
        found[i] = pairs[i]
    for i in stable_order(found):
        pair = found[i]
        older, younger = pair // count, pair % count
        if senior[older] == older and senior[younger] == younger:
            senior[younger] = older
    return senior


@compiled
def _may_agree(means: Array, covariances: Array, a: int, b: int, distance: float) -> bool:
    """Whether coordinates and pixels of two Gaussians are within a squared distance in the covariances of both.

    The squared Mahalanobis distance is at least that of each part.
    """
    for i in range(means.shape[1]):
        apart = means[a, i] - means[b, i]
        if apart * apart > distance * min(covariances[a, i, i], covariances[b, i, i]):
            return False
    # thousands of tracks of unknown depth are ellipses, long and thin, that cross one another
    return _pixels_may_agree(means, covariances[a], a, b, distance) and _pixels_may_agree(
        means, covariances[b], a, b, distance
    )


@compiled
def _pixels_may_agree(means: Array, covariance: Array, a: int, b: int, distance: float) -> bool:
    """Whether the pixels of two means may be within a squared distance in a covariance (d, d)."""
    du, dv = means[a, 0] - means[b, 0], means[a, 1] - means[b, 1]
    s00, s01, s11 = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    # the factor: some more for rounding
    return bool(s11 * du * du - 2.0 * s01 * du * dv + s00 * dv * dv <= 1.0001 * distance * (s00 * s11 - s01 * s01))


@compiled
def _within(difference: Array, covariance: Array, distance: float) -> bool:
    """Whether a difference (d,) is within a squared Mahalanobis distance."""
    factor = np.empty_like(covariance)
    return cholesky(covariance, factor) and squared_distance(difference, factor, np.empty_like(difference)) <= distance
