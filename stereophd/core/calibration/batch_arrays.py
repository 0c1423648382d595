"""What the conditional filters hand to one another: events, samples and components as plain arrays, and copies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.kernels import MovedArrays
from stereophd.core.disparity.move_kernels import Look
from stereophd.core.multi.intensity import Parts
from stereophd.core.multi.parts import allocate_parts, copy_parts, slice_parts
from stereophd.core.numerics.compilation import compiled

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Components that a hypothesis gets room for at first.
ROOM = 256


class SampleArrays(NamedTuple):
    """Standard-normal samples of an event, shared by all hypotheses.

    `first`, and `second` for the second look at components of which only a corner is in view
    (`stereophd.core.numerics.samples.SampleSets`).
    """

    first: Look
    second: Look


class EventArrays(NamedTuple):
    """Detections of an event (`stereophd.core.disparity.events.Event`) and the objects they may have given birth to.

    `points` (m, 2), `noises` (m, 2, 2), `areas` (m,), `delays` (m,) or None, `birth_means` (m, d),
    `birth_covariances` (m, d, d).
    """

    points: Array
    noises: Array
    areas: Array
    delays: Array | None
    birth_means: Array
    birth_covariances: Array


class Step(NamedTuple):
    """Numbers of one event.

    `camera`, `time_s` of the event; `survival` and time `elapsed` since the last one, `out_of_view_s` as in the
    filters; first unused label; `p_detect`, `clutter` and
    `births` a frame, `area` of the camera's image (px^2); `shape_p_detect`: for the shape of the missed part, 0
    where it keeps its own; `important`: weight from which a component gets a second look; then the parameters of the
    reduction (`PhdSettings`, `PmbSettings`).
    """

    camera: int
    time_s: float
    survival: float
    elapsed: float
    out_of_view_s: float
    next_label: int
    p_detect: float
    shape_p_detect: float
    clutter: float
    births: float
    area: float
    important: float
    prune_weight: float
    merge_distance: float
    max_components: int
    mutual: bool
    recycle_below: float
    hypothesis_distance: float
    least_share: float


@compiled
def slice_moved(moved: MovedArrays, first: int, last: int) -> MovedArrays:
    """Return views of consecutive components."""
    return (
        moved[0][first:last], moved[1][first:last], moved[2][first:last], moved[3][first:last],
        moved[4][first:last], moved[5][first:last], moved[6][first:last],
    )  # fmt: skip


@compiled
def predicted_parts(
    begin: int, end: int, parts: Parts, weights: Array, moved: MovedArrays, first: int
) -> tuple[Parts, MovedArrays, int]:
    """One hypothesis' components as predicted, the same in the event's space, and where the next one's begin."""
    last = first + end - begin
    home = slice_parts(parts, begin, end)
    before = (weights[first:last], home[1], home[2], home[3], home[4], home[5], home[6], home[7])
    return before, slice_moved(moved, first, last), last


@compiled
def append_parts(after: Parts, out: Parts, found: int) -> Parts:
    """Copy components behind the first `found` of `out`; return `out`, or a larger one that replaces it."""
    if found + len(after[0]) > len(out[0]):
        larger = allocate_parts(2 * (found + len(after[0])), out[1].shape[1])
        copy_parts(out, np.arange(found), larger, 0)
        out = larger
    copy_parts(after, np.arange(len(after[0])), out, found)
    return out
