"""Tracks against a control track of one of the objects: a similarity of space and a map of time, with uncertainties."""

from dataclasses import dataclass

import numpy as np

from stereophd.core.alignment.start import OTHER_GAIN, OTHER_UNEXPLAINED, Curve, CurveFit, fits_to
from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.errors import independent_count
from stereophd.core.metrics.truth.interpolation import DEFAULT_GAP_STEPS, Truth
from stereophd.core.metrics.truth.registration import Freedom, Registration, Residuals, register, residuals

# A track belongs to the control if its median distance is below this many times that of the best track, or this part
# of the control's spread; rounds in which the members are found.
SAME_OBJECT, LEAST_APART, ROUNDS = 4.0, 0.02, 4
# Times in between two of the control track, and rows of a stretch without gaps that a spline needs.
FINER, LEAST_OF_SPLINE = 4, 5
# Tracks follow each other if their spans add up to at most this many times that of all.
MOST_OVERLAP = 1.1
# Largest part of the control's spread that may be left over.
MOST_LEFT = 0.2
# What is determined: rotation, rad; logarithm of the scale; shift of the clock, s.
MOST_ROTATION, MOST_SCALE, MOST_SHIFT_S = np.deg2rad(5.0), 0.05, 0.5


@dataclass(frozen=True)
class Alignment:
    """How tracks lie in a world: the similarity and the map of time, and how well they are known."""

    registration: Registration
    center: Array  # (3,): The place in the world about which the covariance turns and scales
    # (9, 9): Of rotation (rad, about the world's axes), translation, log scale, shift (s) and rate.
    covariance: Array
    members: Integers  # Numbers of the tracks that belong to the control
    distances: Array  # (r,): Distances that are left, length

    @property
    def std(self) -> Array:
        """Standard deviations (9,) in the order of the covariance."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def exactly(registration: Registration) -> Alignment:
    """Return an alignment by definition, such as a camera's frame."""
    return Alignment(registration, np.zeros(3), np.zeros((9, 9)), np.zeros(0, dtype=np.int64), np.zeros(0))


def align_to_track(time_s: Array, position: Array, track_ids: Integers, control: Truth, freedom: Freedom) -> Alignment:
    """Align tracks with a control track of one object, on a clock of its own unless `freedom` keeps the clock.

    Times (n,), s, in order, positions (n, 3) and identities (n,) of all tracks; the function finds
    which of them belong to the control. Raises ValueError, which names what is missing, where the tracks do not
    determine the alignment.
    """
    gap = DEFAULT_GAP_STEPS * control.step_s
    control = _finer(control, gap)
    if not len(control.time_s):
        raise ValueError("the control track is broken by gaps everywhere: expected stretches of five rows or more")
    curves, names = _curves(time_s, position, track_ids)
    fits = sorted(fits_to(curves, control, gap, freedom), key=lambda fit: -fit.gain)
    _refuse_other_motion(float(np.sqrt(fits[0].unexplained)) if fits else 1.0)
    is_single = np.array([len(one) == 1 for one in names])
    found, members = fits[0].registration, np.array([fits[0].curve])
    rows = np.isin(track_ids, names[fits[0].curve])
    _refuse_straight(residuals(found, time_s[rows], position[rows], control, gap))
    _refuse_rival_offset(fits[0])
    spread = float(np.sqrt(control.position.var(axis=0).sum()))
    for number in range(ROUNDS):
        found = register(time_s[rows], position[rows], control, gap, freedom, found)
        medians = np.array([_median_distance(found, curve, control, gap) for curve in curves])
        limit = max(SAME_OBJECT * medians[fits[0].curve], LEAST_APART * spread * (number == 0))
        chosen = np.flatnonzero((medians <= limit) & is_single)
        if not len(chosen) or np.array_equal(chosen, members):
            break
        members, rows = chosen, np.isin(track_ids, np.concatenate([names[k] for k in chosen]))
    _refuse_rival_track(fits, np.unique(track_ids[rows]), names)
    left = residuals(found, time_s[rows], position[rows], control, gap)
    _refuse_other_motion(0.5 * left.reach / spread)
    covariance = _covariance(left, track_ids[rows][left.rows], freedom)
    _refuse_undetermined(covariance)
    distances = np.linalg.norm(left.errors, axis=1)
    return Alignment(found, left.center, covariance, np.unique(track_ids[rows]), distances)


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


