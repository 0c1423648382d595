"""A tracking run: from a configuration to the records of a log, and from records to files."""

import contextlib
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from stereophd.config.loading import LoadedConfig
from stereophd.config.report import GridTimes, ReportConfig
from stereophd.config.tracking import RegionConfig
from stereophd.core.arrays import Array
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.calibration.unknowns.considered import CameraUncertainty, CommonPart
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.cameras.writing import camera_config
from stereophd.io.logs.reading import LogReader
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.tables.schemas import ASSOCIATIONS, CAMERAS_PART, CONFIRMED, EXTENTS, SCANS, STD, TENTATIVE, TRACKS
from stereophd.io.tables.writing import Piece, TableWriter
from stereophd.pipeline.build import build_bodies, build_filter, build_labelled_filter, build_motion, report_times
from stereophd.pipeline.checks.log.sample import sample_log
from stereophd.pipeline.detectors.passes import estimate_detectors, stretches
from stereophd.pipeline.detectors.ray_noise import starting_detectors
from stereophd.pipeline.stream import EventStream
from stereophd.pipeline.tracking.loop import Estimator, Record, RunState, run_estimator
from stereophd.pipeline.tracking.run_figures import LastingTracks, RunFigures
from stereophd.pipeline.tracking.single import SingleTracker, at_most_one, build_single
from stereophd.pipeline.tracking.unfinished import UnfinishedTracking
from stereophd.wording import instant

# Rows of the table of tracks whose part of uncertain cameras is found at once.
ROWS_AT_ONCE = 1024
TRACKS_FILE, SCANS_FILE, ASSOCIATIONS_FILE = "tracks.parquet", "scans.parquet", "associations.parquet"


