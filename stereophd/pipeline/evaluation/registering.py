"""Tracks in the frame and on the clock of the truth, if the options of an evaluation state it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.geometry.pose import rotation_to_vector
from stereophd.core.metrics.truth.interpolation import Truth, in_window
from stereophd.core.metrics.truth.registration import Freedom, Registration, register
from stereophd.core.metrics.truth.scored import Sightings
from stereophd.errors import InputError
from stereophd.pipeline.evaluation.inputs import Tracks
from stereophd.pipeline.evaluation.options import ScoreOptions
from stereophd.wording import LOGGER


def registration_of(
    tracks: Tracks, truth: Truth, options: ScoreOptions, max_gap_s: float, path: Path
) -> Registration | None:
    """Return the motion and the map of time from tracks to truth that the options state; None without one.

    Raises InputError when too few estimates have a true object at their time.
    """
    freedom = Freedom(options.align != "none", options.align == "similarity", options.align_clock)
    if not len(freedom.columns):
        return None
    time_s, rows = tracks.confirmed_rows()
    used = in_window(time_s, options.from_s, options.to_s)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # a motion that is none is refused
            found = register(time_s[used], tracks.position[rows[used]], truth, max_gap_s, freedom)
    except ValueError as error:
        raise InputError(f"{path}: `align`: {error}") from None
    LOGGER.info("tracks aligned with the truth: %s", registration_report(found))
    return found


def registered_tracks(tracks: Tracks, found: Registration) -> Tracks:
    """Return tracks in the frame and on the clock of the truth."""
    return replace(
        tracks,
        events=replace(tracks.events, time_s=found.times(tracks.events.time_s)),
        position=found.positions(tracks.position),
        velocity=found.velocities(tracks.velocity),
        covariance=found.covariances(tracks.covariance),
        cameras_part=None if tracks.cameras_part is None else found.covariances(tracks.cameras_part),
    )


def registered_sightings(sightings: Sightings | None, found: Registration) -> Sightings | None:
    """Return sightings on the clock of the truth."""
    return None if sightings is None else replace(sightings, time_s=found.times(sightings.time_s))


def registration_report(found: Registration | None) -> dict[str, Any] | None:
    """Return what was found, for ``report.json``."""
    if found is None:
        return None
    return {
        "rotation_deg": np.rad2deg(rotation_to_vector(found.rotation)).tolist(),
        "translation": found.translation.tolist(),
        "scale": found.scale,
        "clock": {"at_s": found.at_s, "shift_s": found.shift_s, "rate": found.rate},
        "estimates": found.estimates,
    }
