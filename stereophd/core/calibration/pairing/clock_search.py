"""Offsets of clocks from motion alone: the speed profiles of one-camera tracks, compared at all shifts.

When an object speeds up, slows down or turns away, all cameras see its image do so at the same true time. The profile
of a track is the logarithm of the speed of its image; at the true shift the profiles of one object before two cameras
correlate for any poses and focal lengths. Objects that stand still or move uniformly have flat profiles: their clocks
stay at the prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.geometry.camera import Camera
from stereophd.core.two_views.track_rays import RawTracks

# Step of the grid of shifts in median frame intervals of the slowest camera, and reach in prior deviations.
STEP_FRAMES, REACH = 1.0, 3.0
# Half of the window over which a speed is taken, in steps of the grid.
HALF_WINDOW = 2
# Least overlap of two profiles, in steps, and least score (standard deviations of Fisher's z) of a shift.
LEAST_OVERLAP, LEAST_SCORE = 20, 6.0
# Correlation length of a profile, in steps. A profile therefore has fewer independent values than steps.
CORRELATED_STEPS = 5.0


@dataclass(frozen=True)
class ClockOffsets:
    """Offsets of the clocks of cameras (c,) from those of the prior mean, s, and their scores (c,).

    The score is 0 of a camera whose clock is known, or whose profiles agree with no other's.
    """

    offsets: Array
    scores: Array


def search_offsets(parameters: ParameterSet, tracks: RawTracks) -> ClockOffsets:
    """Find the offset of every unknown clock, the most certain camera first."""
    cameras = parameters.cameras
    places = offset_places(parameters)
    spread = np.where(places >= 0, parameters.prior_std[places], 0.0)
    offsets, scores = np.zeros(len(cameras)), np.zeros(len(cameras))
    known = set(np.flatnonzero(spread == 0.0).tolist())
    step = _step(cameras, tracks)
    if not spread.any() or not known or not np.isfinite(step):
        return ClockOffsets(offsets, scores)
    profiles = _profiles(cameras, tracks, step)
    while len(known) < len(cameras):
        best: tuple[float, int, float] = (0.0, -1, 0.0)
        for camera in set(range(len(cameras))) - known:
            lags = {other: int(np.round(offsets[other] / step)) for other in known}
            shifts, most_are_zero = _shifts(profiles, camera, lags, float(np.ceil(REACH * spread[camera] / step)))
            if not len(shifts):
                continue
            total = np.zeros(len(shifts))
            for other, lag in lags.items():
                total += [_score(profiles[camera], profiles[other], int(shift - lag)) for shift in shifts]
            # tracks of different objects correlate a little at any shift
            total -= 0.0 if most_are_zero else np.median(total)
            total -= 0.5 * (shifts * step / spread[camera]) ** 2
            k = int(total.argmax())
            if total[k] > best[0]:
                best = (float(total[k]), camera, float(shifts[k] * step))
        if best[0] < LEAST_SCORE:
            break
        known.add(best[1])
        offsets[best[1]], scores[best[1]] = best[2], best[0]
    return ClockOffsets(offsets, scores)


def _shifts(
    profiles: Mapping[int, list[tuple[int, Array]]], camera: int, lags: Mapping[int, int], reach: float
) -> tuple[Array, bool]:
    """Return the shifts within reach, and whether most of them are left out because no profiles overlap there."""
    places = [
        (start - own - len(profile), start + len(other) - own)
        for known, lag in lags.items()
        for other_start, other in profiles[known]
        for start in [other_start + lag]
        for own, profile in profiles[camera]
    ]
    low, high = min((low for low, _ in places), default=0), max((high for _, high in places), default=-1)
    overlapping = np.arange(max(-reach, low), min(reach, high) + 1)
    if 2 * len(overlapping) <= 2 * reach + 1:
        return overlapping, True
    return np.arange(-reach, reach + 1), False


def offset_places(parameters: ParameterSet) -> Integers:
    """Place (c,) of the clock offset of each camera among the values; -1 where it is known."""
    return np.concatenate([parameters.index(camera.name, ["clock_offset"]) for camera in parameters.cameras])


def _step(cameras: Sequence[Camera], tracks: RawTracks) -> float:
    """Step of the common grid of times, s."""
    steps = [tracks.interval_s(camera) * cameras[camera].clock.rate for camera in np.unique(tracks.cameras).tolist()]
    return STEP_FRAMES * max(steps, default=np.inf)


def _profiles(cameras: Sequence[Camera], tracks: RawTracks, step: float) -> dict[int, list[tuple[int, Array]]]:
    """Profiles of the tracks of each camera: first point of the grid, and logarithms of speeds, NaN in gaps."""
    out: dict[int, list[tuple[int, Array]]] = {k: [] for k in range(len(cameras))}
    for j, (camera, (start, end)) in enumerate(zip(tracks.cameras.tolist(), tracks.spans(), strict=True)):
        times = cameras[camera].clock.to_true(tracks.log_times[start:end])
        first, last = int(np.ceil(times[0] / step)), int(np.floor(times[-1] / step))
        grid = np.arange(first, last + 1)
        if len(grid) < LEAST_OVERLAP:
            continue
        pixels, seen = tracks.at(np.full(len(grid), j), cameras[camera].clock.to_log(grid * step))
        pixels[~seen] = np.nan
        change = pixels[2 * HALF_WINDOW :] - pixels[: -2 * HALF_WINDOW]
        floor = 1.0  # about the noise of a detection, px
        out[camera].append((first + HALF_WINDOW, np.log(np.hypot(np.linalg.norm(change, axis=1), floor))))
    return out


def _score(ours: list[tuple[int, Array]], theirs: list[tuple[int, Array]], shift: int) -> float:
    """Sum over our tracks of the best significance of a correlation with theirs, ours `shift` steps later."""
    total = 0.0
    for start, profile in ours:
        best = 0.0
        for other_start, other in theirs:
            low = max(start + shift, other_start)
            high = min(start + shift + len(profile), other_start + len(other))
            if high - low >= LEAST_OVERLAP:
                one = profile[low - start - shift : high - start - shift]
                best = max(best, _significance(one, other[low - other_start : high - other_start]))
        total += best
    return total


def _significance(one: Array, two: Array) -> float:
    """Standard deviations by which the correlation of two profiles is above zero (Fisher's z); 0 if it is not."""
    usable = np.isfinite(one) & np.isfinite(two)
    count = usable.sum() / CORRELATED_STEPS - 3.0
    if usable.sum() < LEAST_OVERLAP or count <= 0.0:
        return 0.0
    a, b = one[usable] - one[usable].mean(), two[usable] - two[usable].mean()
    size = np.sqrt((a @ a) * (b @ b))
    correlation = float(a @ b) / size if size > 0.0 else 0.0
    return float(max(np.arctanh(np.clip(correlation, 0.0, 0.999)) * np.sqrt(count), 0.0))
