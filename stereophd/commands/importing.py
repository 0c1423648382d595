"""Bring detections and cameras of another program into native files."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from stereophd.config.loading import read_camera_file
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.interchange.assembly import CameraSummary, write_native_log
from stereophd.io.interchange.base import (
    ForeignRecording,
    ImportOptions,
    TruePoints,
    consulted,
    refuse_other_cameras,
    refuse_unread,
)
from stereophd.io.interchange.registry import find_able, read_foreign
from stereophd.io.interchange.truth import native_truth
from stereophd.io.logs.reading import LogReader
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.json_text import REPORT_VERSION, write_json
from stereophd.io.outputs.provenance import provenance, to_metadata
from stereophd.io.tables.schemas import TRUTH
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.checks.check_log import report_findings
from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.checks.log.log_checks import check_files
from stereophd.pipeline.checks.log.sample import sample_log
from stereophd.pipeline.checks.run_checks import check_rows
from stereophd.pipeline.inspection.cameras import summarise_cameras
from stereophd.wording import LOGGER, counted, instant

DETECTIONS_FILE, CAMERAS_FILE, REPORT_FILE = "detections.parquet", "cameras.yaml", "report.json"
TRUTH_FILE = "truth.parquet"
FILES = (DETECTIONS_FILE, CAMERAS_FILE, TRUTH_FILE, REPORT_FILE)
# A camera's pixels may reach this far outside its image before the size of the image is doubted.
IMAGE_MARGIN_PX = 10.0


def import_recording(
    form: str,
    sources: Sequence[Path | str],
    out_dir: Path | str,
    options: ImportOptions | None = None,
    cameras_path: Path | str | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Import detections, cameras, or both.

    The form is the name of a module of `stereophd.io.formats`; sources are files or folders, as the format has them,
    and the options are what the user states about them. The output folder gets ``detections.parquet`` and
    ``cameras.yaml`` (what the sources hold), ``truth.parquet`` (of `options.truth`) and ``report.json``; outputs of an
    earlier run are replaced with `force` only. `cameras_path` is a native or foreign camera file, for sources that hold
    detections only. Returns the report, as in ``report.json``: counts by camera; ``assumed`` and ``warnings``:
    sentences about what the sources do not state; ``checks``: the findings of
    `stereophd.pipeline.checks.log.log_checks`.

    Raises InputError for an unknown format, a source that is not of it, a statement that is missing or of no use for
    it, and an unusable output folder.
    """
    options = options or ImportOptions()
    find_able(form, lambda one: one.read)  # an unknown format is named before a missing source
    paths = [Path(source) for source in sources]
    for path in filter(None, (*paths, options.truth)):
        if not path.exists():
            raise InputError(f"{path}: there is no such file or folder")
    with OutputFolder(out_dir, FILES, force) as out, ExitStack() as at_the_end:
        noted, read, _ = consulted(options)
        truth = None if options.truth is None else native_truth(options.truth, noted)
        given = options if truth is None else replace(options, truth=None)  # then the reader has no use for the file
        noted, of_cameras, in_cameras = consulted(given)
        described = None if cameras_path is None else read_camera_file(Path(cameras_path), noted)
        if described is not None:
            sizes = {name: given.image_sizes.get(name) or one.image_size_px for name, one in described[0].items()}
            given = replace(given, image_sizes=replace(given.image_sizes, named={**sizes, **given.image_sizes.named}))
        noted, of_reader, in_source = consulted(given)
        recording = read_foreign(form, paths, noted)
        at_the_end.callback(_log, recording.warnings)  # also before an error, which one of them may explain
        if cameras_path is not None and described is not None:
            _add_cameras(recording, Path(cameras_path), *described)
        if truth is not None:
            recording.truth = truth
        files = [*recording.files, *([options.truth] if options.truth is not None else ())]
        inputs = {f"source.{index}": path for index, path in enumerate(files) if path.is_file()}
        config = {"format": form, **options.plain()}
        record = provenance("import", config, inputs=inputs, length_unit=recording.length_unit)
        summaries: dict[str, CameraSummary] = {}
        if recording.pieces is not None:
            log = out.path(DETECTIONS_FILE)
            summaries = write_native_log(recording, noted, log, log.parent, to_metadata(record))
        if recording.truth is not None:
            _write_truth(recording.truth, out.path(TRUTH_FILE), recording, noted, to_metadata(record))
        beside = "" if cameras_path is None else f" with {cameras_path} (native cameras state size, unit and detector)"
        lacking = "" if recording.pieces is not None else f" without {recording.sought}"
        refuse_unread(options, read | of_cameras | of_reader, f"a source of format {form}{lacking}{beside}")
        stated = paths if cameras_path is None else [*paths, Path(cameras_path)]
        refuse_other_cameras(options, [*recording.cameras, *summaries], [*in_cameras, *in_source], stated)
        # frame rates that follow from the log would agree with any times
        rates = {
            name: options.rates.get(name) or recording.rates.get(name) for name in {**recording.cameras, **summaries}
        }
        cameras = {
            name: camera if camera.frame_rate_hz else camera.model_copy(update={"frame_rate_hz": rates[name]})
            for name, camera in recording.cameras.items()
        }
        if cameras:
            assert recording.length_unit is not None
            write_cameras(out.path(CAMERAS_FILE), cameras, recording.length_unit, record)
        _check(recording, summaries, rates)
        findings = _check_files(cameras, summaries, out.path(DETECTIONS_FILE)) if summaries else []
        report = {
            "report_version": REPORT_VERSION,
            "command": "import",
            "format": form,
            "length_unit": recording.length_unit,
            "assumed": recording.assumed,
            "warnings": recording.warnings,
            "checks": report_findings(tuple(findings)),
            "detections": sum(summary.detections for summary in summaries.values()) if summaries else None,
            "cameras": _camera_rows(cameras, summaries),
            "distances": summarise_cameras(cameras, "")["distances"],
            "models": recording.models,
            "truth": None if recording.truth is None else {"rows": len(recording.truth.object_id)},
            "labels": {str(number): label for number, label in recording.labels.items()},
            "provenance": record,
        }
        write_json(out.path(REPORT_FILE), report)
    return report


