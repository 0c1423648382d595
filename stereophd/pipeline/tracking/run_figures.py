"""Figures of a run of `stereophd.commands.track`: of all of it, of each camera and of each identity.

Those of a camera state how well tracks explain its detections: the share that belongs to tracks, and the residuals.
Tracks that are too short are left out (``report.min_track_length``).
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.unknowns.considered import CommonPart, moves_of_a_pixel
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.numerics.times import same_time
from stereophd.io.outputs.json_text import finite_or_none
from stereophd.pipeline.tracking.associations import Associated
from stereophd.pipeline.tracking.knocked import Knock
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.residuals import BATCH, SeenTrack, TrackErrors, residuals_of, sightings_of


class Reported(NamedTuple):
    """What the last record reported."""

    time_s: float
    track_ids: Integers  # (k,)
    states: Array  # (k, 6)


@dataclass
class CameraSums:
    """Sums over what one camera reported, and the states and detections whose residuals are still to be computed."""

    frames: int = 0
    detections: int = 0
    outside: int = 0  # Those that see nothing of the region, or are of tracks beside it
    explained: float = 0.0
    residuals: int = 0
    outliers: int = 0
    total: Array = field(default_factory=lambda: np.zeros(2))
    # Squares of the residuals, and those that are expected. They are compared for points alone: the middle of a box is
    # not the image of the middle of a body, and its noise is a part of its size.
    squares: float = 0.0
    expected: float = 0.0
    of_points: bool = True
    waiting: list[SeenTrack] = field(default_factory=list)  # Whose residuals are still to be computed
    # Events at which a track is in view that the record before reported: what an event shows does not decide whether it
    # counts. It does where the track is in view of this camera's next event too, and any camera detects it later: of an
    # object that is gone all are misses. Those that miss it, and those of which the next one misses it, too.
    in_view: int = 0
    missed: float = 0.0
    missed_twice: float = 0.0
    # Events still to be asked: times, and of tracks ids, positions, claims, and detections before by any camera.
    placed: list[tuple[float, Integers, Array, Array, Integers]] = field(default_factory=list)
    # Of the events before, in which no later detection decides yet what counts: tracks, misses, detections before.
    undecided: tuple[Integers, Array, Integers] = field(
        default_factory=lambda: (np.empty(0, dtype=np.int64), np.empty(0), np.empty(0, dtype=np.int64))
    )

    def expect(
        self, before: Reported, record: Record, camera: Camera, detections: Mapping[int, Mapping[str, int]]
    ) -> None:
        """Take in which of the tracks reported before an event of this camera it detects; `detections` were theirs."""
        moved = (record.time_s - before.time_s) * before.states[:, 3:]
        place, claimed = {track: row for row, track in enumerate(before.track_ids.tolist())}, np.zeros(len(moved))
        for one in record.associations:
            if (one.time_s, one.camera) == (record.time_s, record.camera):
                for track, probability in zip(one.track_ids.tolist(), one.probabilities.tolist(), strict=True):
                    if (row := place.get(track)) is not None:
                        claimed[row] += probability
        positions, claims = before.states[:, :3] + moved, np.minimum(claimed, 1.0)
        counts = np.array([sum(detections.get(track, {}).values()) for track in place], dtype=np.int64)
        self.placed.append((record.time_s, before.track_ids, positions, claims, counts))
        if len(self.placed) * len(moved) >= BATCH:
            self._look(camera)

    def _look(self, camera: Camera) -> None:
        """Find out which of the tracks that are placed are in view."""
        if self.placed:
            times, ids, positions, claimed, counts = zip(*self.placed, strict=True)
            at = np.repeat(times, [len(one) for one in positions])
            is_seen = camera.contains(camera.project_at(np.concatenate(positions), at))
            claims = np.concatenate(claimed)[is_seen]
            self.placed = []
            seen, before = np.concatenate(ids)[is_seen], np.concatenate(counts)[is_seen]
            tracks, misses, before = map(np.append, self.undecided, (seen, 1.0 - claims, before))
            order = np.argsort(tracks, kind="stable")
            tracks, misses, before = tracks[order], misses[order], before[order]
            last = before[np.searchsorted(tracks, tracks, side="right") - 1]
            goes_on = np.append(tracks[1:] == tracks[:-1], False)[: len(tracks)]
            counts_now = goes_on & (np.append(before[1:], 0)[: len(tracks)] < last)
            first = np.flatnonzero(counts_now)
            self.in_view += len(first)
            self.missed += float(misses[first].sum())
            self.missed_twice += float((misses[first] * misses[first + 1]).sum())
            is_open = ~counts_now & np.isin(tracks, seen)  # others have gone
            self.undecided = tracks[is_open], misses[is_open], before[is_open]

    def add(self, record: Record, sightings: Associated, camera: Camera) -> None:
        """Take in detections of this camera that tracks claim; those of the record's event have residuals."""
        self.explained += float(sightings.probabilities.sum())
        self.of_points = record.estimates.extents is None
        self.waiting += sightings_of(record, record.estimates, sightings)
        if len(self.waiting) >= BATCH:
            self._compute(camera)

    def _compute(self, camera: Camera) -> None:
        residuals, _, expected, usable, usual = residuals_of(camera, self.waiting)
        found = residuals[usual]
        self.expected += float(expected[usual].sum())
        self.residuals += len(found)
        self.outliers += int(usable.sum()) - len(found)
        self.total = self.total + found.sum(axis=0)
        self.squares += float((found**2).sum())
        self.waiting = []

    def report(self, camera: Camera) -> dict[str, Any]:
        """Return the figures for ``report.json``."""
        self._compute(camera)
        self._look(camera)
        count, compared = self.residuals, self.of_points and self.expected > 0.0
        return {
            "frames": self.frames,
            "detections": self.detections,
            "outside_region": self.outside,
            "explained_detections": self.explained,
            "explained_share": finite_or_none(self.explained / self.detections) if self.detections else None,
            "in_view": self.in_view,
            "detected_share": finite_or_none(1.0 - self.missed / self.in_view) if self.in_view else None,
            "missed_again": finite_or_none(self.missed_twice / self.missed) if self.missed else None,
            "residuals": count,
            "outlier_share": self.outliers / (count + self.outliers) if count else None,
            # Root mean square of one axis.
            "residual_rms_px": float(np.sqrt(self.squares / (2 * count))) if count else None,
            # Over what the stated noise leads to expect of an estimate that has taken in the detection.
            "residual_ratio": float(np.sqrt(self.squares / self.expected)) if compared else None,
            "residual_mean_px": (self.total / count).tolist() if count else None,
        }


