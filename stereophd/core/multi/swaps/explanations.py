"""Detections of two tracks filtered again under several explanations at once (compiled).

An explanation gives each detection to one of the two tracks. The tracks of every explanation are filtered from the
first row on, row by row. After a row, all explanations have explained the same detections.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.initial import FirstSight, initial_moments
from stereophd.core.disparity.moved import OUT_OF_VIEW, Moved, Sources, allocate_moved
from stereophd.core.disparity.sample_move import Draws, move_components
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.multi.association.likelihoods import ALL_PAIRS, kalman_updates, pair_likelihoods
from stereophd.core.multi.swaps.epipolar_pairs import NewObjects
from stereophd.core.multi.swaps.history import ClaimedRows
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import copy_gaussian

# A detection whose density is further below the peak of its own noise, nats, is another object's or clutter, and is
# left out: labels have claimed what does not fit before they settled.
MOST_SURPRISE = 15.0


class ExplainedRows(NamedTuple):
    """What `explain_rows` finds for h explanations of n detections."""

    # (h, 2): Log-likelihood of the detections of each track after its first. Minus infinity if the track leaves the
    # view of a camera that detected it: the rest of the explanation is then left out.
    log_likelihoods: Array
    fits: NDArray[np.bool_]  # (h, n) of bool: Whether each detection was taken for one of its track
    # `means`, `covariances`: arrays (h, 2, d), (h, 2, d, d): Moments of the tracks at their last detections.
    means: Array
    covariances: Array


def room_for_explained(explanations: int, rows: int, size: int) -> ExplainedRows:
    """Room for what `explain_rows` fills in."""
    return ExplainedRows(
        np.zeros((explanations, 2)), np.zeros((explanations, rows), dtype=bool), np.zeros((explanations, 2, size)),
        np.zeros((explanations, 2, size, size))
    )  # fmt: skip


class DetectionPaths(NamedTuple):
    """The detections of two tracks under h explanations, each a path from detection to detection."""

    owners: Integers  # (h, n): The track, 0 or 1, of each of the n detections
    before: Integers  # (h, n): The detection before each in its track; -1 for the first
    intervals: Array  # Time since the detection before each, s, explanation by explanation; 0 for the first of a track


def make_paths(owners: Integers, times: Array) -> DetectionPaths:
    """Return the paths of detections, from the track (h, n) and the time (n,) of each."""
    paths = DetectionPaths(owners, np.empty_like(owners), np.zeros(owners.size))
    _link(times, paths)
    return paths


@compiled
def _link(times: Array, paths: DetectionPaths) -> None:
    """Fill in the detection before each, and the time since."""
    owners, before, intervals = paths
    explanations, count = owners.shape
    last = np.empty(2, dtype=np.int64)
    for h in range(explanations):
        last[:] = -1
        for row in range(count):
            track = owners[h, row]
            before[h, row] = last[track]
            if last[track] >= 0:
                intervals[h * count + row] = times[row] - times[last[track]]
            last[track] = row


@compiled
def explain_rows(
    rows: ClaimedRows,
    spaces: Array,
    prior: NewObjects,
    paths: DetectionPaths,
    motion: MotionArrays,
    draws: Draws,
    most_behind: float,
    out: ExplainedRows,
) -> None:
    """Filter the detections of two tracks, forwards or backwards in time, again under h explanations.

    `spaces` (n, 30) has the packed space of each detection, the motion is that over the intervals of the paths, and
    `prior` that of the tracks at their first detections. Where the second explanation is more than `most_behind` nats
    behind the first one after the same rows, the rest is left out. Fills in `out`, which is zero before.
    """
    explanations, count = paths.owners.shape
    size = out.means.shape[2]
    means, covariances = np.empty((explanations * count, size)), np.empty((explanations * count, size, size))
    homes = np.empty((explanations * count, spaces.shape[1]))
    sources, moved = Sources(means, covariances, homes, motion), allocate_moved(explanations * count, size)
    totals = np.zeros(explanations)
    which, nowhere = np.empty(explanations, dtype=np.int64), np.empty(0)
    for row in range(count):
        going = 0
        for h in range(explanations):
            track, before, k = paths.owners[h, row], paths.before[h, row], h * count + row
            if totals[h] == -math.inf:
                continue
            if before < 0:
                out.fits[h, row] = True
                _begin(rows, row, spaces[row], prior, out.means[h], out.covariances[h], track)
                continue
            copy_gaussian(out.means[h], out.covariances[h], track, means, covariances, k)
            for a in range(spaces.shape[1]):
                homes[k, a] = spaces[before, a]
            which[going] = k
            going += 1
        move_components(which[:going], sources, draws, spaces[row], 0.0, nowhere, moved)
        for i in range(going):
            k = which[i]
            h = k // count
            track, gain = paths.owners[h, row], -math.inf
            if moved.status[k] != OUT_OF_VIEW:
                gain, out.fits[h, row] = _follow(rows, row, moved, k, out.means[h], out.covariances[h], track)
            out.log_likelihoods[h, track] += gain
            totals[h] += gain
        if explanations > 1 and totals[0] - totals[1] > most_behind:
            break


@compiled
def _begin(
    rows: ClaimedRows, row: int, space: Array, prior: NewObjects, means: Array, covariances: Array, track: int
) -> None:
    point, noise, camera = rows.points[row : row + 1], rows.noises[row : row + 1], rows.cameras[row]
    first = FirstSight(space, prior.means[camera], prior.stds[camera], prior.velocity_std, prior.region)
    born, spread = initial_moments(point, noise, first, means.shape[1], rows.readings[row : row + 1])
    copy_gaussian(born, spread, 0, means, covariances, track)


@compiled
def _follow(
    rows: ClaimedRows, row: int, moved: Moved, k: int, means: Array, covariances: Array, track: int
) -> tuple[float, bool]:
    """Update a moved track with its next detection; return its log-likelihood, and whether the detection fits."""
    point, noise = rows.points[row : row + 1], rows.noises[row : row + 1]
    reading = rows.readings[row : row + 1]
    after, spread = moved.means[k : k + 1], moved.covariances[k : k + 1]
    seen, one, unit = np.empty(1, dtype=np.bool_), np.zeros(1, dtype=np.int64), np.empty(1)
    seen[0], unit[0] = True, 1.0
    _, _, density = pair_likelihoods(after, spread, seen, point, noise, unit, reading, ALL_PAIRS)
    likely = density[0] if len(density) > 0 else 0.0
    area = noise[0, 0, 0] * noise[0, 1, 1] - noise[0, 0, 1] * noise[0, 1, 0]
    least = math.exp(-MOST_SURPRISE) / (2.0 * math.pi * math.sqrt(area))
    fits = likely > least
    if fits:
        after, spread, _ = kalman_updates(after, spread, one, one, point, noise, reading)
    copy_gaussian(after, spread, 0, means, covariances, track)
    return math.log(likely + least), fits
