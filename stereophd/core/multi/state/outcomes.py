"""Components after an event, compiled: room for the missed, the detected and the newborn, and those missed."""

from __future__ import annotations

from stereophd.core.arrays import Integers
from stereophd.core.disparity.moved import IN_VIEW, PARTLY_IN_VIEW, Moved
from stereophd.core.multi.state.inputs import EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture, allocate_mixture
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import copy_gaussian


@compiled
def allocate_outcomes(
    mixture: GaussianMixture, updated: Integers, numbers: EventNumbers, n_new: int
) -> GaussianMixture:
    """Room for all components missed, those `updated` by a detection each, and one new label a detection.

    Labels and identities are filled in, and the home of all that were detected: the event's camera at its time.
    """
    known_labels, known_tracks, known_reported = mixture.labels, mixture.tracks, mixture.reported
    count, size = mixture.means.shape
    end = count + len(updated)
    out = allocate_mixture(end + n_new, size)
    labels, tracks, reported = out.labels, out.tracks, out.reported
    for k in range(end):
        origin = k if k < count else updated[k - count]
        labels[k], tracks[k], reported[k] = known_labels[origin], known_tracks[origin], known_reported[origin]
    for j in range(n_new):
        labels[end + j] = numbers.next_label + j
    cameras, times = out.cameras, out.times
    for k in range(count, end + n_new):
        cameras[k], times[k] = numbers.camera, numbers.time_s
    return out


@compiled
def fill_missed(
    mixture: GaussianMixture, moved: Moved, index: Integers, numbers: EventNumbers, out: GaussianMixture
) -> None:
    """Place the components with these indices (m,) at the beginning of `out`, as they are if the event missed them.

    Components wholly in view move to the event's space; others stay at home, where they are Gaussian. Weights, labels
    and identities are not filled in.
    """
    _, means, covariances, cameras, times, _, _, _ = mixture
    moved_means, moved_covariances, _, status, missed_means, missed_covariances, inside = moved
    _, to_means, to_covariances, to_cameras, to_times, _, _, _ = out
    camera, time_s = numbers.camera, numbers.time_s
    for i in range(len(index)):
        k = index[i]
        to_cameras[i] = camera if status[k] == IN_VIEW else cameras[k]
        to_times[i] = time_s if status[k] == IN_VIEW else times[k]
        if status[k] == IN_VIEW:
            copy_gaussian(moved_means, moved_covariances, k, to_means, to_covariances, i)
        elif status[k] == PARTLY_IN_VIEW or inside[k] < 1.0:
            copy_gaussian(missed_means, missed_covariances, k, to_means, to_covariances, i)
        else:
            copy_gaussian(means, covariances, k, to_means, to_covariances, i)
