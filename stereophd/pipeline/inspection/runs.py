"""Output folders of `track`, `calibrate` and `evaluate`, read back and put together: what a report shows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.errors import InputError
from stereophd.io.outputs.commit import refuse_unsettled
from stereophd.io.outputs.json_text import read_report
from stereophd.io.outputs.provenance import file_sha256
from stereophd.io.tables.reading import arrays_of, finite_column, open_parquet, read_table
from stereophd.io.tables.schemas import ASSOCIATIONS, CONFIRMED, FLOAT, INTEGER, SCANS, TRACKS, kinds_of
from stereophd.pipeline.evaluation.inputs import cameras_of_record, read_truth
from stereophd.pipeline.inspection.tables import kind_of

Columns = Mapping[str, NDArray[Any]]

SCANS_SHOWN = ("time_s", "camera", "frame", "n_detections", "cardinality_mean", "cardinality_estimate")
SCORES = dict.fromkeys(("time_s", "ospa", "ospa_localisation", "ospa_cardinality", "gospa"), FLOAT)
COUNTS = dict.fromkeys(("n_truth", "n_estimates", "n_matched"), INTEGER)

REPORT = "report.json"


@dataclass(frozen=True)
class Evaluation:
    """An evaluation of a run: its report, and the columns of ``per_scan.parquet``."""

    report: Mapping[str, Any]
    scores: Columns


@dataclass(frozen=True)
class Run:
    """One run: what `track` or `calibrate` wrote, and what belongs to it."""

    name: str  # Name of its folder
    command: str  # ``track`` or ``calibrate``; ``evaluate`` for an evaluation whose run is not among the folders
    report: Mapping[str, Any]  # Its ``report.json``
    cameras: tuple[Camera, ...] = ()  # As the run found them, else as it was given them; may be empty
    # `tracks`, `scans`, `associations`: Columns of its tables. Tracks are the confirmed estimates, with
    # ``position_std`` and ``speed`` in place of the covariance; those of bodies have ``height`` and ``width``.
    tracks: Columns | None = None
    scans: Columns | None = None
    associations: Columns | None = None
    # `history`, `posterior`: Columns of a calibration's.
    history: Columns | None = None
    posterior: Columns | None = None
    evaluation: Evaluation | None = None
    truth: Truth | None = None  # True objects
    log: Path | None = None  # Detection log that the run was made from
    files: tuple[Path, ...] = ()  # Reports of the run and of its evaluation

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Version, command, configuration, seed and hashes of the inputs."""
        found: Mapping[str, Any] = self.report["provenance"]
        return found

    @property
    def up(self) -> NDArray[np.float64]:
        """The direction (3,) of the height of bodies; any where they are spheres."""
        shape = self.provenance["config"].get("object") or {}
        vector = np.array(shape.get("up") or (0.0, 0.0, 1.0), dtype=np.float64)
        return np.asarray(vector / np.linalg.norm(vector))

    @property
    def length_unit(self) -> str:
        """Unit of length, empty if it is not known."""
        return str(self.report.get("length_unit") or "")


@dataclass
class _Found:
    runs: list[tuple[Path, Run]] = field(default_factory=list)
    evaluations: list[tuple[Path, Evaluation]] = field(default_factory=list)
    logs: dict[str, Path] = field(default_factory=dict)
    truths: dict[str, Path] = field(default_factory=dict)


def read_runs(
    folders: Sequence[Path | str], logs: Sequence[Path | str] = (), truths: Sequence[Path | str] = ()
) -> tuple[Run, ...]:
    """Read output folders, in their order, and find out which evaluation, log and truth belong to which run.

    The folders are those of `track`, `calibrate`, `evaluate`, `simulate` or `import` (whose log and truth are used), in
    any order; `logs` and `truths` lie elsewhere. An evaluation belongs to the run whose tracks it scored, and a log to
    the runs made from it. A truth belongs to the runs whose evaluation used it. If there is none, it belongs to the
    runs made from a log of its folder. A truth named in `truths` belongs to the runs without another.

    Raises InputError when a folder holds nothing to report on, a file is damaged, or a log belongs to no run.
    """
    found = _Found()
    for folder in folders:
        _read_folder(Path(folder), found)
    for log in logs:
        found.logs[file_sha256(log)] = Path(log)
    for truth in truths:
        found.truths[file_sha256(truth)] = Path(truth)
    runs = [_complete(folder, run, found, [Path(truth) for truth in truths]) for folder, run in found.runs]
    used = {id(run.evaluation) for run in runs}
    for folder, evaluation in found.evaluations:
        if id(evaluation) not in used:
            files = (folder / REPORT,)
            runs.append(Run(folder.name, "evaluate", evaluation.report, evaluation=evaluation, files=files))
    if not runs:
        raise InputError(f"{', '.join(map(str, folders))}: expected an output folder of track, calibrate or evaluate")
    for log in logs:
        if not any(run.log == Path(log) for run in runs):
            raise InputError(f"{log}: none of the runs was made from this log (their hashes differ)")
    return _with_names(runs)


