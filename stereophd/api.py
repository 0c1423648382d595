"""The commands for programs and notebooks: tables in memory or paths go in, `Outputs` come out.

Each function runs a command into a folder: the user's (`out`), or one that vanishes together with its `Outputs`. What
is given as a table, as cameras or as a mapping is written into such a folder first, so that a command has one mechanism
and its provenance names what was given.
"""

from __future__ import annotations

import html
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereophd.commands import options as kinds
from stereophd.commands.init import init as write_config
from stereophd.config.loading import LoadedConfig, as_config, load_config
from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError
from stereophd.io.interchange.options import ExportOptions, ImportOptions
from stereophd.io.tables.reading import open_parquet
from stereophd.options import takes
from stereophd.pipeline.files import read_cameras, write_cameras, write_log

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Outputs:
    """What a command made: its report, and its files as tables that are read when they are asked for.

    Attributes
    ----------
    folder : folder of the files; without `out` it is temporary, and vanishes together with this object
    report : as in ``report.json``
    log : detection log that the command read, or None
    """

    folder: Path
    report: dict[str, Any]
    log: Path | None = None
    _kept: tuple[object, ...] = ()  # what the log or the folder vanishes with

    def table(self, name: str) -> pa.Table:
        """Return a table of the folder by its name without ``.parquet``; InputError if there is none."""
        path = self.folder / f"{name}.parquet"
        if not path.exists():
            held = ", ".join(sorted(file.stem for file in self.folder.glob("*.parquet"))) or "none"
            raise InputError(f"{self!r}: expected the table {name}, found {held}")
        with open_parquet(path) as file:
            return file.read()

    @property
    def tracks(self) -> pa.Table:
        """``tracks.parquet``: one row per estimate, tentative ones too."""
        return self.table("tracks")

    @property
    def scans(self) -> pa.Table:
        """``scans.parquet``: one row per event."""
        return self.table("scans")

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """``cameras.yaml``: the cameras that the command wrote."""
        return read_cameras(_inside(self, "cameras.yaml"))

    @property
    def config(self) -> LoadedConfig:
        """``config.yaml``: the configuration that `init` wrote."""
        return load_config(_inside(self, "config.yaml"))

    @property
    def covariances(self) -> Array:
        """Covariances (n, 6, 6) of the rows of `tracks`: position and velocity in the world frame."""
        column = self.tracks["covariance"].combine_chunks()
        return np.asarray(column.flatten(), dtype=np.float64).reshape(-1, 6, 6)

    def to_pandas(self, name: str = "tracks", status: str | None = "confirmed") -> Any:
        """Return a table as a data frame; of the tracks the rows of one status, or all (None)."""
        try:
            frame = self.table(name).to_pandas()
        except ImportError:
            raise InputError("pandas: expected it to be installed, found that it is not: pip install pandas") from None
        return frame if name != "tracks" or status is None else frame[frame["status"] == status].reset_index(drop=True)

    def plot(self, view: str = "top") -> Figure:
        """Draw the tracks: ``top`` or ``side`` (views), ``timelines``, or ``residuals`` (with `associations`)."""
        from stereophd.report.installed import whether_to_draw

        if view == "residuals":
            self.table("associations")  # an error names what is missing
        whether_to_draw(True)
        import matplotlib.pyplot  # costly to import, and an extra

        from stereophd.pipeline.inspection.runs import read_run
        from stereophd.report.plots.track_plots import draw_track_plot

        matplotlib.pyplot.get_backend()  # a notebook shows figures once pyplot has chosen how
        command = self.report["provenance"]["command"]
        return draw_track_plot(read_run(self.folder, command, self.report), view)

    def __repr__(self) -> str:
        return f"Outputs({', '.join(sorted(path.name for path in self.folder.glob('*') if path.is_file()))})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the page of `report_page`, else the summary of the command line."""
        page = self.report.get("page")
        if page is not None:
            document = html.escape(Path(page).read_text(encoding="utf-8"), quote=True)
            return f'<iframe srcdoc="{document}" style="width: 60rem; height: 50rem; border: 0"></iframe>'
        return f"<pre>{html.escape(_summary(self.report))}</pre>"


def _summary(report: Mapping[str, Any]) -> str:
    """Return the text that the command line prints about a report of a run or of scores, else its plain values."""
    from stereophd.report.scores import scores_text
    from stereophd.report.summaries import summary_text

    if "ospa" in report:
        return scores_text(report)
    if "tracks" in report or "status" in report:
        return summary_text(report)
    plain = {key: value for key, value in report.items() if isinstance(value, str | int | float)}
    return "\n".join(f"{key}: {value}" for key, value in plain.items())


