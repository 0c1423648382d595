"""A first guess of the cameras: one-camera tracks paired across cameras by their epipolar distance.

What one camera sees of an object can be tracked without knowing where any other camera is. Whether the tracks a and
b of two cameras may be one object depends on the cameras alone: at every common time the two rays must meet. With the
essential matrix E of the pair and rays x_a, x_b at that time (b interpolated between its detections),

    r = x_b^T E x_a / |gradient of the numerator with respect to the four pixels|

is the distance from that in pixels to first order (P. D. Sampson, 1982; R. Hartley and A. Zisserman, "Multiple View
Geometry in Computer Vision", section 11.4.3), free of scale. Cameras are drawn from the prior, tracks paired at the
greatest total gain, the cameras moved to where the paired tracks meet (Gauss-Newton with the prior), with a
tolerance that falls (`stereophd.core.calibration.pairing_search`). The best of the draws is where the annealed
alternation starts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from stereophd.core.calibration.association import track_detections
from stereophd.core.calibration.parameters import ParameterSet
from stereophd.core.calibration.quantities.base import MOVES
from stereophd.core.calibration.recording import Scans
from stereophd.core.calibration.track_rays import LONGEST_GAP, RawTracks, Rays, rays_of
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.pmb import PmbFilter

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Times at which a pair of tracks is compared, and how many it needs.
PAIR_TIMES, LEAST_TIMES = 24, 6
# Tolerances in units of the noise of the distance, step by step; a time counts for a pair within 3 of it.
TOLERANCES = (20.0, 10.0, 5.0, 2.5)
GAIN_LIMIT = 9.0
# Gauss-Newton steps at each tolerance.
STEPS = 4
# Times at which tracks of unknown clocks or lenses are compared, and reach of the clocks in standard deviations.
RAW_TIMES, REACH = 48, 4.0
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
    entries, others : arrays (n,) of int
        Entry of the first track in `raw`, and the second track.
    raw : RawTracks or None
        Where clocks, lenses or intrinsics are unknown, or cameras move: the rays depend on the cameras, and `rays`
        and `times` are those of the prior mean.
    """

    cameras: Integers
    tracks: Integers
    pair: Integers
    rays: Array
    sigma: Array
    times: Array
    entries: Integers
    others: Integers
    raw: RawTracks | None


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
    """Pair all tracks of different cameras that were seen at the same time, or may have been by unknown clocks."""
    moving = any(not camera.pose.is_static for camera in parameters.cameras)
    if parameters.only_moves and not moving and not parameters.has_rates:
        return _known_rays(parameters, scans, tracks)
    raw = RawTracks.of(scans.recording, tracks)
    spread = clock_spreads(parameters, raw)
    times = [parameters.cameras[c].clock.to_true(raw.log_times[a:b]) for c, a, b in _segments(raw)]
    members: list[tuple[int, int]] = []
    pair: list[Integers] = []
    entries: list[Integers] = []
    for a in range(len(tracks)):
        for b in range(len(tracks)):
            if raw.cameras[b] <= raw.cameras[a]:
                continue
            slack = REACH * np.hypot(spread[a], spread[b])
            both = np.flatnonzero((times[a] >= times[b][0] - slack) & (times[a] <= times[b][-1] + slack))
            if len(both) < LEAST_TIMES:
                continue
            some = both[np.unique(np.linspace(0, len(both) - 1, RAW_TIMES).astype(int))]
            pair.append(np.full(len(some), len(members)))
            members.append((a, b))
            entries.append(raw.first[a] + some)
    nothing = np.empty(0, dtype=np.int64)
    of_pair, all_entries = np.concatenate([nothing, *pair]), np.concatenate([nothing, *entries])
    pairs = np.array(members, dtype=np.int64).reshape(-1, 2)
    others = pairs[of_pair, 1]
    found = rays_of(parameters.cameras, raw, all_entries, others)
    detections = np.concatenate([nothing, *(rows for _, rows in tracks)])
    sigma = scans.recording.sigma[detections[all_entries], 0]
    cameras = raw.cameras[pairs].reshape(-1, 2)
    return TrackPairs(cameras, pairs, of_pair, found.rays, sigma, found.times, all_entries, others, raw)


def _segments(raw: RawTracks) -> Iterator[tuple[int, int, int]]:
    return zip(raw.cameras.tolist(), raw.first[:-1].tolist(), raw.first[1:].tolist(), strict=True)


def clock_spreads(parameters: ParameterSet, raw: RawTracks) -> Array:
    """Prior standard deviation (k,) of the true times of tracks, s."""
    by_name = dict(zip(parameters.names, parameters.prior_std.tolist(), strict=True))
    out = []
    for camera, first, last in _segments(raw):
        name = parameters.cameras[camera].name
        late = float(np.abs(raw.log_times[first:last]).max())
        out.append(np.hypot(by_name.get(f"{name}.clock_offset", 0.0), late * by_name.get(f"{name}.clock_rate", 0.0)))
    return np.array(out)


def _known_rays(parameters: ParameterSet, scans: Scans, tracks: Sequence[tuple[int, Integers]]) -> TrackPairs:
    """Pairs of tracks of cameras that stand still, the clocks, lenses and intrinsics of which are known."""
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
        np.empty(0, dtype=np.int64),
        np.empty(0, dtype=np.int64),
        None,
    )