def _log(warnings: Sequence[str]) -> None:
    for sentence in warnings:
        LOGGER.warning("%s", sentence)


def _add_cameras(
    recording: ForeignRecording, path: Path, cameras: dict[str, CameraConfig], unit: str, assumed: list[str]
) -> None:
    if recording.cameras:
        raise InputError(f"{path}: expected cameras in the source or in a file of their own, found both")
    recording.cameras.update(cameras)
    recording.length_unit = unit
    recording.assumed += assumed
    recording.files.append(path)


def _write_truth(
    truth: TruePoints, path: Path, recording: ForeignRecording, options: ImportOptions, metadata: Mapping[Any, Any]
) -> None:
    """Write the points in space as a truth, in order of time; frames are timed by the rate of all cameras."""
    time = truth.time_s
    if time is None:
        assert truth.frame is not None
        names = list(recording.cameras) or [""]
        rates = {options.rates.get(name) or recording.rates.get(name) for name in names} - {None}
        if len(rates) != 1:
            raise InputError(
                f"{options.truth}: expected one frame rate of all cameras, by `rates`, for the frames of these points; "
                f"found {', '.join(f'{rate:g}' for rate in sorted(filter(None, rates))) or 'none'}"
            )
        time = (truth.frame - recording.first_frame) / float(rates.pop() or 1.0)
        # the clock of the frames is that of the first camera
        time = time + (options.offsets.get(names[0]) or 0.0)
    order = np.lexsort((truth.object_id, time))
    columns = {"time_s": time[order], "object_id": truth.object_id[order]}
    columns |= dict(zip("xyz", truth.position[order].T, strict=True))
    with TableWriter(path, pa.schema([TRUTH.field(name) for name in columns]), metadata) as table:
        table.append(columns)


