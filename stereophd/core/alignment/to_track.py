"""Tracks against a control track of one of the objects: a similarity of space and a map of time, with uncertainties."""

import numpy as np

from stereophd.core.alignment.start import OTHER_GAIN, OTHER_UNEXPLAINED, Curve, CurveFit, fits_to
from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.truth.interpolation import DEFAULT_GAP_STEPS, Truth
from stereophd.core.metrics.truth.registration import Alignment, Freedom, Residuals, TrackedPlaces, register, residuals

# A track belongs to the control if its median distance is below this many times that of the best track, or this part
# of the control's spread; rounds in which the members are found.
SAME_OBJECT, LEAST_APART, ROUNDS = 4.0, 0.02, 4
# Times in between two of the control track, and rows of a stretch without gaps that a spline needs.
FINER, LEAST_OF_SPLINE = 4, 5
# Tracks follow each other if their spans add up to at most this many times that of all.
MOST_OVERLAP = 1.1
# Largest part of the control's spread that may be left over, and of its variance at the start, which is not robust.
MOST_LEFT, MOST_UNEXPLAINED = 0.2, 0.5
# What is determined: rotation, rad; logarithm of the scale; shift of the clock, s.
MOST_ROTATION, MOST_SCALE, MOST_SHIFT_S = np.deg2rad(5.0), 0.05, 0.5


def align_to_track(tracks: TrackedPlaces, control: Truth, freedom: Freedom) -> Alignment:
    """Align tracks with a control track of one object, on a clock of its own unless `freedom` keeps the clock.

    The function finds which of all tracks belong to the control. Raises ValueError, which names what is missing, where
    the tracks do not determine the alignment.
    """
    gap = DEFAULT_GAP_STEPS * control.step_s
    control = _finer(control, gap)
    if not len(control.time_s):
        raise ValueError("the control track is broken by gaps everywhere: expected stretches of five rows or more")
    weights = 1.0 / np.trace(tracks.safe_covariance, axis1=1, axis2=2)
    curves, names = curves_of(tracks, weights)
    fits = sorted(fits_to(curves, control, gap, freedom), key=lambda fit: -fit.gain)
    if not fits or fits[0].unexplained > MOST_UNEXPLAINED:
        _refuse_other_motion(float(np.sqrt(fits[0].unexplained)) if fits else 1.0)
    is_single = np.array([len(one) == 1 for one in names])
    found, members = fits[0].registration, np.array([fits[0].curve])
    used = tracks.take(np.isin(tracks.track_id, names[fits[0].curve]))
    spread = float(np.sqrt(control.position.var(axis=0).sum()))
    for number in range(ROUNDS):
        alignment = register(used, control, gap, freedom, found)
        found = alignment.registration
        left = residuals(found, tracks, control, gap)
        apart = [left.distances[np.isin(tracks.track_id[left.rows], ids)] for ids in names]
        medians = np.array([np.median(one) if len(one) else np.inf for one in apart])
        limit = max(SAME_OBJECT * medians[fits[0].curve], LEAST_APART * spread * (number == 0))
        chosen = np.flatnonzero((medians <= limit) & is_single)
        if not len(chosen) or np.array_equal(chosen, members):
            break
        members, used = chosen, tracks.take(np.isin(tracks.track_id, np.concatenate([names[k] for k in chosen])))
    left = residuals(found, used, control, gap)
    _refuse_other_motion(left.distance / spread)
    _refuse_straight(left)
    # whether another offset or track fits as well, without estimates that are far off
    weights[np.flatnonzero(np.isin(tracks.track_id, used.track_id))[left.rows]] *= left.weights
    fits = sorted(fits_to(curves_of(tracks, weights)[0], control, gap, freedom), key=lambda fit: -fit.gain)
    if fits[0].rival is not None:
        raise ValueError(
            f"a clock offset of {fits[0].rival:.1f} s fits nearly as well as {fits[0].registration.shift_s:.1f} s: the "
            "motion repeats itself, or is even; record changes of speed and direction, or state one clock "
            "(`same_clock=True`)"
        )
    _refuse_rival_track(fits, np.unique(used.track_id), names)
    _refuse_undetermined(alignment.covariance)
    return alignment


