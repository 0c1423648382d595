"""Score tracks against the truth: both brought to the same scans and, if wanted, frame and clock; then metrics."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.config.tracking import RegionConfig
from stereophd.core.alignment.to_truth import MOST_MISFIT, align_to_truth
from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry.pose import rotation_to_vector
from stereophd.core.geometry.region import box_half_spaces
from stereophd.core.metrics.distances.ospa import score_scans
from stereophd.core.metrics.distances.tgospa import trajectory_gospa
from stereophd.core.metrics.errors import confirmation_figures
from stereophd.core.metrics.matching.clear_mot import beside_another, match_within
from stereophd.core.metrics.scans import PointSets
from stereophd.core.metrics.summary import figures, pair_errors, per_scan_columns, track_ospa
from stereophd.core.metrics.truth.interpolation import (
    Events,
    Truth,
    add_truth_times,
    align_truth,
    in_window,
    last_event_of_each_time,
)
from stereophd.core.metrics.truth.registration import RATE_STD, Freedom, Registration
from stereophd.core.metrics.truth.scored import (
    Sightings,
    cameras_that_saw,
    leave_out_outside,
    leave_out_unseen,
    on_plane,
)
from stereophd.core.numerics.covariance_factors import is_positive_definite
from stereophd.errors import InputError
from stereophd.pipeline.evaluation.inputs import Tracks, rows_of
from stereophd.pipeline.evaluation.options import ScoreOptions
from stereophd.pipeline.evaluation.scale import warn_of_wrong_matches
from stereophd.wording import LOGGER, instant

# Rates of a clock beyond this many standard deviations are warned of.
MOST_RATE_STDS = 3.0


@dataclass(frozen=True)
class Scored:
    """The scored scans and their scores."""

    figures: dict[str, Any]  # Figures of the run, nested
    scans: dict[str, int]  # How many scans were scored, and why others were not
    columns: dict[str, NDArray[Any]]  # Columns of ``per_scan.parquet``
    estimates: PointSets  # The estimates of the scored scans
    registration: Registration | None = None  # How the tracks were brought to the frame and clock of the truth before


def score_tracks(
    tracks: Tracks,
    truth: Truth,
    sightings: Sightings | None,
    options: ScoreOptions,
    max_gap_s: float,
    tracks_path: Path,
) -> Scored:
    """Bring tracks and truth to the same scans, and score them.

    The sightings are needed where only objects that cameras saw lately are scored. Intervals of the truth longer than
    `max_gap_s` are not interpolated over. Raises InputError when nothing can be scored, or a covariance is not positive
    definite where the base needs it.
    """
    found = registration_of(tracks, truth, options, max_gap_s, tracks_path)
    if found is not None:
        tracks = registered_tracks(tracks, found)
        sightings = None if sightings is None else replace(sightings, time_s=found.times(sightings.time_s))
    scans = _common_scans(tracks, truth, options, max_gap_s, tracks_path)
    scans = _scans_of_sight(scans, sightings, options, _region(tracks, options, tracks_path))
    if len(scans.time_s) == 0:
        raise InputError(_nothing_to_score(tracks, truth, scans.unscored, options, tracks_path))
    return _scored(scans, tracks, found, options, tracks_path)


@dataclass(frozen=True)
class _Scans:
    """Estimates and objects of the same scans."""

    time_s: Array
    estimates: PointSets
    points: PointSets  # The objects
    unscored: dict[str, int]  # Scans that are left out, by the reason

    def without(self, emptied: Booleans, estimates: PointSets, points: PointSets, reason: str) -> "_Scans":
        """Return the scans with fewer estimates and objects, without those that this leaves empty."""
        kept = ~emptied
        unscored = {**self.unscored, reason: int(emptied.sum())}
        return _Scans(self.time_s[kept], estimates.keep_scans(kept), points.keep_scans(kept), unscored)


def _common_scans(tracks: Tracks, truth: Truth, options: ScoreOptions, max_gap_s: float, tracks_path: Path) -> _Scans:
    events = tracks.events if tracks.all_events else add_truth_times(tracks.events, truth.time_s)
    if options.at == "times":
        events = events.take(last_event_of_each_time(events.time_s))
    events = events.take(in_window(events.time_s, options.from_s, options.to_s))
    aligned = align_truth(truth, events.time_s, max_gap_s)
    usable = ~(aligned.outside | aligned.gap)
    unscored = {
        "outside_truth": int(aligned.outside.sum()),
        "truth_gap": int((aligned.gap & ~aligned.outside).sum()),
        "unseen": 0,
    }
    points = aligned.points.keep_scans(usable)
    estimates = _estimates(tracks, events.take(usable), options, tracks_path)
    if options.plane is not None:
        normal = np.array(options.plane)
        estimates, points = on_plane(estimates, normal), on_plane(points, normal)
    return _Scans(events.time_s[usable], estimates, points, unscored)


def _region(tracks: Tracks, options: ScoreOptions, tracks_path: Path) -> Array | None:
    """Return the half-spaces (h, 4) of the region in which objects count; None: they count anywhere."""
    if options.region is None or not isinstance(options.region, str):
        return None if options.region is None else box_half_spaces(options.region)
    stated = (tracks.metadata or {}).get("config", {}).get("region")
    spaces = np.empty((0, 4)) if stated is None else RegionConfig.model_validate(stated).half_spaces()
    if not len(spaces):
        raise InputError(f"{tracks_path}: expected tracks of a configuration with region.box or region.polygon")
    return spaces


def _scans_of_sight(scans: _Scans, sightings: Sightings | None, options: ScoreOptions, region: Array | None) -> _Scans:
    """Leave out objects that no camera saw lately, and what lies outside the region, with the estimates of them."""
    order, cutoff = options.order, options.known_cutoff
    if sightings is not None and options.seen_by is not None and options.within_s is not None:
        cameras = cameras_that_saw(sightings, scans.time_s[scans.points.scan], scans.points.label, options.within_s)
        estimates, points, emptied = leave_out_unseen(
            scans.estimates, scans.points, cameras >= options.seen_by, order, cutoff,
            mahalanobis=options.base == "mahalanobis",
        )  # fmt: skip
        scans = scans.without(emptied, estimates, points, "unseen")
    if region is not None:
        estimates, points, emptied = leave_out_outside(scans.estimates, scans.points, region, order, cutoff)
        scans = scans.without(emptied, estimates, points, "outside_region")
    return scans


def _scored(
    scans: _Scans, tracks: Tracks, registration: Registration | None, options: ScoreOptions, tracks_path: Path
) -> Scored:
    estimates, points, time_s = scans.estimates, scans.points, scans.time_s
    order, cutoff, mahalanobis = options.order, options.known_cutoff, options.base == "mahalanobis"
    scores = score_scans(estimates, points, order, cutoff, mahalanobis=mahalanobis)
    distance = cutoff if options.match_distance is None else options.match_distance
    scores, matchable = match_within(estimates, points, scores, order, cutoff, distance, mahalanobis=mahalanobis)
    beside = beside_another(estimates, points, scores.pairs, matchable)
    warn_of_wrong_matches(tracks_path, beside, len(scores.pairs.scan), distance)
    if not len(scores.pairs.scan) and len(estimates.position) and len(points.position):
        text = "%s: no estimate is near enough to an object to match it: has the truth another unit, frame or clock?"
        LOGGER.warning(f"{text} (`align`, `align_clock`)", tracks_path)
    ospa2 = track_ospa(estimates, points, scores.near, options.ospa2_window, order, cutoff)
    errors = pair_errors(estimates, points, scores)
    rows, start = rows_of(tracks.events)  # tentative reports count as the first
    reported_s = np.repeat(tracks.events.time_s, np.diff(start))
    confirmation = confirmation_figures(time_s, estimates, points, scores, tracks.track_id[rows], reported_s)
    summary = figures(estimates, points, scores, matchable, ospa2, errors, confirmation)
    if options.switch_cost is not None:
        tgospa = trajectory_gospa(estimates, points, scores.near, order, cutoff, options.switch_cost)
        summary["tgospa"] = {"mean": tgospa.mean(order), **asdict(tgospa)}
    return Scored(
        figures=summary,
        scans={"scored": len(time_s), "not_scored": sum(scans.unscored.values()), **scans.unscored},
        columns=per_scan_columns(time_s, estimates, points, scores, ospa2, errors),
        estimates=estimates,
        registration=registration,
    )


def _estimates(tracks: Tracks, events: Events, options: ScoreOptions, path: Path) -> PointSets:
    """Return the estimates that were reported after each event."""
    rows, start = rows_of(events)
    covariance = tracks.covariance[rows]
    if options.base == "mahalanobis":
        bad = np.flatnonzero(~is_positive_definite(covariance))
        if bad.size:
            raise InputError(
                f"{path}: row {rows[bad[0]]}: column covariance: expected a positive definite covariance "
                "of the position (base mahalanobis), found one that is not"
            )
    confirmed = tracks.confirmed[rows]
    reported = PointSets(
        start, tracks.position[rows], tracks.velocity[rows], tracks.track_id[rows], covariance, confirmed,
        None if tracks.cameras_part is None else tracks.cameras_part[rows],
    )  # fmt: skip
    return reported if options.tentative else reported.keep_points(confirmed)


def _nothing_to_score(tracks: Tracks, truth: Truth, scans: dict[str, int], options: ScoreOptions, path: Path) -> str:
    def span(time_s: NDArray[Any]) -> str:
        return f"{instant(time_s.min())} to {instant(time_s.max())} s" if len(time_s) else "none"

    parts = [f"events {span(tracks.events.time_s)}", f"truth {span(truth.time_s)} (on one clock?)"]
    limits = (("`from_s`", options.from_s), ("`to_s`", options.to_s))
    parts += [f"{name} {value}" for name, value in limits if value is not None]
    parts += [f"{count} not scored ({name})" for name, count in scans.items() if count]
    return f"{path}: nothing to score: {', '.join(parts)}"


def registration_of(
    tracks: Tracks, truth: Truth, options: ScoreOptions, max_gap_s: float, path: Path
) -> Registration | None:
    """Return the motion and the map of time from tracks to truth that the options state; None without one.

    Raises InputError when too few estimates have a true object at their time.
    """
    freedom = Freedom(options.align != "none", options.align == "similarity", options.align_clock)
    if not len(freedom.columns):
        return None
    estimates = tracks.confirmed_estimates()
    used = in_window(estimates.time_s, options.from_s, options.to_s)
    try:
        found = align_to_truth(estimates.take(used), truth, max_gap_s, freedom)
    except ValueError as error:
        is_lost = isinstance(error, np.linalg.LinAlgError)
        why = "expected tracks with the motion of the truth, found none in any frame" if is_lost else error
        raise InputError(f"{path}: `align`: {why}") from None
    LOGGER.info("tracks aligned with the truth: %s", registration_report(found.registration))
    if found.misfit > MOST_MISFIT:
        LOGGER.warning(
            "%s: `align`: after alignment the tracks are off by %.2g times what they state (median): the tracks are "
            "wrong, or the alignment is, because the truth is of other objects or times, or a clock runs at another "
            "rate; score a part that two cameras see (`from_s`, `to_s`), and look at the frame rates",
            path, found.misfit,
        )  # fmt: skip
    warn_of_rate(path, found.registration)
    return found.registration


def warn_of_rate(path: Path, found: Registration) -> None:
    """Warn where the rate that an alignment found is none of a clock."""
    if abs(found.rate - 1.0) > MOST_RATE_STDS * RATE_STD:
        LOGGER.warning(
            "%s: by the alignment the clock of the tracks is %.2g %% off in rate, and clocks differ by some %.1g %%: "
            "is a frame rate wrong? Otherwise errors of another kind, such as a wrong scale, pass for the clock's",
            path, 100.0 * abs(found.rate - 1.0), 100.0 * RATE_STD,
        )  # fmt: skip


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