class _Work:
    """The folder of a call: what was given in memory, and the outputs unless the user names a folder for them."""

    def __init__(self, out: Path | str | None = None) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="stereophd-"))
        self.out = self.folder / "out" if out is None else Path(out)
        self.kept: list[object] = []
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def outputs(self, report: dict[str, Any], log: Path | None = None) -> Outputs:
        """Return the outputs of the call."""
        return Outputs(self.out, report, log, (self, *self.kept))

    def log(self, given: Any) -> Path:
        """Return the path of detections that are a path, a folder, outputs, or a table in memory."""
        if isinstance(given, Outputs | str | Path):
            self.kept.append(given)
            return _inside(given, "detections.parquet")
        if not hasattr(given, "__getitem__") or not (hasattr(given, "keys") or hasattr(given, "column_names")):
            raise InputError(f"detections: expected a path, outputs or a table, found {type(given).__name__}")
        path = self.folder / "detections.parquet"
        try:
            write_log(path, given, force=True)
        except InputError as error:
            raise InputError(str(error).replace(str(path), "detections")) from None
        return path

    def truth(self, given: Any) -> Path:
        """Return the path of a truth that is a table in memory."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        path = self.folder / "truth.parquet"
        try:
            names = given.keys() if hasattr(given, "keys") else given.column_names
            pq.write_table(pa.table({str(name): np.asarray(given[name]) for name in names}), path)
        except (AttributeError, TypeError, ValueError, pa.ArrowException) as error:
            found = f"{type(given).__name__} ({error})"
            raise InputError(f"truth: expected a path, outputs or a table, found {found}") from error
        return path

    def cameras(self, given: Any, unit: str) -> Path | None:
        """Return the path of cameras that are a path, a folder, outputs, or `Camera` objects in a unit of length."""
        if given is None or isinstance(given, Outputs | str | Path):
            return None if given is None else _inside(given, "cameras.yaml")
        if not isinstance(given, Sequence) or not all(isinstance(camera, Camera) for camera in given):
            raise InputError(f"cameras: expected a path, outputs or `Camera` objects, found {type(given).__name__}")
        path = self.folder / "cameras.yaml"
        write_cameras(path, given, unit, force=True)
        return path

    def config(
        self, given: Any, cameras: Any, log: Path | None = None, seed: int | None = None, overrides: Sequence[str] = ()
    ) -> LoadedConfig:
        """Return the configuration that is given, with cameras, seed and overrides; None: what `init` estimates."""
        if given is None and log is not None:
            write_config(self.folder / "study", log, self.cameras(cameras, "m"), overrides=overrides)
            return as_config(self.folder / "study" / "config.yaml", seed=seed)
        given = _inside(given, "config.yaml") if isinstance(given, Outputs) else given
        unit = "m" if cameras is None else as_config(given).config.units.length
        return as_config(given, overrides, seed, self.cameras(cameras, unit))


def _path(given: Any) -> Path:
    """Return a path, or the folder of outputs."""
    if not isinstance(given, Outputs | str | Path):
        raise InputError(f"expected a path or outputs, found {type(given).__name__}")
    return given.folder if isinstance(given, Outputs) else Path(given)


def _inside(given: Any, name: str) -> Path:
    """Return a file: the path itself, or the file of this name in a folder or in outputs."""
    path = _path(given)
    return path / name if path.is_dir() else path


@takes(kinds.InitOptions)
def init(
    detections: Any = None, cameras: Any = None, *, out: Path | str | None = None, overrides: Sequence[str] = (),
    options: kinds.InitOptions,
) -> Outputs:  # fmt: skip
    """Estimate settings from detections; `Outputs.config` holds them.

    The arguments before the options are those of `track`; by default the cameras are those beside the log. `overrides`
    are values that are known, and that `init` keeps.
    """
    work = _Work(out)
    log = None if detections is None else work.log(detections)
    given = work.cameras(cameras, options.length_unit or "m")
    return work.outputs(write_config(work.out, log, given, overrides, options=options), log)


def check(detections: Any, config: Any = None, cameras: Any = None) -> Outputs:
    """Check whether detections fit cameras and settings; parameters as of `track`.

    The report has ``warnings`` (their number) and ``checks`` (name, state, message and remedy of each).
    """
    from stereophd.commands.check import check as run

    work = _Work()
    log = work.log(detections)
    return work.outputs(run(work.config(config, cameras, log), log), log)


@takes(kinds.SimulateOptions)
def simulate(
    config: Any, cameras: Any = None, *, out: Path | str | None = None, seed: int | None = None,
    overrides: Sequence[str] = (), options: kinds.SimulateOptions,
) -> Outputs:  # fmt: skip
    """Simulate the scene of a configuration: the tables ``detections`` and ``truth``, and `Outputs.cameras`.

    `config`, `cameras`, `out`, `seed` and `overrides` are those of `track`.
    """
    from stereophd.commands.simulate import simulate as run

    work = _Work(out)
    return work.outputs(run(work.config(config, cameras, None, seed, overrides), work.out, options=options))


@takes(kinds.TrackOptions)
def track(
    detections: Any, config: Any = None, cameras: Any = None, *, out: Path | str | None = None, smooth: bool = False,
    associations: bool = False, seed: int | None = None, overrides: Sequence[str] = (), options: kinds.TrackOptions,
) -> Outputs:  # fmt: skip
    """Track the objects of a detection log.

    Parameters
    ----------
    detections : path, Outputs or table
        Detection log: ``time_s, camera, frame, u_px, v_px`` (px, s) of a path, pandas, Arrow or a mapping of arrays.
        A list of paths is tracked log by log into `out`; the table ``summary`` has a row for each.
    config : path, mapping, LoadedConfig or Outputs, optional
        Settings; without any, `init` estimates them from the detections.
    cameras : path, Outputs or sequence of Camera, optional
        They replace those of the configuration, with centres in its unit of length.
    out : path, optional
        Folder for the files; nothing is kept without it.
    smooth, associations : bool
        Smooth every track over the whole log; also write which detection belongs to which track.
    seed : int, optional
        Replaces that of the configuration.
    overrides : sequence of str
        ``key.path=value`` each, such as ``filter.kind=phd``.

    Returns
    -------
    Outputs
        `tracks`, `scans`, `report`; also `to_pandas()`, `covariances` and `plot()`.

    Raises
    ------
    InputError
        What is given cannot be used; the message says where.
    """
    from stereophd.commands.batches import track_logs
    from stereophd.commands.track import track as run
    from stereophd.commands.track import with_reports

    work = _Work(out)
    log = None if isinstance(detections, list | tuple) else work.log(detections)
    loaded = with_reports(work.config(config, cameras, log, seed, overrides), smooth, associations or options.plots)
    if log is None:
        return work.outputs(track_logs(loaded, [work.log(each) for each in detections], work.out, options=options))
    return work.outputs(run(loaded, log, work.out, options=options), log)


@takes(kinds.CalibrateOptions)
def calibrate(
    detections: Any, config: Any, cameras: Any = None, *, out: Path | str | None = None, seed: int | None = None,
    overrides: Sequence[str] = (), options: kinds.CalibrateOptions,
) -> Outputs:  # fmt: skip
    """Calibrate cameras from the detections of moving objects: `Outputs.cameras`, and the tables of `track`.

    The arguments before the options are those of `track`. The ``status`` of the report says whether the data determine
    the cameras; a `GateError` where they determine less than ``require``.
    """
    from stereophd.commands.batches import calibrate_logs
    from stereophd.commands.calibrate import calibrate as run

    work = _Work(out)
    loaded = work.config(config, cameras, None, seed, overrides)
    options = replace(options, plots=False) if out is None and options.plots is None else options
    if isinstance(detections, list | tuple):
        return work.outputs(calibrate_logs(loaded, [work.log(each) for each in detections], work.out, options=options))
    log = work.log(detections)
    return work.outputs(run(loaded, log, work.out, options=options), log)


@takes(kinds.AlignOptions)
def align(cameras: Any, to: Path | str, *, out: Path | str | None = None, options: kinds.AlignOptions) -> Outputs:
    """Bring cameras (a path, or `Outputs` with their tracks) into a world frame; the report has the similarity.

    `to` is a control track, ``floor``, ``gravity`` or the name of a camera.
    """
    from stereophd.commands.align import align as run

    work = _Work(out)
    return work.outputs(run([_path(cameras)], to, work.out, options=options))


@takes(kinds.EvaluateOptions)
def evaluate(tracks: Any, truth: Any, *, out: Path | str | None = None, options: kinds.EvaluateOptions) -> Outputs:
    """Score tracks against the truth; the report has the scores, and the table ``per_scan`` those of each time.

    Parameters
    ----------
    tracks : path or Outputs
        A table of tracks, the folder of a run, or a folder of runs (``NAME/tracks.parquet``).
    truth : path, Outputs or table
        ``time_s, object_id, x, y, z`` and perhaps ``vx, vy, vz``; for a folder of runs a folder of truths.
    out : path, optional
        Folder for the files; nothing is kept without it.

    Returns
    -------
    Outputs
        A `GateError` in their place where a figure is beyond ``fail_above`` or ``fail_below``.
    """
    from stereophd.commands.batches import evaluate_runs
    from stereophd.commands.evaluate import evaluate as run

    work = _Work(out)
    options = replace(options, plots=False) if out is None and options.plots is None else options
    scored = _path(tracks)
    if scored.is_dir() and not (scored / "tracks.parquet").exists():
        return work.outputs(evaluate_runs(scored, truth, work.out, options=options))
    if not isinstance(truth, Outputs | str | Path):
        truth = work.truth(truth)
    paths = _inside(tracks, "tracks.parquet"), _inside(truth, "truth.parquet")
    return work.outputs(run(*paths, work.out, options=options))


@takes(kinds.EvaluateCamerasOptions)
def evaluate_cameras(
    estimated: Any,
    true: Any,
    config: Any = None,
    *,
    out: Path | str | None = None,
    options: kinds.EvaluateCamerasOptions,
) -> Outputs:
    """Score cameras (paths or `Outputs`) against true ones; with a configuration also against the Cramer-Rao bound."""
    from stereophd.commands.evaluate_cameras import evaluate_calibration

    work = _Work(out)
    paths = _inside(estimated, "cameras.yaml"), _inside(true, "cameras.yaml")
    loaded = None if config is None else work.config(config, paths[1])
    return work.outputs(evaluate_calibration(*paths, work.out, loaded, options=options))


@takes(kinds.ExperimentOptions)
def experiment(
    config: Any, *, out: Path | str | None = None, seed: int | None = None, overrides: Sequence[str] = (),
    options: kinds.ExperimentOptions,
) -> Outputs:  # fmt: skip
    """Compare methods over many runs of a scenario: the tables ``runs`` and ``summary``; arguments as of `track`."""
    from stereophd.commands.experiment import experiment as run

    work = _Work(out)
    run(work.config(config, None, None, seed, overrides), work.out, options=options)
    return work.outputs({})


@takes(ImportOptions)
def import_recording(
    form: str, sources: Any, cameras: Path | str | None = None, *, out: Path | str | None = None, force: bool = False,
    options: ImportOptions,
) -> Outputs:  # fmt: skip
    """Import detections and cameras of another program: the table ``detections`` and `Outputs.cameras`.

    Parameters
    ----------
    form : str
        Name of the format, such as ``csv`` or ``dltdv``.
    sources : path or list of paths
    cameras : path, optional
        Native or foreign cameras, for sources that hold detections only.
    out : path, optional
        Folder for the files; nothing is kept without it. Of the options, those of cameras (`PerCamera`) are one value,
        such as ``rates=60`` (per second), or a mapping by camera: ``offsets={"left": 0.1}`` (s).
    """
    from stereophd.commands.importing import import_recording as run

    work, paths = _Work(out), sources if isinstance(sources, list | tuple) else [sources]
    return work.outputs(run(form, [_path(path) for path in paths], work.out, options, cameras, force))


@takes(ExportOptions)
def export(form: str, source: Any, out: Path | str, force: bool = False, *, options: ExportOptions) -> Outputs:
    """Write tracks or cameras as a file of another program."""
    from stereophd.commands.export import export as run

    return Outputs(Path(out).parent, run(form, _path(source), out, options, force))


def report_page(*sources: Any, out: Path | str | None = None, title: str = "stereophd", force: bool = False) -> Outputs:
    """Make one page about runs (folders or `Outputs`), which a notebook shows; needs the extra ``report``."""
    from stereophd.commands.report import report as run

    work = _Work()
    folders = [_path(source) for source in sources]
    logs = {source.log for source in sources if isinstance(source, Outputs) and source.log is not None}
    elsewhere = [log for log in logs if log.parent not in folders]
    work.out.mkdir()
    return work.outputs(run(folders, out or work.out / "report.html", logs=elsewhere, title=title, force=force))
