"""A first guess of the cameras: one-camera tracks paired across cameras by their epipolar distance.

What one camera sees of an object can be tracked without knowing where any other camera is. Whether the tracks a and
b of two cameras may be one object depends on the cameras alone: at every common time the two rays must meet. With the
essential matrix E of the pair and rays x_a, x_b at that time (b interpolated between its detections),

    r = x_b^T E x_a / |gradient of the numerator with respect to the four pixels|

is the distance from that in pixels to first order (P. D. Sampson, 1982; R. Hartley and A. Zisserman, "Multiple View
Geometry in Computer Vision", section 11.4.3), free of scale. Cameras are drawn from the prior, tracks paired at the
greatest total gain, the cameras moved to where the paired tracks meet (Gauss-Newton with the prior), with a
tolerance that falls. The best of the draws is where the annealed alternation starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from stereophd.core.calibration.association import track_detections
from stereophd.core.calibration.parameters import ParameterSet
from stereophd.core.calibration.recording import Scans
from stereophd.core.multi.pmb import PmbFilter

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Times at which a pair of tracks is compared, and how many it needs.
PAIR_TIMES, LEAST_TIMES = 24, 6
# Tracks are interpolated over at most this many of their median steps.
LONGEST_GAP = 3.5
# Tolerances in units of the noise of the distance, step by step; a time counts for a pair within 3 of it.
TOLERANCES = (20.0, 10.0, 5.0, 2.5)
GAIN_LIMIT = 9.0
# Draws of a start, those refined, and Gauss-Newton steps at each tolerance.
DRAWS, REFINED, STEPS = 256, 8, 4
# Step of the numerical derivative, in prior standard deviations.
DERIVATIVE_STEP = 1e-4


@dataclass(frozen=True)
class TrackPairs:
    """Pairs of one-camera tracks, and the rays at their common times.

    Attributes
    ----------
    cameras : array (p, 2) of int
        The two cameras of every pair.
    tracks : array (p, 2) of int
        The two tracks, numbered over all cameras.
    pair : array (n,) of int
        Pair of each row.
    rays : array (n, 2, 3)
        x_a, x_b with third component 1.
    sigma : array (n,)
        Noise, px.
    times : array (n,)
        s.
    """

    cameras: Integers
    tracks: Integers
    pair: Integers
    rays: Array
    sigma: Array
    times: Array


def one_camera_tracks(template: PmbFilter, scans: Scans, least: int) -> list[tuple[int, Integers]]:
    """Track each camera's detections by themselves: (camera, detections of the recording) of every long track."""
    out = []
    for camera in np.unique(scans.cameras).tolist():
        alone = scans.of_camera(camera)
        found = track_detections(template, alone, 1.0)
        for track in range(int(found.tracks.max()) + 1 if len(found) else 0):
            detections = alone.source[found.detections[found.tracks == track]]
            if len(detections) >= least:
                out.append((camera, detections))
    return out


def make_pairs(parameters: ParameterSet, scans: Scans, tracks: Sequence[tuple[int, Integers]]) -> TrackPairs:
    """Pair all tracks of different cameras that were seen at the same time."""
    cameras: list[tuple[int, int]] = []
    members: list[tuple[int, int]] = []
    pair: list[Integers] = []
    rays: list[Array] = []
    sigma: list[Array] = []
    at: list[Array] = []
    placed = [(camera, scans.places(detections)) for camera, detections in tracks]
    for a, (camera_a, rows_a) in enumerate(placed):
        for b, (camera_b, rows_b) in enumerate(placed):
            if camera_b <= camera_a:
                continue
            times_a, times_b = scans.detection_times[rows_a], scans.detection_times[rows_b]
            right = np.searchsorted(times_b, times_a).clip(1, len(times_b) - 1)
            gap = times_b[right] - times_b[right - 1]
            inside = (times_a >= times_b[0]) & (times_a <= times_b[-1])
            common = np.flatnonzero(inside & (gap <= LONGEST_GAP * float(np.median(np.diff(times_b)))))
            if len(common) < LEAST_TIMES:
                continue
            common = common[np.unique(np.linspace(0, len(common) - 1, PAIR_TIMES).astype(int))]
            pixels_b = np.column_stack(
                [np.interp(times_a[common], times_b, scans.points[rows_b, axis]) for axis in (0, 1)]
            )
            number = len(cameras)
            cameras.append((camera_a, camera_b))
            members.append((a, b))
            pair.append(np.full(len(common), number))
            both = [_rays(parameters, camera_a, scans.points[rows_a[common]]), _rays(parameters, camera_b, pixels_b)]
            rays.append(np.stack(both, axis=1))
            sigma.append(1.0 / np.sqrt(scans.precisions[rows_a[common], 0, 0]))
            at.append(times_a[common])
    return TrackPairs(
        np.array(cameras, dtype=np.int64).reshape(-1, 2),
        np.array(members, dtype=np.int64).reshape(-1, 2),
        np.concatenate([*pair, np.empty(0, dtype=np.int64)]).astype(np.int64),
        np.concatenate([*rays, np.empty((0, 2, 3))]),
        np.concatenate([*sigma, np.empty(0)]),
        np.concatenate([*at, np.empty(0)]),
    )