@dataclass
class Losses:
    """Events after which a bound left something out, and the most that it left out at once."""

    events: int = 0
    most: int = 0
    burst_frames: int = 0
    burst_detections: int = 0
    hypothesis_events: int = 0
    most_hypotheses: int = 0
    undecided_detections: float = 0.0

    def add(self, record: Record) -> None:
        """Take in a record."""
        if not record.is_event:
            return
        info = record.info
        self.events += info.left_out > 0
        self.most = max(self.most, info.left_out)
        self.burst_frames += info.burst > 0
        self.burst_detections += info.burst
        self.hypothesis_events += info.hypotheses_left_out > 0
        self.undecided_detections += info.undecided_detections
        self.most_hypotheses = max(self.most_hypotheses, info.hypotheses_left_out)


@dataclass
class IdentitySums:
    """Running figures of one track."""

    first_s: float
    last_s: float
    n_estimates: int = 0
    existence: float = 0.0
    speed: float = 0.0
    position_std: float = 0.0
    last: tuple[Array, Array] | None = None  # The last estimate: its state (6,) and covariance (6, 6)


@dataclass
class RunFigures:
    """Figures of a run so far, and what waits for the next row of the table of events: all that is kept of them."""

    events: int = 0
    confirmed: int = 0
    log_likelihood: float = 0.0
    first_s: float = math.nan
    last_s: float = math.nan
    losses: Losses = field(default_factory=Losses)
    cameras: dict[str, CameraSums] = field(default_factory=dict)
    identities: dict[int, IdentitySums] = field(default_factory=dict)
    detections: dict[int, dict[str, int]] = field(default_factory=dict)  # Track -> camera -> number
    knocks: list[Knock] = field(default_factory=list)
    errors: TrackErrors = field(default_factory=TrackErrors)
    # Since the last row of the table of events: what happened between two reports belongs to the second.
    new_detections: int = 0
    new_log_likelihood: float = 0.0
    cameras_part: CommonPart | None = None  # Of what uncertain cameras add
    reported: Reported | None = None  # By the last record

    def add(self, record: Record, cameras: Mapping[str, Camera]) -> None:
        """Count a record, reported or not, of a run of these cameras."""
        self.losses.add(record)
        if record.knock is not None:
            self.knocks.append(record.knock)
        if record.is_event:
            self.events += 1
            self.first_s, self.last_s = (record.time_s if self.events == 1 else self.first_s), record.time_s
            sums = self.cameras.setdefault(record.camera, CameraSums())
            sums.frames += 1
            sums.detections += record.n_detections
            sums.outside += record.outside
            if self.reported is not None:
                sums.expect(self.reported, record, cameras[record.camera], self.detections)
        self.log_likelihood += record.info.log_likelihood
        self.new_detections += record.n_detections
        self.new_log_likelihood += record.info.log_likelihood
        for track_id, counts in record.attributed.items():
            total = self.detections.setdefault(track_id, {})
            for camera, count in counts.items():
                total[camera] = total.get(camera, 0) + count
        for sightings in record.associations:
            sums = self.cameras.setdefault(sightings.camera, CameraSums())
            sums.add(record, sightings, cameras[sightings.camera])
        self.errors.add(record, cameras)
        self.reported = None

    def add_estimates(self, estimates: Estimates, time_s: float) -> None:
        """Count what is reported at a time, s."""
        self.confirmed += len(estimates.track_ids)
        if not len(estimates.track_ids):
            return
        if estimates.extents is None:  # bodies hide one another
            self.reported = Reported(time_s, estimates.track_ids, estimates.states)
        speeds = np.sqrt(np.einsum("ni,ni->n", estimates.states[:, 3:], estimates.states[:, 3:]))
        stds = np.sqrt(np.trace(estimates.covariances[:, :3, :3], axis1=1, axis2=2))
        columns = (estimates.track_ids, estimates.existence, speeds, stds)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for row, (track_id, existence, speed, std) in enumerate(rows):
            identity = self.identities.setdefault(track_id, IdentitySums(time_s, time_s))
            identity.last_s = time_s
            identity.n_estimates += 1
            identity.existence += existence
            identity.speed += speed
            identity.position_std += std
            if self.cameras_part is None:
                identity.last = estimates.states[row].copy(), estimates.covariances[row].copy()

    def report(self, cameras: Mapping[str, Camera], reports: int, estimates: int) -> dict[str, Any]:
        """Return the figures of a run that wrote so many reports and so many estimates, tentative ones included."""
        return {
            "events": self.events,
            "first_s": finite_or_none(self.first_s),
            "duration_s": self.last_s - self.first_s,
            "reports": reports,
            "estimates": self.confirmed,
            "tentative_estimates": estimates - self.confirmed,
            "log_likelihood": self.log_likelihood,
            "left_out": asdict(self.losses),
            "cameras": {name: self.cameras.get(name, CameraSums()).report(camera) for name, camera in cameras.items()},
            "knocks": [asdict(knock) for knock in self.knocks],
            "track_errors": self.errors.report(cameras),
            "tracks": [
                self._track(track_id, identity, cameras) for track_id, identity in sorted(self.identities.items())
            ],
            **self._of_cameras(cameras),
        }

    def _of_cameras(self, cameras: Mapping[str, Camera]) -> dict[str, Any]:
        """Return what the cameras leave uncertain, or what they would, if they were not as exact as they are stated."""
        if self.cameras_part is not None:
            common, other = self.cameras_part.stds()
            return {"cameras_part": {"common_std": common, "other_std": other}}
        last = [(one.last_s, *one.last) for one in self.identities.values() if one.last is not None]
        moves = moves_of_a_pixel(tuple(cameras.values()), *map(np.array, zip(*last, strict=True))) if last else None
        length, stds = (None, None) if moves is None else map(finite_or_none, moves)
        return {"camera_error": {"move_per_px": length, "stds_per_px": stds}}

    def _track(self, track_id: int, identity: IdentitySums, cameras: Iterable[str]) -> dict[str, Any]:
        detections = self.detections.get(track_id, {})
        return {
            "track_id": track_id,
            "first_s": identity.first_s,
            "last_s": identity.last_s,
            "n_estimates": identity.n_estimates,
            "n_detections": {camera: detections.get(camera, 0) for camera in cameras},
            "mean_existence": identity.existence / identity.n_estimates,
            "mean_speed": identity.speed / identity.n_estimates,
            "mean_position_std": identity.position_std / identity.n_estimates,
        }


