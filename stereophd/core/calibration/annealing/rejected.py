"""Detections that stand alone, which fits reject.

Where only one camera sees an object, its depth is known by its motion only. A false detection of
another camera that happens to lie on the epipolar line then fits a fitted trajectory, which bends towards it, and the
cameras with it. An object in view would have been detected in the frames before and after as well. Where two other
cameras see the object, they confirm the detection.
"""

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers

# Probability that a detector misses an object in all frames before a detection, and after it, below which the
# detection stands alone.
LONE_PROBABILITY = 0.03
# Other cameras confirm a detection if they see the object within so many frames of its camera.
NEAR_FRAMES = 2


def lone(trajectories: Integers, events: Integers, of_event: Integers, p_detect: Array) -> Booleans:
    """Which detections (n,) have no other detection of their trajectory and camera near, before or after.

    Detections are sorted by trajectory and time; `of_event` (e,) is the camera of each event, a frame, in order of
    time; `p_detect` (c,) is the probability of detection of each camera. True where the frames of the camera without a
    detection of the trajectory are so many, both since the last one (or the first frame of the log) and until the next
    one (or the last frame), that a detector that sees the object misses it in all of either with less than
    `LONE_PROBABILITY`, and fewer than two other cameras detected the object within `NEAR_FRAMES` frames.
    """
    frame = np.empty(len(of_event), dtype=np.int64)
    frames = np.bincount(of_event, minlength=len(p_detect))
    for camera in range(len(p_detect)):
        frame[of_event == camera] = np.arange(frames[camera])
    cameras, numbers = of_event[events], frame[events]
    order = np.lexsort((numbers, cameras, trajectories))
    same = (np.diff(trajectories[order]) == 0) & (np.diff(cameras[order]) == 0)
    between = np.diff(numbers[order]) - 1
    before, after = numbers[order].copy(), frames[cameras[order]] - 1 - numbers[order]
    before[1:][same], after[:-1][same] = between[same], between[same]
    missed = 1.0 - p_detect[cameras[order]]
    out = np.empty(len(events), dtype=np.bool_)
    out[order] = (missed**before < LONE_PROBABILITY) & (missed**after < LONE_PROBABILITY)
    for row in np.flatnonzero(out):
        own = np.flatnonzero(of_event == cameras[row])
        first, last = own[[max(numbers[row] - NEAR_FRAMES, 0), min(numbers[row] + NEAR_FRAMES, len(own) - 1)]]
        near = (trajectories == trajectories[row]) & (events >= first) & (events <= last) & (cameras != cameras[row])
        out[row] = len(np.unique(cameras[near])) < 2
    return out
