"""Bring cameras and tracks into a world frame: that of a control track, the floor, gravity, or one of the cameras."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from stereophd.commands.options import AlignOptions
from stereophd.config.loading import load_cameras
from stereophd.core.alignment.frames import GRAVITY, camera_frame, floor_frame, gravity_frame, moved_camera
from stereophd.core.alignment.to_points import ControlPoints, align_to_points
from stereophd.core.alignment.to_track import align_to_track
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.truth.registration import Alignment, Freedom, Registration
from stereophd.errors import InputError, unknown_camera
from stereophd.io.cameras.models import CamerasFile
from stereophd.io.cameras.writing import plain_cameras, write_cameras
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.json_text import REPORT_VERSION, write_json
from stereophd.io.outputs.provenance import provenance, to_metadata
from stereophd.io.tables.reading import arrays_of, damaged_is_input_error, open_parquet
from stereophd.io.tables.schemas import EXTENTS, STD
from stereophd.io.tables.writing import TableWriter
from stereophd.options import takes
from stereophd.pipeline.calibration.configured_unknowns import with_quantities
from stereophd.pipeline.cameras_covariance import in_world, rows_of, stated_uncertainty
from stereophd.pipeline.control import Control, alignment_report, points_report, read_control
from stereophd.pipeline.evaluation.inputs import read_tracks
from stereophd.pipeline.evaluation.scoring import warn_of_rate
from stereophd.validated import METRES, NO_LENGTH
from stereophd.wording import LOGGER

CAMERAS_FILE, TRACKS_FILE, REPORT_FILE = "cameras.yaml", "tracks.parquet", "report.json"
TABLES = (TRACKS_FILE, "scans.parquet", "associations.parquet")
FLOOR, FALL = "floor", "gravity"


@takes(AlignOptions)
def align(
    cameras: Sequence[Path | str], to: Path | str, out_dir: Path | str | None = None, *, options: AlignOptions
) -> dict[str, Any]:
    """Bring cameras, and the tracks made with them, into a world frame.

    The cameras are files ``cameras.yaml``, or the folders of `calibrate` or `track` that hold them; tables of tracks,
    scans and associations beside a file are moved with it. Each is aligned by itself, `to` a control track (Parquet or
    CSV: ``time_s, x, y, z`` of one object, on a clock of its own; or ``time_s, latitude_deg, longitude_deg,
    altitude_m``), points of known place (``camera, u_px, v_px, x, y, z``), ``floor``, ``gravity``, or a camera by its
    name. ``cameras.yaml``, the tables and ``report.json`` go into `out_dir` if it is given, of several into a folder of
    the name of each. Returns ``runs``: of each the similarity, the map of time, their standard deviations, and what is
    left over. Raises InputError if a file is not usable, or the motion does not determine the frame; the message names
    what is missing.
    """
    sources = [Path(path) / CAMERAS_FILE if Path(path).is_dir() else Path(path) for path in cameras]
    for folder, path in zip(map(Path, cameras), sources, strict=True):
        if folder.is_dir() and not path.exists():
            raise InputError(f"{folder}: expected {CAMERAS_FILE} in it; name a file of cameras, and `tracks_path`")
    names = [path.parent.resolve().name if path.name == CAMERAS_FILE else path.stem for path in sources]
    if len(set(names)) < len(names):
        raise InputError(f"expected cameras in folders of different names, found {', '.join(names)}")
    runs = []
    for name, path in zip(names, sources, strict=True):
        out = None if out_dir is None else Path(out_dir) / (name if len(sources) > 1 else "")
        runs.append({"name": name, **_aligned(path, to, out, options)})
    return {"report_version": REPORT_VERSION, "runs": runs}


def _aligned(path: Path, to: Path | str, out_dir: Path | None, options: AlignOptions) -> dict[str, Any]:
    file = load_cameras(path)
    built = {name: camera.build(name) for name, camera in file.cameras.items()}
    tracks_path = Path(options.tracks_path or path.with_name(TRACKS_FILE))
    control = read_control(Path(to), list(built.values())) if Path(to).is_file() else None
    found, unit, origin = _alignment(path, to, options, file, built, tracks_path, control)
    try:
        moved = [moved_camera(camera, found.registration) for camera in built.values()]
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    configs = with_quantities(file.cameras, moved, f"{path}: a camera in the world frame")
    stated, rows = stated_uncertainty(list(built.values()), file.covariance), None
    if stated is not None:
        joint = block_diag(stated.covariance, found.covariance)
        rows = rows_of(in_world(stated, found.registration, found.center, joint))
    kind = str(to) if str(to) in (FLOOR, FALL, *built) else "control"
    report: dict[str, Any] = {"report_version": REPORT_VERSION, "to": kind}
    report |= {**alignment_report(found, unit), **({} if origin is None else {"origin": origin})}
    if isinstance(control, ControlPoints):
        report |= points_report(control, moved, str(to))
    if unit == NO_LENGTH:
        report["scale_is_unknown"] = "no length is known: lengths are in units of the distance of two cameras"
        LOGGER.warning("%s: %s", path, report["scale_is_unknown"])
    tables = {name: tracks_path.parent / name for name in TABLES[1:]} | {TRACKS_FILE: tracks_path}
    tables = {name: source for name, source in tables.items() if source.exists()}
    inputs: dict[str, Path | str] = {"cameras": path, **{name.partition(".")[0]: tables[name] for name in tables}}
    if Path(to).is_file():
        inputs["control"] = to
    record = provenance("align", {**report, "cameras": plain_cameras(configs)}, inputs=inputs, length_unit=unit)
    report["provenance"] = record
    if out_dir is not None:
        with OutputFolder(out_dir, [CAMERAS_FILE, REPORT_FILE, *TABLES], options.force) as out:
            write_cameras(out.path(CAMERAS_FILE), configs, unit, record, rows)
            for name, source in tables.items():
                write_moved(source, out.path(name), found.registration, to_metadata(record))
            write_json(out.path(REPORT_FILE), report)
    return report


def _alignment(
    path: Path, to: Path | str, options: AlignOptions, file: CamerasFile, built: dict[str, Camera], tracks_path: Path,
    control: Control | ControlPoints | None,
) -> tuple[Alignment, str, dict[str, float] | None]:  # fmt: skip
    """Return how the cameras lie in the world, the world's unit of length, and its geographic origin."""
    unit = file.units.length
    acts = {
        "forward": control is None and str(to) in (FLOOR, FALL), "same_scale": control is not None,
        "same_clock": isinstance(control, Control),
    }  # fmt: skip
    for option in (name for name, is_used in acts.items() if getattr(options, name) and not is_used):
        raise InputError(f"`{option}`: expected another `to`, found {to}, with which it does nothing")
    forward = options.forward or next(iter(built))
    if forward not in built:
        raise InputError(f"`forward`: {unknown_camera(forward, list(built))}")
    if str(to) in built:
        return camera_frame(built[str(to)].pose), unit, None
    if control is None and str(to) not in (FLOOR, FALL):
        raise InputError(
            f"`to`: expected a control track or points (Parquet or CSV), {FLOOR}, {FALL}, or a camera "
            f"({', '.join(built)}), found {to}; there is no such file"
        )
    # a control without a unit has that of the cameras
    target = (control.length_unit if control is not None else None) or ("m" if unit == NO_LENGTH else unit)
    if options.same_scale and target != unit:
        raise InputError(f"`same_scale`: expected cameras in {target} as {to}, found {unit}")
    if isinstance(control, ControlPoints):
        try:
            return align_to_points(list(built.values()), control, not options.same_scale), target, None
        except ValueError as error:
            raise InputError(f"{to}: {error}") from None
    tracks = read_tracks(tracks_path)
    if tracks.length_unit not in (None, unit):
        raise InputError(f"{tracks_path}: expected lengths in {unit} as in {path}, found {tracks.length_unit}")
    estimates, pose = tracks.confirmed_estimates(), built[forward].pose
    try:
        if control is None and str(to) == FLOOR:
            return floor_frame(estimates, pose), unit, None
        if control is None:
            return gravity_frame(estimates, pose, GRAVITY / METRES[target]), target, None
        freedom = Freedom(True, not options.same_scale, not options.same_clock)
        found = align_to_track(estimates, control.track, freedom)
        warn_of_rate(tracks_path, found.registration)
        return found, target, control.origin
    except ValueError as error:
        raise InputError(f"{tracks_path}: `to` {to}: {error}") from None