def _curves(time_s: Array, position: Array, track_ids: Integers) -> tuple[list[Curve], list[Integers]]:
    """Return each track as a curve, and all as one where they follow each other: tracks of one object that broke."""
    curves, names = [], []
    every = np.unique(track_ids)
    spans = [float(np.ptp(time_s[track_ids == name])) for name in every]
    follow = len(every) > 1 and sum(spans) <= MOST_OVERLAP * float(np.ptp(time_s))
    for ids in (*every[:, None], *([every] if follow else [])):
        rows = np.flatnonzero(np.isin(track_ids, ids))
        rows = rows[np.append(True, np.diff(time_s[rows]) > 0.0)]
        if len(rows) > 1:
            curves.append(Curve(time_s[rows], position[rows]))
            names.append(ids)
    return curves, names


def _median_distance(found: Registration, curve: Curve, control: Truth, gap: float) -> float:
    left = residuals(found, curve.time_s, curve.position, control, gap)
    return float(np.median(np.linalg.norm(left.errors, axis=1))) if len(left.rows) else np.inf


def _refuse_other_motion(left_over: float) -> None:
    """Refuse a best track that leaves too large a part of the control's motion."""
    if left_over > MOST_LEFT:
        raise ValueError(
            "no track has the motion of the control track: does its object move, was it tracked, and do the times "
            f"overlap? (the best leaves {100.0 * left_over:.0f} % unexplained)"
        )


def _refuse_straight(left: Residuals) -> None:
    """Refuse motion along one line."""
    places = left.jacobian[:, :, 6]  # about their middle
    width = float(np.sqrt(max(np.linalg.eigvalsh(places.T @ places / max(len(places), 1))[1], 0.0)))
    if width < left.reach:
        raise ValueError(
            "the object moves along one straight line, which leaves the rotation about it open: record curves in two "
            "directions, large against the errors"
        )


def _refuse_rival_offset(best: CurveFit) -> None:
    """Refuse a clock offset beside which another fits nearly as well."""
    if best.rival is not None:
        raise ValueError(
            f"a clock offset of {best.rival:.1f} s fits nearly as well as {best.registration.shift_s:.1f} s: the "
            "motion repeats itself, or is even; record changes of speed and direction, or state one clock "
            "(`same_clock=True`)"
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
            "move together, and which of them it belongs to cannot be told"
        )


def _covariance(left: Residuals, track_ids: Integers, freedom: Freedom) -> Array:
    """Covariance (9, 9) of a registration by what it leaves over; zero of what is not free.

    Successive errors are alike. If their correlation falls exponentially, with the r errors worth m of a mean square
    (`independent_count`), those of a mean are worth about r / (2 r / m - 1).
    """
    columns = freedom.columns
    weighted = left.jacobian[:, :, columns] * np.sqrt(left.weights)[:, None, None]
    variance = float((left.weights[:, None] * left.errors**2).sum() / (3.0 * left.weights.sum()))
    count = len(left.rows)
    alike = max(2.0 * count / max(independent_count(left.errors, track_ids), 1.0) - 1.0, 1.0)
    matrix = np.einsum("nai,naj->ij", weighted, weighted)
    scales = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.pinv(matrix / np.outer(scales, scales), rcond=1e-13, hermitian=True) / np.outer(scales, scales)
    out = np.zeros((9, 9))
    out[np.ix_(columns, columns)] = max(variance, 1e-300) * alike * inverse
    return out


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