def _read_folder(folder: Path, found: _Found) -> None:
    if not folder.is_dir():
        raise InputError(f"{folder}: expected an output folder, found {'a file' if folder.exists() else 'nothing'}")
    refuse_unsettled(folder)
    for kind, files in (("detections", found.logs), ("truth", found.truths)):
        path = folder / f"{kind}.parquet"
        if path.exists() and kind_of(path) == kind:
            files[file_sha256(path)] = path
    report = read_report(folder / REPORT)
    if report is None:
        if not any(path.parent == folder for path in [*found.logs.values(), *found.truths.values()]):
            raise InputError(f"{folder}: expected an output folder with a {REPORT}, found none")
        return
    command = report["provenance"].get("command")
    if command == "evaluate":
        path = folder / "per_scan.parquet"
        scores = _columns(path, {**SCORES, **COUNTS}) if path.exists() else {}
        found.evaluations.append((folder, Evaluation(report, scores or {})))
    elif command in ("track", "calibrate"):
        found.runs.append((folder, read_run(folder, command, report)))
    elif command != "import":
        raise InputError(f"{folder}: expected the output of track, calibrate or evaluate, found that of {command}")


def read_run(folder: Path, command: str, report: Mapping[str, Any]) -> Run:
    """Read the tables of one output folder, whose report has been read."""
    found = {name: folder / f"{name}.parquet" for name in ("tracks", "scans", "associations", "history", "posterior")}
    held = {name: path for name, path in found.items() if path.exists()}
    return Run(
        folder.name,
        command,
        report,
        _cameras(folder / "cameras.yaml", report["provenance"]),
        tracks=_tracks(held["tracks"]) if "tracks" in held else None,
        scans=_columns(held["scans"], kinds_of(SCANS, *SCANS_SHOWN)) if "scans" in held else None,
        associations=_columns(held["associations"], kinds_of(ASSOCIATIONS)) if "associations" in held else None,
        history=_all_columns(held["history"]) if "history" in held else None,
        posterior=_all_columns(held["posterior"]) if "posterior" in held else None,
        files=(folder / REPORT,),
    )


def _cameras(path: Path, record: Mapping[str, Any]) -> tuple[Camera, ...]:
    if not path.exists():
        return tuple(cameras_of_record(record) or ())
    from stereophd.config.loading import load_cameras

    return tuple(camera.build(name) for name, camera in load_cameras(path).cameras.items())


def _tracks(path: Path) -> Columns:
    required = kinds_of(TRACKS)
    optional = {"status": required.pop("status"), "height": FLOAT, "width": FLOAT}
    table = read_table(path, required, optional, what="table of tracks")
    for name in ("x", "y", "z", "vx", "vy", "vz"):
        finite_column(table, name, path)
    if "status" in table.schema.names:
        table = table.filter(pc.equal(table["status"], CONFIRMED)).drop_columns(["status"])
    columns = arrays_of(table)
    variances = columns.pop("covariance").reshape(-1, 6, 6)[:, [0, 1, 2], [0, 1, 2]]
    with np.errstate(over="ignore", invalid="ignore"):  # what is no covariance gives no standard deviation
        columns["position_std"] = np.sqrt(variances.sum(axis=1))
    columns["speed"] = np.sqrt(columns["vx"] ** 2 + columns["vy"] ** 2 + columns["vz"] ** 2)
    return columns


def _columns(path: Path, required: Mapping[str, Any]) -> Columns:
    return arrays_of(read_table(path, required))


def _all_columns(path: Path) -> dict[str, NDArray[Any]]:
    with open_parquet(path) as parquet:
        kinds = kinds_of(parquet.schema_arrow)
    columns = arrays_of(read_table(path, kinds))
    if "covariance" in columns:
        size = len(columns) - 2
        columns["covariance"] = columns["covariance"].reshape(-1, size, size)
    return columns


def _complete(folder: Path, run: Run, found: _Found, named: Sequence[Path]) -> Run:
    """Add to a run the evaluation, log and truth that belong to it."""
    log = found.logs.get(_inputs(run.report).get("detections", ""))
    tracks = folder / "tracks.parquet"
    digest = file_sha256(tracks) if tracks.exists() else None
    place, evaluation = next(
        (one for one in found.evaluations if digest and _inputs(one[1].report).get("tracks") == digest), (None, None)
    )
    truth = None if evaluation is None else found.truths.get(_inputs(evaluation.report).get("truth", ""))
    if truth is None and log is not None:
        truth = next((path for path in found.truths.values() if path.parent == log.parent), None)
    if truth is None and named:
        truth = named[0]
    files = run.files if place is None else (*run.files, place / REPORT)
    points = None if truth is None else read_truth(truth)[0]
    return replace(run, log=log, evaluation=evaluation, truth=points, files=files)


def _inputs(report: Mapping[str, Any]) -> Mapping[str, str]:
    """Return the hashes of the inputs of a report by their roles."""
    inputs = report["provenance"].get("inputs")
    return {role: str(digest) for role, digest in inputs.items()} if isinstance(inputs, dict) else {}


def _with_names(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Number runs whose folders have the same name."""
    names = [run.name for run in runs]
    return tuple(
        run if names.count(run.name) == 1 else replace(run, name=f"{run.name} {names[: k + 1].count(run.name)}")
        for k, run in enumerate(runs)
    )