@dataclass(frozen=True)
class TrackingRun:
    """A run of `track`: the configuration, and what tracks a log by it."""

    loaded: LoadedConfig
    threads: int
    estimator: Estimator[Any]  # A filter of many objects, or a `SingleTracker`
    motion: Motion  # For smoothing
    cameras: tuple[Camera, ...]  # With the detectors that the estimator works with
    report: ReportConfig  # What is reported, and when
    # For ``report.json``: how the detectors were estimated from the log, if they were.
    detectors: dict[str, Any] | None = None
    boxes: bool = False  # Whether detections are boxes, and tracks have a height and a width

    def records(
        self, stream: EventStream, kept: UnfinishedTracking | None = None, run: RunState[Any] | None = None
    ) -> Iterator[Record]:
        """Yield the records of a log, smoothed if the configuration states it; see `reported_records`."""
        single = isinstance(self.estimator, SingleTracker)
        events: Iterable[Event] = stream
        if self.boxes:
            events = with_boxes(stream)
        elif single:
            events = at_most_one(stream)
        region, points = self.loaded.config.region, not (single or self.boxes)
        return reported_records(self.estimator, self.motion, events, self.report, points, kept, run, region)

    def with_estimated_detectors(self, stream: EventStream) -> "TrackingRun":
        """Return the run with detectors estimated from the log; the same where the configuration gives them all."""
        estimated = self.loaded.estimated_cameras
        if not estimated:
            return self
        config, path = self.loaded.config, self.loaded.path
        if self.boxes:
            # imported here: what it needs of SciPy is costly to import
            from stereophd.pipeline.detectors.bodies import starting_box_detectors

            started, priors = starting_box_detectors(self.cameras, estimated)
        else:
            samples = sample_log(stream.frames, self.cameras)
            started, priors = starting_detectors(self.cameras, estimated, samples)
        cameras, detectors = estimate_detectors(
            started, priors, lambda used: build_labelled_filter(config, used, path, self.threads), stretches(stream)
        )
        return replace(build_tracking(self.loaded, self.threads, cameras), detectors=detectors)

    def write(
        self, records: Iterable[Record], out: OutputFolder, metadata: Mapping[bytes, bytes],
        kept: UnfinishedTracking | None = None, uncertainty: CameraUncertainty | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Write ``tracks.parquet``, ``scans.parquet`` and, with ``report.associations``, ``associations.parquet``.

        With `kept` that keeps tables and gives the `records`, the tables begin with those of a killed run. The
        covariances count the `uncertainty` of the cameras. Returns the figures of the run for ``report.json``.
        """
        columns = (*(EXTENTS if self.boxes else ()), *(STD if self.report.std_columns else ()))
        columns += () if uncertainty is None else (CAMERAS_PART,)
        schemas = {TRACKS_FILE: pa.schema([*TRACKS, *columns]), SCANS_FILE: SCANS}
        schemas |= {ASSOCIATIONS_FILE: ASSOCIATIONS} if self.report.associations else {}
        make = TableWriter if kept is None or kept.keeps_records else kept.table
        with contextlib.ExitStack() as files:
            figures = RunFigures() if kept is None else kept.figures
            complete = None if uncertainty is None else functools.partial(with_cameras_part, uncertainty, figures)
            tables = {
                name: files.enter_context(
                    make(out.path(name), schema, metadata, complete=complete if name == TRACKS_FILE else None)
                )
                for name, schema in schemas.items()
            }
            cameras = {camera.name: camera for camera in self.cameras}
            later = {} if uncertainty is None else {CAMERAS_PART.name: None}
            for record in records:
                figures.add(record, cameras)
                _write_record(record, tables, self.report, figures, later)
        return figures.report(cameras, tables[SCANS_FILE].rows, tables[TRACKS_FILE].rows)


def reported_records(
    estimator: Estimator[Any],
    motion: Motion,
    events: Iterable[Event],
    report: ReportConfig,
    reach_back: bool = False,
    kept: UnfinishedTracking | None = None,
    run: RunState[Any] | None = None,
    region: RegionConfig | None = None,
) -> Iterator[Record]:
    """Yield the records of events, smoothed and without short tracks if the section ``report`` states it.

    With `reach_back`, smoothed tracks reach back to detections that the filter did not assign to them. With a
    `kept` the run continues from there, and what it gives is kept there; without one it begins at `run`, if given.
    """
    smooth = report.smooth
    times = report_times(report, region)
    if kept is None:
        records = run_estimator(estimator, events, times, smooth is not None, run)
    else:
        records = kept.records(events, times, smooth is not None)
    if smooth is not None:
        from stereophd.pipeline.tracking.smoothed import smoothed_records  # only here: other runs begin sooner

        records = smoothed_records(records, estimator.rig.cameras, motion, smooth, reach_back, report.max_position_std)
        if (inside := times.region) is not None:
            records = (replace(record, estimates=record.estimates.inside(inside)) for record in records)
    if report.min_track_length <= 0.0:
        return records
    if kept is not None:
        return kept.lasting(records, report.min_track_length)
    return LastingTracks(report.min_track_length).records(records)


def build_tracking(loaded: LoadedConfig, threads: int = 1, cameras: tuple[Camera, ...] | None = None) -> TrackingRun:
    """Return what tracks by a configuration, with its cameras or others, such as those with estimated detectors.

    Raises InputError if the configuration has no filter or no cameras, or they do not fit each other.
    """
    cameras = loaded.build_cameras() if cameras is None else cameras
    config = loaded.config
    _check_reassociation(loaded)
    if isinstance(config.object, EllipsoidSettings):
        body_filter = build_bodies(config, cameras, loaded.path)
        return TrackingRun(loaded, threads, body_filter, body_filter.motion, cameras, config.report, boxes=True)
    if not isinstance(config.filter, SingleSettings):
        multi_filter = replace(build_filter(config, cameras, loaded.path, threads), claims=True)
        return TrackingRun(loaded, threads, multi_filter, multi_filter.motion, cameras, config.report)
    motion = build_motion(config, loaded.path)
    estimator = build_single(config, motion, cameras, loaded.path)
    if loaded.estimated_cameras:
        raise InputError(f"{loaded.path}: detector: expected given where filter.kind is single, found estimate")
    for camera in cameras:
        if camera.readout_s != 0.0:
            where = f"{loaded.path}: cameras.{camera.name}.readout_s"
            raise InputError(f"{where}: expected 0 where filter.kind is single, found {camera.readout_s:g}")
    tracker = SingleTracker(estimator, config.filter.point)
    return TrackingRun(loaded, threads, tracker, motion, cameras, config.report)


def _check_reassociation(loaded: LoadedConfig) -> None:
    """Refuse `report.smooth.reassociate` where tracks cannot choose their detections anew."""
    config = loaded.config
    if config.report.smooth is None or not config.report.smooth.reassociate:
        return
    where = f"{loaded.path}: report.smooth.reassociate: expected false"
    if isinstance(config.filter, SingleSettings):
        raise InputError(f"{where} where filter.kind is single, found true")
    if isinstance(config.object, EllipsoidSettings):
        raise InputError(f"{where} where object.shape is ellipsoid: only points change tracks, found true")
    if config.motion is not None and config.motion.model == "static":
        raise InputError(f"{where} where motion.model is static, found true")
    if isinstance(config.report.times, GridTimes):
        raise InputError(f"{where} where report.times is a grid, found true")


def with_detectors(described: Mapping[str, CameraConfig], cameras: Sequence[Camera]) -> dict[str, CameraConfig]:
    """Return the descriptions of cameras with the detectors of others, as given and no longer to be estimated."""
    return {
        one.name: described[one.name].model_copy(update={"detector": camera_config(one).detector}) for one in cameras
    }


def with_boxes(stream: EventStream) -> Iterator[Event]:
    """Yield the events of a log of boxes; InputError if ``width_px, height_px`` or a detection's box is missing."""
    if isinstance(stream.frames, LogReader) and not stream.frames.has_boxes:
        raise InputError(
            f"{stream.source}: expected the columns width_px and height_px (object.shape is ellipsoid), found none"
        )
    for event in stream:
        if event.sizes is None or np.isnan(event.sizes).any():
            raise InputError(
                f"{stream.source}: frame {event.frame} of {stream.cameras[event.camera].name} at "
                f"{instant(event.time_s)} s: expected a box (width_px, height_px) for each "
                "detection (object.shape is ellipsoid), found none"
            )
        yield event


STATE_COLUMNS = ("x", "y", "z", "vx", "vy", "vz")


def _write_record(
    record: Record, tables: Mapping[str, TableWriter], report: ReportConfig, figures: RunFigures,
    later: Mapping[str, None],
) -> None:  # fmt: skip
    """Write what is to be reported of a record that `figures` have counted, into tables by the names of their files.

    They have a row for each estimate, for each event and, if it is there, for each association. `report` says which
    estimates are written, and which columns; those of the estimates that are filled in `later` are empty.
    """
    for sightings in record.associations if ASSOCIATIONS_FILE in tables else ():
        tables[ASSOCIATIONS_FILE].append(sightings.columns())
    if not record.reported:
        return
    estimates = record.estimates
    if report.max_position_std is not None:
        estimates = estimates.certain(report.max_position_std)
    key = {"time_s": record.time_s, "camera": record.camera, "frame": record.frame}
    tables[SCANS_FILE].append(
        {
            **key,
            "n_detections": np.array([figures.new_detections]),
            "cardinality_mean": record.info.cardinality_mean,
            "cardinality_estimate": len(estimates.track_ids),
            "log_likelihood": figures.new_log_likelihood,
            "n_components": record.info.n_components,
        }
    )
    figures.new_detections, figures.new_log_likelihood = 0, 0.0
    figures.add_estimates(estimates, record.time_s)
    for level, status in ((estimates, CONFIRMED), (estimates.tentative, TENTATIVE)):
        if level is not None and len(level.track_ids):
            columns = _columns(level, report.std_columns)
            tables[TRACKS_FILE].append({**key, **columns, **later, "status": status})


def with_cameras_part(uncertainty: CameraUncertainty, figures: RunFigures, pieces: Sequence[Piece]) -> list[Piece]:
    """Return pieces of ``tracks.parquet`` with the part of uncertain cameras, in the covariances too, and count it.

    Many rows at once take less than a thirtieth of the time that they take one by one.
    """
    states = np.concatenate([np.stack([piece[name] for name in STATE_COLUMNS], axis=1) for piece, _ in pieces])
    alone = np.concatenate([piece["covariance"] for piece, _ in pieces])
    times = np.repeat([piece["time_s"] for piece, _ in pieces], [rows for _, rows in pieces])
    added, part = np.empty_like(alone), figures.cameras_part or CommonPart.of_none(uncertainty.parameters.size)
    for start in range(0, len(states), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        moves = uncertainty.moves(times[rows], states[rows], alone[rows])
        part = part.including(states[rows, :3], moves @ uncertainty.root)
        added[rows] = uncertainty.added(moves)
    figures.cameras_part = part
    out, done, whole = [], 0, alone + added
    stds = _stds(whole)
    wider = np.linalg.norm(stds, axis=1) - np.linalg.norm(_stds(alone), axis=1)
    for piece, count in pieces:
        rows = slice(done, done + count)
        std = _named(STD, stds[rows]) if STD[0].name in piece else {}
        for track_id, more in zip(piece["track_id"].tolist(), wider[rows].tolist(), strict=True):
            if piece["status"] == CONFIRMED:
                figures.identities[track_id].position_std += more
        out.append(({**piece, "covariance": whole[rows], CAMERAS_PART.name: added[rows], **std}, count))
        done += count
    return out


def _columns(estimates: Estimates, std_columns: bool) -> dict[str, Any]:
    """Columns of ``tracks.parquet`` of one event."""
    return {
        "track_id": estimates.track_ids,
        **{name: estimates.states[:, axis] for axis, name in enumerate(STATE_COLUMNS)},
        "covariance": estimates.covariances,
        "existence": estimates.existence,
        **({} if estimates.extents is None else _named(EXTENTS, estimates.extents)),
        **(_named(STD, _stds(estimates.covariances)) if std_columns else {}),
    }


def _stds(covariances: Array) -> Array:
    """Return the standard deviations (n, 3) of positions, from covariances (n, 6, 6)."""
    return np.sqrt(np.diagonal(covariances[:, :3, :3], axis1=1, axis2=2))


def _named(fields: Sequence[pa.Field], values: Array) -> dict[str, Any]:
    """Return the columns of an array (n, c) by the names of their fields."""
    return {field.name: values[:, number] for number, field in enumerate(fields)}