def _rays(parameters: ParameterSet, camera: int, pixels: Array) -> Array:
    c = parameters.cameras[camera]
    return np.column_stack([(pixels - [c.cx, c.cy]) / [c.fx, c.fy], np.ones(len(pixels))])


def epipolar_distances(parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers) -> Array:
    """Signed epipolar distances (r,), in units of the noise, of rows of the pairs under values (m,)."""
    cameras = parameters.build(values)
    focal = np.array([[c.fx, c.fy] for c in cameras])
    index = pairs.cameras[pairs.pair[rows]]
    essential = np.zeros((len(cameras), len(cameras), 3, 3))
    for i, j in set(map(tuple, pairs.cameras.tolist())):
        turn = cameras[j].pose.rotation @ cameras[i].pose.rotation.T
        x, y, z = cameras[j].pose.rotation @ (cameras[i].pose.center - cameras[j].pose.center)
        essential[i, j] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ turn
    matrix = essential[index[:, 0], index[:, 1]]
    a, b = pairs.rays[rows, 0], pairs.rays[rows, 1]
    line_b = np.einsum("nij,nj->ni", matrix, a)
    line_a = np.einsum("nij,ni->nj", matrix, b)
    slopes = ((line_b[:, :2] / focal[index[:, 1]]) ** 2 + (line_a[:, :2] / focal[index[:, 0]]) ** 2).sum(axis=1)
    distance = (b * line_b).sum(axis=1) / np.sqrt(np.maximum(slopes, 1e-300))
    return np.asarray(distance / pairs.sigma[rows])


def choose_pairs(pairs: TrackPairs, distances: Array, tolerance: float) -> tuple[Integers, float]:
    """Pair tracks one to one for each two cameras, at the greatest gain; return the pairs and the gain.

    The gain of a pair is the sum over its times of ``GAIN_LIMIT - (distance / tolerance)^2``: a pair that is further
    apart than three tolerances on average is no gain.
    """
    gains = np.bincount(
        pairs.pair, weights=GAIN_LIMIT - np.minimum((distances / tolerance) ** 2, 4.0 * GAIN_LIMIT),
        minlength=len(pairs.cameras),
    )  # fmt: skip
    chosen, total = [], 0.0
    for i, j in sorted(set(map(tuple, pairs.cameras.tolist()))):
        here = np.flatnonzero((pairs.cameras == (i, j)).all(axis=1))
        firsts, row = np.unique(pairs.tracks[here, 0], return_inverse=True)
        seconds, column = np.unique(pairs.tracks[here, 1], return_inverse=True)
        table = np.zeros((len(firsts), len(seconds)))
        number = np.full(table.shape, -1)
        table[row, column] = np.maximum(gains[here], 0.0)
        number[row, column] = here
        for r, c in zip(*linear_sum_assignment(-table), strict=True):
            if table[r, c] > 0.0:
                chosen.append(number[r, c])
                total += float(table[r, c])
    return np.array(chosen, dtype=np.int64), total


