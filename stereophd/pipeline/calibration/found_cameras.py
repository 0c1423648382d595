"""Cameras without a known pose: found from the tracks, as the prior means that `calibrate` starts from.

Where a pose or a clock is `unknown`, `stereophd.core.calibration.discovery` finds the cameras first. What it finds
replaces the unknown values of the configuration, with priors about them; the methods of `calibrate` then run as from a
guess. Such priors come from the data. What the data determine is therefore judged by absolute deviations, and by what
the search itself doubts, never by posterior over prior.
"""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from stereophd.config.calibration import BaselineScale, CalibrationConfig, NoScale
from stereophd.config.loading import LoadedConfig, variant
from stereophd.config.yaml import parse_override
from stereophd.core.alignment.frames import moved_camera
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.annealing.control import World
from stereophd.core.calibration.discovery.rig import FoundRig, View, discover
from stereophd.core.calibration.pairing.track_pairs import one_camera_tracks, raw_tracks
from stereophd.core.calibration.time_limit import ENDLESS, TimeLimit
from stereophd.core.calibration.unknowns.observability import pose_spread, posed_cameras
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.disparity.trips import disparity_scale
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_to_vector
from stereophd.core.motion.settings import ESTIMATE
from stereophd.core.numerics.random_streams import CAMERA_DISCOVERY
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.pipeline.calibration.configured_unknowns import calibration_section
from stereophd.pipeline.calibration.problem import CalibrationProblem, Outcome, pmb_filter
from stereophd.pipeline.checks.check_log import check_log
from stereophd.pipeline.checks.finding import warnings_of
from stereophd.pipeline.control import alignment_report
from stereophd.pipeline.initial.acceleration import with_estimated_motion
from stereophd.pipeline.initial.draft import FARTHER, NEARER, UNCERTAIN
from stereophd.pipeline.stream import covered, open_stream
from stereophd.validated import NO_LENGTH

# Frames in which objects are followed, at most, spread over a longer log. Those of the adjustment may be fewer: it
# pairs detections along paths of a motion model, where the search interpolates tracks.
MOST_SEARCHED = 20_000
# Prior deviations about what was found: so many stated ones, and at least these: rad, share of the distance, frames.
STATED, LEAST_ROTATION, LEAST_SHARE, LEAST_FRAMES = 5.0, np.deg2rad(3.0), 0.05, 1.0
# Priors where none is stated: of an unknown focal length and of one that is given (relative), of the principal point
# (in widths of the image), of the rate of an unknown clock, and of a first radial coefficient.
FOCAL_STD, GIVEN_FOCAL_STD, PRINCIPAL_STD, RATE_STD, LENS_STD = float(np.log(1.6)), 0.03, 0.01, 1e-3, 0.1
# What determined cameras are known to at least: rad, share of the size of the rig, relative focal length, frames.
MOST_ROTATION, MOST_SHARE, MOST_FOCAL, MOST_FRAMES = np.deg2rad(2.0), 0.05, 0.05, 1.0
UNIT = "no length is known: the unit of length is the distance of the first two cameras that were joined"