@dataclass
class LastingTracks:
    """Takes tracks out of records whose first and last reported estimates are less than a time apart; holds its state.

    Every record waits until the records are `min_length_s` past it: a track is known then to last that long, or not to.
    A track that is not reported at that time, but again later, is left out before the gap.
    """

    min_length_s: float
    waiting: list[Record] = field(default_factory=list)
    # Tracks so far -> times of their first and last reported estimate, s.
    first: dict[int, float] = field(default_factory=dict)
    last: dict[int, float] = field(default_factory=dict)

    def records(self, records: Iterable[Record]) -> Iterator[Record]:
        """Yield records, in order of time, without the short tracks."""
        waiting = self.waiting
        for record in records:
            if record.reported:
                for track_id in record.estimates.track_ids.tolist():
                    self.first.setdefault(track_id, record.time_s)
                    self.last[track_id] = record.time_s
            waiting.append(record)
            while record.time_s - waiting[0].time_s > self.min_length_s + same_time(record.time_s):
                yield self._without_short(waiting.pop(0))
        while waiting:
            yield self._without_short(waiting.pop(0))

    def _without_short(self, record: Record) -> Record:
        least = self.min_length_s - same_time(record.time_s)
        return record.of_tracks(lambda one: one in self.first and self.last[one] - self.first[one] >= least)