def write_moved(path: Path, target: Path, found: Registration, metadata: Mapping[bytes, bytes]) -> None:
    """Write a table of a run (tracks, scans, associations) with its times, and the states it holds, in the world."""
    turn = found.scale * found.rotation
    jacobian = block_diag(turn, turn / found.rate)
    with open_parquet(path) as parquet, damaged_is_input_error(path):
        schema = parquet.schema_arrow.remove_metadata()
        with TableWriter(target, schema, metadata) as writer:
            for batch in parquet.iter_batches():
                columns = arrays_of(batch)
                columns["time_s"] = found.times(columns["time_s"])
                for names, move in ((("x", "y", "z"), found.positions), (("vx", "vy", "vz"), found.velocities)):
                    if set(names) <= columns.keys():
                        moved = move(np.column_stack([columns[name] for name in names]))
                        columns.update(zip(names, moved.T, strict=True))
                for name in [name for name in ("covariance", "covariance_cameras") if name in columns]:
                    columns[name] = jacobian @ columns[name].reshape(-1, 6, 6) @ jacobian.T
                if STD[0].name in columns:
                    variances = np.diagonal(columns["covariance"][:, :3, :3], axis1=1, axis2=2)
                    columns.update(zip((field.name for field in STD), np.sqrt(variances).T, strict=True))
                for field in EXTENTS:
                    if field.name in columns:
                        columns[field.name] = found.scale * columns[field.name]
                if batch.num_rows:
                    writer.append(columns)