def _rays(parameters: ParameterSet, camera: int, pixels: Array) -> Array:
    c = parameters.cameras[camera]
    return np.column_stack([(pixels - [c.cx, c.cy]) / [c.fx, c.fy], np.ones(len(pixels))])


def epipolar_distances(
    cameras: Sequence[Camera], pairs: TrackPairs, rows: Integers, known: Rays | None = None
) -> Array:
    """Signed epipolar distances (r,), in units of the noise, of rows of the pairs under cameras.

    NaN where the tracks were not seen at one time by the clocks of the cameras. `known` rays, if any, are those of
    the same rows, clocks and lenses.
    """
    if pairs.raw is not None:
        return _raw_distances(cameras, pairs, rows, known)
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


def _raw_distances(cameras: Sequence[Camera], pairs: TrackPairs, rows: Integers, known: Rays | None) -> Array:
    assert pairs.raw is not None
    found = rays_of(cameras, pairs.raw, pairs.entries[rows], pairs.others[rows], known)
    focal = np.array([[c.fx, c.fy] for c in cameras])[pairs.cameras[pairs.pair[rows]]]
    turn_a, turn_b = found.rotations[:, 0], found.rotations[:, 1]
    # x_b^T [t]_x R x_a with t = R_b (c_a - c_b) and R = R_b R_a^T, and its derivatives by x_a and x_b
    along = np.einsum("nij,nj->ni", turn_b, found.centers[:, 0] - found.centers[:, 1])
    a_in_b = np.einsum("nij,nkj,nk->ni", turn_b, turn_a, found.rays[:, 0])
    line_b = np.cross(along, a_in_b)
    line_a = np.einsum("nij,nkj,nk->ni", turn_a, turn_b, np.cross(found.rays[:, 1], along))
    slopes = ((line_b[:, :2] / focal[:, 1]) ** 2 + (line_a[:, :2] / focal[:, 0]) ** 2).sum(axis=1)
    distance = (found.rays[:, 1] * line_b).sum(axis=1) / np.sqrt(np.maximum(slopes, 1e-300))
    return np.asarray(np.where(found.seen, distance / pairs.sigma[rows], np.nan))


def pair_gains(pairs: TrackPairs, distances: Array, tolerance: float) -> Array:
    """Gain (p,) of every pair: the sum over its times of ``GAIN_LIMIT - (distance / tolerance)^2``.

    A pair that is further apart than three tolerances on average is no gain.
    """
    gain = GAIN_LIMIT - np.minimum((distances / tolerance) ** 2, 4.0 * GAIN_LIMIT)
    if pairs.raw is not None:
        known = np.isfinite(distances)
        enough = np.bincount(pairs.pair, weights=known, minlength=len(pairs.cameras)) >= LEAST_TIMES
        gain = np.where(known & enough[pairs.pair], gain, 0.0)
    return np.asarray(np.bincount(pairs.pair, weights=gain, minlength=len(pairs.cameras)), dtype=np.float64)


def choose_pairs(pairs: TrackPairs, gains: Array) -> tuple[Integers, float]:
    """Pair tracks one to one for each two cameras, at the greatest total gain; return the pairs and the total."""
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


def slopes_of(
    parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers, columns: Integers
) -> tuple[Array, Array]:
    """Distances (r,) of rows at values (m,), and their derivatives (r, c) in prior standard deviations of some values.

    Numerical derivatives; where a value only moves a camera, the rays in its axes are kept.
    """
    std, cameras = parameters.prior_std, parameters.build(values)
    known = None
    if pairs.raw is not None:
        known = rays_of(cameras, pairs.raw, pairs.entries[rows], pairs.others[rows])
    distances = epipolar_distances(cameras, pairs, rows, known)
    jacobian = np.zeros((len(rows), len(columns)))
    names = np.array([camera.name for camera in cameras])[pairs.cameras[pairs.pair[rows]]]
    for column, k in enumerate(columns.tolist()):
        moved, parameter = values.copy(), parameters.parameters[k]
        moved[k] += DERIVATIVE_STEP * std[k]
        here = np.flatnonzero(np.isin(names, parameter.cameras).any(axis=1))
        kept = known.take(here) if known is not None and parameter.quantity.affects == MOVES else None
        changed = epipolar_distances(parameters.rebuilt(cameras, moved, k), pairs, rows[here], kept)
        jacobian[here, column] = (changed - distances[here]) / DERIVATIVE_STEP
    return distances, jacobian


def refine(
    parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers, tolerance: float, columns: Integers
) -> Array:
    """Move the cameras to where the rows meet: Gauss-Newton over some values with the prior and Cauchy weights."""
    std = parameters.prior_std[columns]
    for _ in range(STEPS):
        distances, jacobian = slopes_of(parameters, pairs, values, rows, columns)
        usable = np.isfinite(distances) & np.isfinite(jacobian).all(axis=1)
        distances = np.where(usable, distances, 0.0) / tolerance
        jacobian = np.where(usable[:, None], jacobian, 0.0) / tolerance
        weights = 1.0 / (1.0 + distances**2)
        matrix = jacobian.T @ (weights[:, None] * jacobian) + np.eye(len(columns))
        offset = (values[columns] - parameters.prior_mean[columns]) / std
        values = values.copy()
        values[columns] -= std * np.linalg.solve(matrix, jacobian.T @ (weights * distances) + offset)
    return values
