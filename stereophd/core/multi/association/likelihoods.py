"""Likelihoods of all plausible pairs of a component and a detection, and Kalman updates of pairs.

The observation of a component y = (u, v, d, du, dv, dd) is its pixel, H = [I_2 0] (eq. 4). A rolling shutter
reads detection j at a delay tau_j after the time of the frame, at which the components are; the pixel has then
moved on, to first order by tau_j (du, dv), so that

    z_j = H_j y + noise,    H_j = [I_2 0 | tau_j I_2 0],

which is still linear: S = P_pp + tau (P_pv + P_vp) + tau^2 P_vv + R with the blocks of pixel and pixel velocity. Since
tau_j follows from the detection's own row, no equation has to be solved. Two effects are neglected: the second order,
tau v_z / z of the correction (v_z / z is the relative speed towards the camera), and the effect of the row's noise on
its time, (readout time of one row) dv of the noise. Both are far below a hundredth of a pixel for readouts of some 30
ms. Static objects (d = 3) have not moved. Where the camera itself has moved meanwhile, the pixel has also changed by
s_j d with a vector s_j that follows from the detection (`stereophd.core.disparity.events`), and H_j = [I_2 s_j | tau_j
I_2 0]. Delays and the vectors s_j are the readings of the detections: (m, 3), or (0, 3) without a rolling shutter.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import largest

# Pairs further apart than this many standard deviations in u have a likelihood below 1e-17 of the
# peak: leaving them out changes nothing, and detections ordered by u make finding the others cheap.
REACH_SIGMAS = 9.0
# Where pairs are bounded and there are more components than this, pairs beyond five standard deviations (4e-6 of the
# peak) are left out, too: most of the time of such an event goes to them.
SHORT_REACH_SIGMAS = 5.0
FEW_COMPONENTS = 8192
# Pairs a component that there is room for at first.
ROOM_FOR_PAIRS = 16
# More pairs of a component than any event has.
ALL_PAIRS = 1 << 62


@compiled
def pair_likelihoods(
    means: Array,
    covariances: Array,
    seen: NDArray[np.bool_],
    points: Array,
    noises: Array,
    areas: Array,
    readings: Array,
    most: int,
) -> tuple[Integers, Integers, Array]:
    """Predicted density N(z; H m, H P H^T + R) of every pair within reach, eq. (4) and (5).

    Components (n, d), (n, d, d) are in the disparity space of the camera; those `seen` (n,) are considered. Points,
    noises and areas are those of an `Event`, ordered by u, and readings theirs. Of one component, the pairs of the
    largest densities are kept, at most so many. Returns components and detections (p,) of the pairs, ordered by
    component and then by detection, and their densities (p,) per distorted pixel area.
    """
    # the second factor: some more for rounding
    sigmas = REACH_SIGMAS if most == ALL_PAIRS or len(means) <= FEW_COMPONENTS else SHORT_REACH_SIGMAS
    far = 1.0001 * sigmas**2
    largest = 0.0
    for j in range(len(points)):
        largest = max(largest, noises[j, 0, 0])
    count = len(means)
    low = np.zeros(count, dtype=np.int64)
    high = np.zeros(count, dtype=np.int64)
    total = 0
    column, row = points[:, 0].copy(), points[:, 1].copy()
    # whether each detection has the noise of the one before
    same = np.zeros(len(noises), dtype=np.bool_)
    for j in range(1, len(noises)):
        same[j] = _are_equal(noises[j], noises[j - 1])
    # bounds of the delays, and of the change of u with the disparity
    smallest, greatest = np.zeros(2), np.zeros(2)
    rolling = len(readings) > 0
    if rolling:
        for a in range(2):
            smallest[a], greatest[a] = readings[:, a].min(), readings[:, a].max()
    for k in range(count):
        if seen[k]:
            from_u, to_u, variance = means[k, 0], means[k, 0], covariances[k, 0, 0]
            if rolling:
                from_u, to_u, variance = _reach_of_u(means[k], covariances[k], smallest, greatest)
            reach = sigmas * math.sqrt(variance + largest)
            low[k] = np.searchsorted(column, from_u - reach)
            high[k] = np.searchsorted(column, to_u + reach)
            total += high[k] - low[k]
    # room grows: of thousands of objects whose depth is unknown, few of the pairs near in u are near in v
    room = min(total, ROOM_FOR_PAIRS * (count + 1))
    components, detections, densities = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64), np.empty(room)
    n_pairs = 0
    for k in range(count):
        begin = n_pairs
        if n_pairs + high[k] - low[k] > room:
            room = min(total, 2 * room + high[k] - low[k])
            components, detections = _enlarged(components, room), _enlarged(detections, room)
            densities = _enlarged(densities, room)
        s00, s01, s11, determinant, norm = 0.0, 0.0, 0.0, 1.0, 1.0
        for j in range(low[k], high[k]):
            # mostly all detections of a camera have one noise
            if rolling or j == low[k] or not same[j]:
                s00 = covariances[k, 0, 0] + noises[j, 0, 0]
                s01 = covariances[k, 0, 1] + noises[j, 0, 1]
                s11 = covariances[k, 1, 1] + noises[j, 1, 1]
                if rolling:
                    s00 = _spread(covariances[k], 0, 0, readings[j]) + noises[j, 0, 0]
                    s01 = _spread(covariances[k], 0, 1, readings[j]) + noises[j, 0, 1]
                    s11 = _spread(covariances[k], 1, 1, readings[j]) + noises[j, 1, 1]
                determinant = s00 * s11 - s01 * s01
                norm = 2.0 * math.pi * math.sqrt(determinant)
            du = column[j] - means[k, 0]
            dv = row[j] - means[k, 1]
            if rolling:
                du -= _shift(means[k], 0, readings[j])
                dv -= _shift(means[k], 1, readings[j])
            # a squared Mahalanobis distance is at least that of each coordinate alone
            if dv * dv > far * s11:
                continue
            weighted = s11 * du * du - 2.0 * s01 * du * dv + s00 * dv * dv
            # a multiplication takes less time than the division
            if weighted > far * determinant:
                continue
            squared = weighted / determinant
            if squared > sigmas * sigmas:
                continue
            components[n_pairs] = k
            detections[n_pairs] = j
            densities[n_pairs] = areas[j] * math.exp(-0.5 * squared) / norm
            n_pairs += 1
        if n_pairs - begin > most:
            n_pairs = begin + _keep_densest(detections[begin:n_pairs], densities[begin:n_pairs], most)
    return components[:n_pairs], detections[:n_pairs], densities[:n_pairs]


@compiled
def _are_equal(one: Array, other: Array) -> bool:
    """Whether two noises (2, 2) are the same."""
    return bool(one[0, 0] == other[0, 0] and one[0, 1] == other[0, 1] and one[1, 1] == other[1, 1])


@compiled
def _keep_densest(detections: Integers, densities: Array, most: int) -> int:
    """Move the pairs of the largest densities to the beginning, in their order; return how many they are."""
    kept = largest(densities, most)
    count = 0
    for i in range(len(densities)):
        if kept[i]:
            detections[count], densities[count] = detections[i], densities[i]
            count += 1
    return count


@compiled
def _enlarged(values: NDArray[Any], room: int) -> NDArray[Any]:
    """Return a larger array that begins with these values."""
    out = np.empty(room, dtype=values.dtype)
    for i in range(len(values)):
        out[i] = values[i]
    return out


@compiled
def _shift(mean: Array, a: int, reading: Array) -> float:
    """By how much pixel coordinate a (0 or 1) of a component has changed when it is read."""
    moved = reading[0] * mean[3 + a] if len(mean) == 6 else 0.0
    return float(moved + reading[1 + a] * mean[2])


@compiled
def _spread(covariance: Array, a: int, b: int, reading: Array) -> float:
    """Covariance of pixel coordinates a and b (0 or 1) of a component when it is read: H P H^T."""
    delay, s_a, s_b = reading[0], reading[1 + a], reading[1 + b]
    value = covariance[a, b]
    by_disparity = s_b * covariance[a, 2] + s_a * covariance[2, b] + s_a * s_b * covariance[2, 2]
    if len(covariance) == 6:
        cross = covariance[a, 3 + b] + covariance[3 + a, b]
        value = covariance[a, b] + delay * cross + delay * delay * covariance[3 + a, 3 + b]
        by_disparity += delay * (s_a * covariance[2, 3 + b] + s_b * covariance[3 + a, 2])
    return float(value + by_disparity)


@compiled
def _reach_of_u(mean: Array, covariance: Array, least: Array, most: Array) -> tuple[float, float, float]:
    """Least and largest u of a component over all readings (delay and change with the disparity within bounds).

    Also a bound on the variance: it is convex in the reading, so that its largest value is at a corner.
    """
    from_u, to_u, variance = np.inf, -np.inf, 0.0
    reading = np.zeros(3)
    for corner in range(4):
        reading[0] = least[0] if corner < 2 else most[0]
        reading[1] = least[1] if corner % 2 == 0 else most[1]
        u = mean[0] + _shift(mean, 0, reading)
        from_u, to_u = min(from_u, u), max(to_u, u)
        variance = max(variance, _spread(covariance, 0, 0, reading))
    return from_u, to_u, variance


@compiled
def kalman_updates(
    means: Array,
    covariances: Array,
    components: Integers,
    detections: Integers,
    points: Array,
    noises: Array,
    readings: Array,
) -> tuple[Array, Array, Integers]:
    """Kalman update of each pair with H = [I_2 0] (eq. 4), or with readings (see above).

    Consecutive pairs of one component with detections of equal noise have one covariance: a component that may have
    made hundreds of detections takes little memory. Returns means (p, d), covariances (q, d, d), and which of these
    (p,) each pair has.
    """
    rows, found, rolling = np.empty(len(components), dtype=np.int64), 0, len(readings) > 0
    for i in range(len(components)):
        again = i > 0 and not rolling and components[i] == components[i - 1]
        found += 0 if again and _are_equal(noises[detections[i]], noises[detections[i - 1]]) else 1
        rows[i] = found - 1
    size = means.shape[1]
    out_means, out_covariances = np.empty((len(components), size)), np.empty((found, size, size))
    gain = np.empty((size, 2))
    # row a: covariance of the state with the observed u and v
    observed = np.empty((size, 2))
    for i in range(len(components)):
        k, j = components[i], detections[i]
        covariance = covariances[k]
        du = points[j, 0] - means[k, 0]
        dv = points[j, 1] - means[k, 1]
        if rolling:
            du -= _shift(means[k], 0, readings[j])
            dv -= _shift(means[k], 1, readings[j])
        if i == 0 or rows[i] != rows[i - 1]:
            for a in range(size):
                observed[a, 0] = covariance[a, 0]
                observed[a, 1] = covariance[a, 1]
            s00, s01, s11 = covariance[0, 0], covariance[0, 1], covariance[1, 1]
            if rolling:
                for a in range(size):
                    if size == 6:
                        observed[a, 0] += readings[j, 0] * covariance[a, 3]
                        observed[a, 1] += readings[j, 0] * covariance[a, 4]
                    observed[a, 0] += readings[j, 1] * covariance[a, 2]
                    observed[a, 1] += readings[j, 2] * covariance[a, 2]
                s00 = _spread(covariance, 0, 0, readings[j])
                s01 = _spread(covariance, 0, 1, readings[j])
                s11 = _spread(covariance, 1, 1, readings[j])
            s00 = s00 + noises[j, 0, 0]
            s01 = s01 + noises[j, 0, 1]
            s11 = s11 + noises[j, 1, 1]
            determinant = s00 * s11 - s01 * s01
            for a in range(size):
                gain[a, 0] = (observed[a, 0] * s11 - observed[a, 1] * s01) / determinant
                gain[a, 1] = (observed[a, 1] * s00 - observed[a, 0] * s01) / determinant
            out = out_covariances[rows[i]]
            for a in range(size):
                for b in range(a + 1):
                    value = covariance[a, b] - gain[a, 0] * observed[b, 0] - gain[a, 1] * observed[b, 1]
                    out[a, b] = value
                    out[b, a] = value
        for a in range(size):
            out_means[i, a] = means[k, a] + gain[a, 0] * du + gain[a, 1] * dv
    return out_means, out_covariances, rows