@dataclass(frozen=True)
class FoundCameras:
    """What was found where poses or clocks are unknown: the rig, or the reason why there is none."""

    names: tuple[str, ...]  # of the cameras that were unknown
    rig: FoundRig | None  # not adjusted where it is doubted
    reason: str  # why nothing was found that is believed; empty if something was
    has_scale: bool
    intervals: dict[str, float]  # median one of each camera, s; 0 with fewer than two frames
    estimated: tuple[str, ...] = ()  # keys of the settings that what was found replaced

    def report(self) -> dict[str, Any]:
        """Return the search's part of ``report.json``."""
        out: dict[str, Any] = {"cameras": list(self.names), "reason": self.reason}
        if not self.has_scale:
            out |= {"unit_of_length": UNIT, "estimated_settings": list(self.estimated)}
        if self.rig is None:
            return out
        names = [camera.name for camera in self.rig.cameras]
        out["pairs"] = [
            {
                "cameras": [names[number] for number in pair.cameras], "gain": pair.best.gain,
                "gain_of_pose": pair.gains[0], "gain_of_next_optimum": pair.gains[1],
                "share_in_front": pair.best.front,
                "pieces_of_curves": pair.best.pieces, "residual_over_noise": pair.best.residual,
                "parallax_deg": float(np.rad2deg(pair.best.parallax)),
            }
            for pair in self.rig.pairs
        ]  # fmt: skip
        out["doubts"] = list(self.rig.doubts)
        out["start"] = {
            camera.name: {
                "center": camera.pose.center.tolist(),
                "rotation_vector_deg": np.rad2deg(rotation_to_vector(camera.pose.rotation)).tolist(),
                "focal_px": camera.fx, "clock_offset_s": camera.clock.offset_s, "clock_rate": camera.clock.rate,
            }
            for camera in self.rig.cameras
        }  # fmt: skip
        return out

    def with_motion_to_estimate(self, loaded: LoadedConfig) -> LoadedConfig:
        """Return a configuration whose acceleration is to be estimated where no length is known, so that it is a guess.

        That of `calibrate` itself describes the usual motion, and tracks are lost where objects turn more than that.
        """
        is_stated = getattr(loaded.config.motion, "acceleration_std", None) is not None
        if self.has_scale or not is_stated or isinstance(loaded.config.filter, SingleSettings):
            return loaded
        return variant(loaded, [("no length is known", {"motion.acceleration_std": ESTIMATE})])

    def judged(self, problem: CalibrationProblem, outcome: Outcome) -> Outcome:
        """Return an outcome with the report of the search, and what is known too badly to be called determined."""
        details = {**outcome.details, "found_from_nothing": self.report()}
        if outcome.reason:
            return replace(outcome, details=details)
        return replace(outcome, doubt=outcome.doubt or "; ".join(self._left_open(problem, outcome)), details=details)

    def _left_open(self, problem: CalibrationProblem, outcome: Outcome) -> list[str]:
        """Values whose absolute deviations are too large.

        The place of a camera counts beside the size of the rig, not beside its own distance: the direction of a camera
        next to the reference is hard to know, and tells little of where objects are. An offset is one between two
        clocks: the frames of the slower camera count.
        """
        parameters, out = outcome.parameters, []
        stds = dict(zip(parameters.names, np.sqrt(np.diag(outcome.covariance)).tolist(), strict=True))
        cameras = parameters.build(outcome.values)
        origin = cameras[problem.reference].pose.center
        apart = {camera.name: float(np.linalg.norm(camera.pose.center - origin)) for camera in cameras}
        size = max(apart.values())
        for name in posed_cameras(parameters):
            spread = pose_spread(parameters, problem.reference, outcome.values, outcome.covariance, name)
            if not (spread.rotation <= MOST_ROTATION and spread.direction * apart[name] <= MOST_SHARE * size):
                out.append(
                    f"{name} is known to {np.rad2deg(spread.rotation):.1f} degrees in rotation and "
                    f"{np.rad2deg(spread.direction):.1f} in direction"
                )
        for key, std in stds.items():
            camera, _, component = key.rpartition(".")
            if component == "focal" and not std <= MOST_FOCAL:
                out.append(f"the focal length of {camera} is known to {100.0 * std:.0f} %")
            frames = max(self.intervals[name] for name in (camera, cameras[problem.reference].name))
            if component == "clock_offset" and not std <= MOST_FRAMES * frames:
                out.append(f"the clock of {camera} is known to {std:.2g} s")
        return out