def refine(parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers, tolerance: float) -> Array:
    """Move the cameras to where the rows meet: Gauss-Newton with the prior and Cauchy weights."""
    std = parameters.prior_std
    for _ in range(STEPS):
        distances = epipolar_distances(parameters, pairs, values, rows) / tolerance
        jacobian = np.empty((len(rows), len(values)))
        for k in range(len(values)):
            moved = values.copy()
            moved[k] += DERIVATIVE_STEP * std[k]
            jacobian[:, k] = (epipolar_distances(parameters, pairs, moved, rows) / tolerance - distances) / (
                DERIVATIVE_STEP
            )
        weights = 1.0 / (1.0 + distances**2)
        matrix = jacobian.T @ (weights[:, None] * jacobian) + np.eye(len(values))
        offset = (values - parameters.prior_mean) / std
        values = values - std * np.linalg.solve(matrix, jacobian.T @ (weights * distances) + offset)
    return values


@dataclass(frozen=True)
class Pairing:
    """Cameras and the pairs of tracks that meet under them.

    Attributes
    ----------
    values : array (m,)
    chosen : array (c,) of int
        Indices of the pairs.
    """

    values: Array
    chosen: Integers


def best_pairing(parameters: ParameterSet, pairs: TrackPairs, draws: Array) -> Pairing | None:
    """Find the cameras that pair the tracks best, from draws (k, m) of the prior; None if nothing pairs."""
    if not len(pairs.cameras):
        return None
    rows = np.arange(len(pairs.pair))

    def gain(values: Array, tolerance: float) -> tuple[Integers, float]:
        chosen, total = choose_pairs(pairs, epipolar_distances(parameters, pairs, values, rows), tolerance)
        offset = (values - parameters.prior_mean) / parameters.prior_std
        return chosen, total - float(offset @ offset)

    first = np.array([gain(values, TOLERANCES[0])[1] for values in draws])
    best, most = None, 0.0
    for k in np.argsort(-first, kind="stable")[:REFINED]:
        values = draws[k]
        for tolerance in TOLERANCES:
            chosen, _ = gain(values, tolerance)
            if not len(chosen):
                break
            values = refine(parameters, pairs, values, np.flatnonzero(np.isin(pairs.pair, chosen)), tolerance)
        chosen, reached = gain(values, TOLERANCES[-1])
        if reached > most:
            best, most = Pairing(values, chosen), reached
    return best


def paired_objects(pairs: TrackPairs, pairing: Pairing, tracks: int) -> Integers:
    """Object of every track (tracks,), numbered from 0; -1 of those that are not paired."""
    leader = np.arange(tracks)
    for a, b in pairs.tracks[pairing.chosen].tolist():
        leader[leader == leader[b]] = leader[a]
    paired = np.isin(np.arange(tracks), pairs.tracks[pairing.chosen])
    objects = np.full(tracks, -1)
    objects[paired] = np.unique(leader[paired], return_inverse=True)[1]
    return objects


def meeting_points(parameters: ParameterSet, pairs: TrackPairs, pairing: Pairing) -> tuple[Integers, Array]:
    """Rows of the chosen pairs and the points (r, 3) where their rays come nearest, no nearer than the cameras are.

    Depths are kept positive: rays that meet behind a camera are taken where they are far apart from it instead.
    """
    cameras = parameters.build(pairing.values)
    rows = np.flatnonzero(np.isin(pairs.pair, pairing.chosen))
    index = pairs.cameras[pairs.pair[rows]]
    centers = np.stack([c.pose.center for c in cameras])[index]
    rotations = np.stack([c.pose.rotation for c in cameras])[index]
    rays = np.einsum("nkij,nki->nkj", rotations, pairs.rays[rows])
    between = centers[:, 1] - centers[:, 0]
    aa, bb = (rays[:, 0] ** 2).sum(axis=1), (rays[:, 1] ** 2).sum(axis=1)
    ab = (rays[:, 0] * rays[:, 1]).sum(axis=1)
    da, db = (rays[:, 0] * between).sum(axis=1), (rays[:, 1] * between).sum(axis=1)
    determinant = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    distance = np.linalg.norm(between, axis=1)
    depth_a = np.clip((da * bb - db * ab) / determinant, 0.5 * distance, 100.0 * distance)
    depth_b = np.clip((da * ab - db * aa) / determinant, 0.5 * distance, 100.0 * distance)
    points = centers + np.stack([depth_a, depth_b], axis=1)[:, :, None] * rays
    return rows, np.asarray(points.mean(axis=1))