def _check(
    recording: ForeignRecording, summaries: Mapping[str, CameraSummary], rates: Mapping[str, float | None]
) -> None:
    warn = recording.warnings.append
    if summaries and recording.cameras:
        known = ", ".join(recording.cameras)
        renames = {
            name: f"`rename` {name}={next((camera for camera in recording.cameras if camera in name), 'NAME')}"
            for name in sorted(summaries.keys() - recording.cameras.keys())
        }
        if len(renames) == len(summaries):
            raise InputError(
                f"{recording.source}: expected detections of the cameras {known}, found those of "
                f"{', '.join(renames)}; use {' '.join(renames.values())}{recording.unnamed}"
            )
        for name, use in renames.items():
            warn(f"camera {name} has detections, but the cameras ({known}) have none of that name ({use})")
        for name in sorted(recording.cameras.keys() - summaries.keys()):
            warn(f"camera {name} has no detections (the log has {', '.join(summaries)})")
    for name, size in recording.image_sizes.items():
        camera = recording.cameras.get(name)
        if camera is not None and size != camera.image_size_px:
            stated, taken = (" x ".join(map(str, sides)) for sides in (camera.image_size_px, size))
            warn(
                f"camera {name}: its images have {taken} px, and its intrinsics are those of {stated} px: take the "
                "cameras of this resolution"
            )
    for name, summary in summaries.items():
        if not summary.detections:
            warn(f"camera {name} has frames, but no detections")
        elif name not in recording.cameras and 1 < summary.detections == summary.in_unit_square:
            warn(f"camera {name}: all pixels lie between 0 and 1: they seem to be divided by the image size")
        if summary.repeated_labels:
            warn(
                f"camera {name}: {counted(summary.repeated_labels, 'detection')} of an object that has another one in "
                "the same frame: give one file for the frames of a camera (not both filtered and raw predictions)"
            )
        if summary.duplicate_rows:
            recording.assumed.append(f"{name}: {counted(summary.duplicate_rows, 'row')} left out, repeated in a frame")
        if summary.pauses:
            recording.assumed.append(
                f"{name}: {counted(summary.pauses, 'pause')}, {summary.paused_s:.4g} s in all, would have more frames "
                "than there are with detections: no empty frames are filled in there, as if nothing was recorded"
            )
        if summary.has_whole_times and rates[name] is None and 0.0 < (summary.rate_hz or 0.0) <= 1.0:
            warn(
                f"camera {name}: times are whole numbers of seconds: if they are of another unit, state it, such as "
                "`time_unit` ms; if they number the frames, read them as `columns` frame=COLUMN, and state `rates`"
            )
    spans = {name: (one.first_s or 0.0, one.last_s or 0.0) for name, one in summaries.items()}
    if spans and not recording.cameras and max(spans.values())[0] > min(last for _, last in spans.values()):
        listed = ", ".join(f"{name} {instant(first)} to {instant(last)} s" for name, (first, last) in spans.items())
        warn(f"the cameras have no time in common ({listed}): check rates, offsets and the unit of times")


def _check_files(
    cameras: Mapping[str, CameraConfig], summaries: Mapping[str, CameraSummary], log: Path
) -> list[Finding]:
    """Return the findings of `check` about frames, pixels and cameras, which need the log alone."""
    built = tuple(camera.build(name) for name, camera in cameras.items() if name in summaries)
    if not built:
        return []
    samples = sample_log(LogReader(log, built, "drop", float("inf")), built)
    estimated = [name for name, camera in cameras.items() if camera.detector.estimate]
    outside = sum(int((~one.camera.contains(one.pixels, IMAGE_MARGIN_PX)).sum()) for one in samples)
    rows = check_rows({"rows": sum(len(one.pixels) for one in samples), "outside_image": outside})
    return [*rows, *check_files(samples, whole=False, estimated=estimated)]


def _camera_rows(
    cameras: Mapping[str, CameraConfig], summaries: Mapping[str, CameraSummary]
) -> dict[str, dict[str, Any]]:
    counts = {name: asdict(summary) for name, summary in summaries.items()}
    sizes = {name: {"image_size_px": list(camera.image_size_px)} for name, camera in cameras.items()}
    return {name: {**counts.get(name, {}), **sizes.get(name, {})} for name in {**cameras, **summaries}}
