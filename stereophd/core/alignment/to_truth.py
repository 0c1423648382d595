"""Tracks against the truth of several objects, in a frame and on a clock that may be any."""

import numpy as np

from stereophd.core.alignment.start import fits_to
from stereophd.core.alignment.to_track import curves_of
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.core.metrics.truth.registration import Alignment, Freedom, Registration, TrackedPlaces, register

# Errors after alignment beyond this many times what the tracks state are those of wrong tracks, or of a wrong start.
MOST_MISFIT = 3.0
# Objects of the truth that tracks are compared with one by one, and starts that are tried.
MOST_OBJECTS, MOST_STARTS = 8, 4
# Least distance that counts, in parts of the size of the truth.
TINY = 1e-9


def align_to_truth(tracks: TrackedPlaces, truth: Truth, max_gap_s: float, freedom: Freedom) -> Alignment:
    """Align tracks with a truth, from where they are, and if the frame is free from what single tracks have in common
    with single objects.

    One object shows by its misfit whether that from where they are is right. Of several, what is nearer than chance
    decides: the sum of the logarithms of the size of the truth over the distances. A median says nothing of a short
    track whose object moves as another one does. Raises ValueError as `register`.
    """
    found, error = _registered(tracks, truth, max_gap_s, freedom, None)
    is_one = bool(np.all(truth.object_id == truth.object_id[:1]))
    if freedom.frame and not (is_one and found is not None and found.misfit <= MOST_MISFIT):
        starts = _starts(tracks, truth, max_gap_s, freedom)
        others = [_registered(tracks, truth, max_gap_s, freedom, start)[0] for start in starts]
        size = float(np.linalg.norm(np.ptp(truth.position, axis=0)))
        found = max(
            (one for one in (found, *others) if one is not None),
            key=lambda one: float(np.log(size / np.maximum(one.distances, TINY * size)).sum()),
            default=None,
        )
    if found is None:
        assert error is not None
        raise error
    return found


def _registered(
    tracks: TrackedPlaces, truth: Truth, max_gap_s: float, freedom: Freedom, start: Registration | None
) -> tuple[Alignment | None, ValueError | None]:
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # a motion that is none is refused
            return register(tracks, truth, max_gap_s, freedom, start), None
    except ValueError as error:
        return None, error


def _starts(tracks: TrackedPlaces, truth: Truth, max_gap_s: float, freedom: Freedom) -> list[Registration]:
    """Return the registrations with which a track fits an object best, of the objects that there are for longest."""
    curves, _ = curves_of(tracks, 1.0 / np.trace(tracks.safe_covariance, axis1=1, axis2=2))
    objects, counts = np.unique(truth.object_id, return_counts=True)
    longest = np.argsort(-counts, kind="stable")[:MOST_OBJECTS]
    fits = []
    for name in objects[longest[counts[longest] > 1]]:
        rows = truth.object_id == name
        alone = Truth(truth.time_s[rows], truth.object_id[rows], truth.position[rows])
        fits += fits_to(curves, alone, max_gap_s, freedom)
    return [fit.registration for fit in sorted(fits, key=lambda fit: -fit.gain)[:MOST_STARTS]]
