"""Detections of two tracks filtered again under several explanations at once (compiled).

An explanation gives each detection to one of the two tracks. The tracks of every explanation are filtered from the
first row on, row by row. After a row, all explanations have explained the same detections.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.moved import OUT_OF_VIEW, Moved, allocate_moved
from stereophd.core.disparity.sample_move import Look, move_components
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.multi.association import kalman_updates, pair_likelihoods
from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.sorting import copy_gaussian

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# A detection whose density is further below the peak of its own noise, nats, is another object's or clutter, and is
# left out: labels have claimed what does not fit before they settled.
MOST_SURPRISE = 15.0


class ExplainedRows(NamedTuple):
    """What `explain_rows` finds for h explanations of n detections.

    Attributes
    ----------
    log_likelihoods : array (h, 2)
        Of the detections of each track after its first. Minus infinity where the track leaves the view of a camera that
        detected it: the rest of the explanation is then left out.
    fits : array (h, n) of bool
        Whether each detection was taken for one of its track.
    means, covariances : arrays (h, 2, d), (h, 2, d, d)
        Of the tracks at their last detections.
    """

    log_likelihoods: Array
    fits: NDArray[np.bool_]
    means: Array
    covariances: Array


def room_for_explained(explanations: int, rows: int, size: int) -> ExplainedRows:
    """Room for what `explain_rows` fills in."""
    return ExplainedRows(
        np.zeros((explanations, 2)), np.zeros((explanations, rows), dtype=bool), np.zeros((explanations, 2, size)),
        np.zeros((explanations, 2, size, size)),
    )  # fmt: skip


class DetectionPaths(NamedTuple):
    """The detections of two tracks under h explanations, each a path from detection to detection.

    Attributes
    ----------
    owners : array (h, n)
        The track, 0 or 1, of each of the n detections.
    before : array (h, n)
        The detection before each in its track; -1 for the first.
    homes : array (h * n, 30)
        Packed space of the detection before each, explanation by explanation.
    spaces : array (n, 30)
        Packed space of each detection.
    """

    owners: Integers
    before: Integers
    homes: Array
    spaces: Array


def make_paths(owners: Integers, spaces: Array) -> DetectionPaths:
    """Return the paths of detections, from the track (h, n) and the packed space (n, 30) of each."""
    before = np.full(owners.shape, -1)
    for path, own in zip(before, owners, strict=True):
        for track in (0, 1):
            found = np.flatnonzero(own == track)
            path[found[1:]] = found[:-1]
    return DetectionPaths(owners, before, spaces.take(before.ravel(), axis=0, mode="clip"), spaces)


@compiled
def explain_rows(
    points: Array,
    noises: Array,
    delays: Array | None,
    paths: DetectionPaths,
    motion: MotionArrays,
    look: Look,
    most_behind: float,
    out: ExplainedRows,
) -> None:
    """Filter the detections of two tracks again under h explanations.

    Parameters
    ----------
    points, noises, delays : arrays (n, 2), (n, 2, 2), (n,) or None
        Detections of both tracks, as in `Event`, forwards or backwards in time.
    paths : DetectionPaths
    motion : MotionArrays
        Over the h * n intervals since the detection before each (that of the first of a track is not used).
    look : Look
        Samples of the moves.
    most_behind : float
        Where the second explanation is further behind the first one after the same rows, nats, the rest is left out.
    out : ExplainedRows
        Filled in: zeros, but for the Gaussians of the tracks at their first detections.
    """
    explanations, count = paths.owners.shape
    size = out.means.shape[2]
    means, covariances = np.empty((explanations * count, size)), np.empty((explanations * count, size, size))
    moved = allocate_moved(explanations * count, size)
    totals = np.zeros(explanations)
    which, nowhere = np.empty(1, dtype=np.int64), np.empty(0)
    for row in range(count):
        for h in range(explanations):
            track, k = paths.owners[h, row], h * count + row
            if totals[h] == -math.inf:
                continue
            if paths.before[h, row] < 0:
                out.fits[h, row] = True
                continue
            copy_gaussian(out.means[h], out.covariances[h], track, means, covariances, k)
            which[0] = k
            move_components(
                which, means, covariances, paths.homes, motion, look, paths.spaces[row], 0.0, nowhere, moved
            )  # fmt: skip
            gain = -math.inf
            if moved.status[k] != OUT_OF_VIEW:
                gain, out.fits[h, row] = _follow(
                    points, noises, delays, row, moved, k, out.means[h], out.covariances[h], track
                )
            out.log_likelihoods[h, track] += gain
            totals[h] += gain
        if explanations > 1 and totals[0] - totals[1] > most_behind:
            break


@compiled
def _follow(
    points: Array,
    noises: Array,
    delays: Array | None,
    row: int,
    moved: Moved,
    k: int,
    means: Array,
    covariances: Array,
    track: int,
) -> tuple[float, bool]:
    """Update a moved track with its next detection; return its log-likelihood, and whether the detection fits."""
    point, noise = points[row : row + 1], noises[row : row + 1]
    delay = None if delays is None else delays[row : row + 1]
    after, spread = moved.means[k : k + 1], moved.covariances[k : k + 1]
    seen, one, unit = np.empty(1, dtype=np.bool_), np.zeros(1, dtype=np.int64), np.empty(1)
    seen[0], unit[0] = True, 1.0
    _, _, density = pair_likelihoods(after, spread, seen, point, noise, unit, delay)
    likely = density[0] if len(density) > 0 else 0.0
    area = noise[0, 0, 0] * noise[0, 1, 1] - noise[0, 0, 1] * noise[0, 1, 0]
    least = math.exp(-MOST_SURPRISE) / (2.0 * math.pi * math.sqrt(area))
    fits = likely > least
    if fits:
        after, spread = kalman_updates(after, spread, one, one, point, noise, delay)
    copy_gaussian(after, spread, 0, means, covariances, track)
    return math.log(likely + least), fits