def with_found_cameras(
    loaded: LoadedConfig, log_path: Path | str, limit: TimeLimit = ENDLESS
) -> tuple[LoadedConfig, FoundCameras | None]:
    """Find cameras whose pose or clock is unknown; return the configuration with them and with priors about them.

    The configuration itself, and None, where none is unknown. Where none are found, their poses are placeholders.
    Raises InputError when a camera is unknown that moves or has a prior of its pose, or a scale is stated that only
    known cameras have.
    """
    names = tuple(name for name, camera in loaded.cameras.items() if camera.must_be_found)
    if not names:
        return loaded, None
    section = refuse_search(loaded)
    # apart from one another, so that the filter can be built; each camera is tracked alone
    cameras = tuple(
        replace(config.build(name), pose=Pose(np.eye(3), np.array([number, 0.0, 0.0])))
        for number, (name, config) in enumerate(loaded.cameras.items())
    )
    limit.begin("one-camera tracks are made")
    stream = open_stream(loaded.config, cameras, log_path)
    frames = covered(cameras, stream.frames, stream.source)
    recording = Recording.of(cameras, [(f.camera, f.time_s, f.pixels, f.sigma) for f in frames])
    scans = Scans.of(recording, cameras, recording.spread(MOST_SEARCHED / max(len(recording.cameras), 1)))
    tracks = one_camera_tracks(pmb_filter(_placed(loaded, cameras), cameras), scans, section.annealed)
    views = [_view(loaded, section, camera) for camera in cameras]
    reference = [camera.name for camera in cameras].index(section.reference)
    rng = np.random.default_rng(CAMERA_DISCOVERY.seed(loaded.config.seed))
    discovery = discover(views, raw_tracks(recording, tracks), reference, rng, limit)
    periods = recording.periods(len(cameras)).tolist()
    intervals = {camera.name: period for camera, period in zip(cameras, periods, strict=True)}
    rig = None if discovery.rig is None else _in_frame(loaded, section, discovery.rig)
    found = FoundCameras(names, rig, discovery.reason, not isinstance(section.scale, NoScale), intervals)
    if rig is None or discovery.reason:
        return _placed(loaded, cameras, section), found
    placed = _placed(loaded, rig.cameras, section, _priors(loaded, section, views, rig, intervals))
    if found.has_scale:
        return placed, found
    multi_filter = pmb_filter(placed, rig.cameras)
    space = multi_filter.rig.packed[reference]
    expected = disparity_scale(space) / multi_filter.settings.birth.disparity_moments(space)[0]
    # lengths in a unit that nobody knows are guesses: they yield to what the tracks show with these cameras
    near, middle, far = np.quantile(rig.depths(reference), [0.01, 0.5, 0.99]).tolist()
    placed, shown = with_unit(placed, NO_LENGTH, middle / expected), dict[str, Any]()
    if placed.config.report.max_position_std is None:
        shown["report.max_position_std"] = UNCERTAIN * middle
    if getattr(getattr(placed.config.filter, "birth", None), "depth_range", None) is not None:
        shown["filter.birth.depth_range"] = [NEARER * near, FARTHER * far]
    placed, found = variant(placed, [("the depths of the objects", shown)]), replace(found, estimated=tuple(shown))
    if not limit.begin("settings are compared with what the tracks show"):
        return placed, found
    contradicted = [
        parse_override(finding.change)
        for finding in warnings_of(check_log(placed, log_path, of_rows=False, cameras=rig.cameras))
        if finding.name.startswith("settings.") and finding.change is not None
    ]
    if not contradicted:
        return placed, found
    changes = {".".join(map(str, path)): value.data for path, value in contradicted}
    placed, _ = with_estimated_motion(variant(placed, [("what the tracks show", changes)]), log_path)
    return placed, replace(found, estimated=(*shown, *changes))