def _finer(control: Truth, max_gap_s: float) -> Truth:
    """Return a control track with times in between, and with velocities.

    The places are those of splines: straight lines cut corners, and shrink the motion. The velocities are those of
    smoothing splines: differences of noisy places look like motion, from which the clock seems well known.
    """
    from scipy.interpolate import make_interp_spline, make_smoothing_spline  # costly to import

    ends = np.flatnonzero(np.diff(control.time_s) > max_gap_s) + 1
    parts = []
    for rows in np.split(np.arange(len(control.time_s)), ends):
        at, places = control.time_s[rows], control.position[rows]
        if len(rows) < LEAST_OF_SPLINE:
            continue
        fine = np.interp(np.arange(FINER * (len(rows) - 1) + 1) / FINER, np.arange(len(rows)), at)
        smooth = [make_smoothing_spline(at, axis).derivative()(fine) for axis in places.T]
        parts.append(np.column_stack([fine, make_interp_spline(at, places, 3)(fine), *smooth]))
    table = np.concatenate([np.zeros((0, 7)), *parts])
    return Truth(table[:, 0], np.zeros(len(table), dtype=np.int64), table[:, 1:4], table[:, 4:])


def curves_of(tracks: TrackedPlaces, weights: Array) -> tuple[list[Curve], list[Integers]]:
    """Return each track as a curve, and all as one where they follow each other: tracks of one object that broke."""
    curves, names = [], []
    every = np.unique(tracks.track_id)
    spans = [float(np.ptp(tracks.time_s[tracks.track_id == name])) for name in every]
    follow = len(every) > 1 and sum(spans) <= MOST_OVERLAP * float(np.ptp(tracks.time_s))
    for ids in (*every[:, None], *([every] if follow else [])):
        rows = np.flatnonzero(np.isin(tracks.track_id, ids))
        rows = rows[np.append(True, np.diff(tracks.time_s[rows]) > 0.0)]
        if len(rows) > 1:
            curves.append(Curve(tracks.time_s[rows], tracks.position[rows], weights[rows]))
            names.append(ids)
    return curves, names


def _refuse_other_motion(left_over: float) -> None:
    """Refuse a best track that leaves too large a part of the control's motion."""
    if left_over > MOST_LEFT:
        raise ValueError(
            "no track has the motion of the control track: does its object move, was it tracked, and do the times "
            f"overlap? (the best leaves {100.0 * left_over:.0f} % unexplained)"
        )


def _refuse_straight(left: Residuals) -> None:
    places = left.jacobian[:, :, 6]  # about their middle
    width = float(np.sqrt(max(np.linalg.eigvalsh(np.cov(places.T, aweights=left.precisions))[1], 0.0)))
    if width < 2.0 * left.distance:
        raise ValueError(
            "the object moves along one straight line, which leaves the rotation about it open: record curves in two "
            "directions, large against the errors"
        )


def _refuse_rival_track(fits: list[CurveFit], members: Integers, names: list[Integers]) -> None:
    """Refuse tracks of several objects of which each could be that of the control."""
    best = fits[0]
    rivals = [
        fit
        for fit in fits
        if fit.gain > OTHER_GAIN * best.gain
        and fit.unexplained < OTHER_UNEXPLAINED * best.unexplained
        and not np.isin(names[fit.curve], members).any()
    ]
    if rivals:
        raise ValueError(
            f"tracks {names[best.curve][0]} and {names[rivals[0].curve][0]} fit the control track alike: the objects "
            "move together, and which of them it belongs to cannot be decided"
        )


def _refuse_undetermined(covariance: Array) -> None:
    """Raise ValueError, which names what is missing, where the motion does not determine the alignment."""
    rotation = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3]).max()))
    scale, shift = float(np.sqrt(covariance[6, 6])), float(np.sqrt(covariance[7, 7]))
    for value, most, text in (
        (rotation, MOST_ROTATION, f"the rotation open ({np.rad2deg(rotation):.0f} degrees)"),
        (scale, MOST_SCALE, f"the scale open ({100.0 * scale:.0f} %)"),
        (shift, MOST_SHIFT_S, f"the clock open ({shift:.1f} s)"),
    ):
        if value > most:
            raise ValueError(f"the motion leaves {text}: record longer ways, with curves in two directions")