def refuse_search(loaded: LoadedConfig) -> CalibrationConfig:
    """Return the section; raise InputError for what the search for cameras of unknown poses and clocks does not do."""
    section, where = calibration_section(loaded), f"{loaded.path}: calibration"
    names = [name for name, camera in loaded.cameras.items() if camera.must_be_found]
    if len(loaded.cameras) < 2:
        raise InputError(f"{loaded.path}: cameras: expected two or more to calibrate, found {len(loaded.cameras)}")
    known = [name for name, camera in loaded.cameras.items() if not camera.pose.unknown and name != section.reference]
    if known:
        raise InputError(
            f"{loaded.path}: cameras.{known[0]}.pose: expected unknown as that of {names[0]}, found a pose: all poses "
            "but that of the reference are found together"
        )
    if not isinstance(section.scale, NoScale | BaselineScale):
        raise InputError(
            f"{where}.scale.kind: expected none or baseline with unknown poses, found {section.scale.kind}"
        )
    if section.reference not in loaded.cameras:
        return section  # said when the unknowns are built
    if loaded.cameras[section.reference].clock.unknown:
        raise InputError(
            f"{where}.reference: expected a camera whose clock is taken as true, found {section.reference}"
        )
    for name, prior in section.priors.items():
        for quantity in quantities():
            if quantity.prior in POSE_PRIORS and np.any(getattr(prior, quantity.prior)):
                raise InputError(
                    f"{where}.priors.{name}.{quantity.prior}: expected none of an unknown camera, found one"
                )
    return section


POSE_PRIORS = ("center_std", "rotation_std_deg", "velocity_std", "rotation_rate_std_deg_s", "clock_offset_std_s")


def _stated(section: CalibrationConfig, name: str, key: str, default: float) -> float:
    """Return a prior deviation of one number that the configuration states of a camera; else a default."""
    prior = section.priors.get(name)
    return float(getattr(prior, key)) if prior is not None and key in prior.model_fields_set else default


def _view(loaded: LoadedConfig, section: CalibrationConfig, camera: Camera) -> View:
    """Return what is known of a camera."""
    config = loaded.cameras[camera.name]
    focal = _stated(section, camera.name, "focal_std", FOCAL_STD if config.intrinsics.unknown else GIVEN_FOCAL_STD)
    lens = config.intrinsics.unknown and camera.lens.model == "none"
    clock = config.clock.unknown and camera.name != section.reference
    rate = _stated(section, camera.name, "clock_rate_std", RATE_STD) if clock else 0.0
    return View(camera, focal, lens, np.inf if clock else 0.0, rate)


def _in_frame(loaded: LoadedConfig, section: CalibrationConfig, rig: FoundRig) -> FoundRig:
    """Return a rig in the axes of the reference's pose, and in the unit of a known distance of two of its cameras."""
    factor = 1.0
    if isinstance(section.scale, BaselineScale):
        centers = {camera.name: camera.pose.center for camera in rig.cameras}
        first, second = (centers.get(name, np.zeros(3)) for name in section.scale.cameras)
        distance = float(np.linalg.norm(first - second))
        factor = section.scale.distance / distance if distance > 0.0 else 1.0  # wrong names are refused later
    origin = loaded.cameras[section.reference].pose.build()
    poses = (
        Pose(camera.pose.rotation @ origin.rotation, origin.center + factor * camera.pose.center @ origin.rotation)
        for camera in rig.cameras
    )
    return replace(rig, cameras=tuple(replace(c, pose=pose) for c, pose in zip(rig.cameras, poses, strict=True)))


def _priors(
    loaded: LoadedConfig, section: CalibrationConfig, views: list[View], rig: FoundRig, intervals: dict[str, float]
) -> dict[str, Any]:
    """Return priors about the cameras of a rig, as the configuration writes them."""
    out: dict[str, Any] = {}
    centers = {camera.name: camera.pose.center for camera in rig.cameras}
    for view, camera, spread in zip(views, rig.cameras, rig.spreads, strict=True):
        prior = copy.deepcopy(loaded.tree.data["calibration"].get("priors", {}).get(camera.name, {}))
        if view.focal_std > 0.0:
            prior["focal_std"] = min(view.focal_std, max(STATED * spread.focal, 0.01))
        prior.setdefault("principal_point_std_px", PRINCIPAL_STD * camera.width)
        if view.lens_is_unknown:
            prior["distortion_std"] = {"k1": LENS_STD}
        if camera.name != section.reference:
            distance = float(np.linalg.norm(camera.pose.center - centers[section.reference]))
            prior["center_std"] = max(STATED * spread.direction, LEAST_SHARE) * distance
            prior["rotation_std_deg"] = float(np.rad2deg(max(STATED * spread.rotation, LEAST_ROTATION)))
        if np.isinf(view.offset_std):
            prior["clock_offset_std_s"] = max(STATED * spread.offset_s, LEAST_FRAMES * intervals[camera.name])
            prior["clock_rate_std"] = view.rate_std
        if prior:
            out[camera.name] = prior
    return out


def _placed(
    loaded: LoadedConfig,
    cameras: tuple[Camera, ...],
    section: CalibrationConfig | None = None,
    priors: dict[str, Any] | None = None,
) -> LoadedConfig:
    """Return a configuration whose cameras have poses, clocks and intrinsics of others, with priors of all unknowns."""
    entries = copy.deepcopy(loaded.tree.data["cameras"])
    for camera in cameras:
        entry = entries[camera.name]
        entry["pose"] = {"center": camera.pose.center.tolist(), "rotation_matrix": camera.pose.rotation.tolist()}
        entry["clock"] = {"offset_s": float(camera.clock.offset_s), "rate": float(camera.clock.rate)}
        entry["intrinsics"] = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
        if camera.lens.model != "none" and "distortion" not in entry:
            entry["distortion"] = {"model": camera.lens.model, "k1": float(camera.lens.k1)}
    changes: dict[str, Any] = {"cameras": entries}
    if section is not None:
        placeholder = {c.name: {"rotation_std_deg": 1.0} for c in cameras if c.name != section.reference}
        changes["calibration.priors"] = priors if priors is not None else placeholder
    return variant(loaded, [("cameras that were found", changes)])


# Sections whose lengths are settings. Those of cameras and of calibrations are made anew where cameras are found.
SECTIONS = ("disparity", "motion", "object", "region", "filter", "report", "evaluation")


def with_unit(loaded: LoadedConfig, unit: str, factor: float) -> LoadedConfig:
    """Return a configuration in another unit, in which its lengths have this many times their values."""
    changes: dict[str, Any] = {"units.length": unit}
    for section in SECTIONS:
        changes.update(_scaled(getattr(loaded.config, section), section, factor))
    return variant(loaded, [("unit of length", changes)])


def _scaled(value: Any, key: str, factor: float) -> Iterator[tuple[str, Any]]:
    """Key paths of the lengths in settings, and their scaled values."""
    if isinstance(value, BaseModel):
        units = {name: field.json_schema_extra for name, field in type(value).model_fields.items()}
    elif is_dataclass(value):
        units = {field.name: field.metadata.get("json_schema_extra") for field in fields(value)}
    else:
        return
    for name, extra in units.items():
        inner, unit = getattr(value, name), extra.get("unit", "") if isinstance(extra, dict) else ""
        if isinstance(inner, BaseModel) or is_dataclass(inner):
            yield from _scaled(inner, f"{key}.{name}", factor)
        elif str(unit).startswith("length") and inner is not None and not isinstance(inner, str):
            yield f"{key}.{name}", [factor * part for part in inner] if isinstance(inner, tuple) else factor * inner


def in_world(
    loaded: LoadedConfig, cameras: tuple[Camera, ...], world: World, unit: str
) -> tuple[LoadedConfig, tuple[Camera, ...], dict[str, Any]]:
    """Return configuration and cameras in the unit and the world of a control track, and what is reported of it."""
    found = world.alignment
    if unit != loaded.config.units.length:
        loaded = with_unit(loaded, unit, found.registration.scale)
    report = {**alignment_report(found, unit), "std": world.std}
    return loaded, tuple(moved_camera(camera, found.registration) for camera in cameras), report
