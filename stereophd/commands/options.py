"""Options of the commands, each declared once; see `stereophd.options`.

Nothing heavy may be imported here: the command line makes its help from these classes.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from stereophd.io.interchange.options import ExportOptions, ImportOptions
from stereophd.options import numbers_by_key, option, options
from stereophd.pipeline.evaluation.options import ScoreOptions

# The use of `evaluate` with many runs.
FOLDERS = "folders of runs"
# That of `track` with several processes.
MANY = "several logs, or pieces of one"


def _jobs(meaning: str, use: str) -> Any:
    return option(meaning, default=1, metavar="N", least=1, use=use)


def _dask(meaning: str, use: str = "") -> Any:
    return option(meaning, default=None, metavar="ADDRESS", use=use)


def _limits(what: str, such_as: str) -> Any:
    meaning = f"Exit with 1 if a figure is {what} a limit, such as {such_as} (repeatable)."
    return option(meaning, default=None, metavar="KEY=VALUE", parse=numbers_by_key)


@options
class Replacing:
    """What every command that writes takes."""

    force: bool = option("Replace the outputs of an earlier run.", default=False)


@options
class TrackOptions(Replacing):
    """Options of `track`, for one log and for several."""

    jobs: int = _jobs("Processes for several logs, or for the pieces of one; the results do not depend on it.", MANY)
    dask: str | None = _dask("Track the logs or pieces on a Dask cluster, such as tcp://host:8786.", MANY)
    threads: int = _jobs("Threads; the outputs do not depend on it.", "filters of several objects")
    pieces_s: float | None = option(
        "Cut the log into pieces of this length, track them independently, and join their tracks. The last piece is "
        "shorter, or longer by up to the overlap.",
        default=None,
        metavar="SECONDS",
        flag="pieces",
        above=0.0,
    )
    overlap_s: float | None = option(
        "Seconds before its own span that each piece also tracks [60].",
        default=None,
        metavar="SECONDS",
        flag="overlap",
        use="pieces of a log",
    )
    resume: bool = option("Continue an interrupted run; keep what is finished.", default=False)
    plots: bool = option(
        "Draw views, timelines, residuals (needs the extra 'plot'; adds the associations).", default=False
    )


@options
class LiveOptions:
    """Where the frames of a recording that is still running come from, and where they are kept."""

    follow: Path | None = option(
        "Track a recording that is still running: a growing file of JSON lines or Arrow IPC, a folder of Parquet "
        "parts, or an MCAP file.",
        default=None,
        metavar="LOG",
    )
    listen: str | None = option(
        "Track frames that arrive at a ZeroMQ address, such as tcp://127.0.0.1:5555 (needs the extra 'live').",
        default=None,
        metavar="ADDRESS",
    )
    publish: str | None = option(
        "Publish the tracks of a running recording at a ZeroMQ address too, such as tcp://127.0.0.1:5556 (needs the "
        "extra 'live').",
        default=None,
        metavar="ADDRESS",
    )
    mcap: Path | None = option(
        "Write the tracks of a running recording as an MCAP file too (needs the extra 'mcap').",
        default=None,
        metavar="FILE",
    )
    arrow: bool = option("Write an Arrow IPC stream in place of lines of JSON.", default=False)
    record: Path | None = option(
        "Keep the frames of a running recording as JSON lines while they arrive.", default=None, metavar="FILE"
    )


@options
class CalibrateOptions(Replacing):
    """Options of `calibrate`, for one log and for several."""

    jobs: int = option(
        "Processes (threads, of particles and covariances); the results do not depend on it. -1: all cores.",
        default=-1,
        metavar="N",
        use="without a cluster",
    )
    dask: str | None = _dask("Calibrate several logs on a Dask cluster.", "several logs")
    resume: bool = option("Continue an interrupted run from what it has kept (DIR/partial-HASH).", default=False)
    plots: bool | None = option("Make plots (needs the extra 'plot'); default: if it is installed.", default=None)
    require: Literal["determined", "partly"] | None = option(
        "Exit with 1 if the data determine the cameras less than this.", default=None, flag="require-status"
    )
    time_s: float | None = option(
        "End the search after this long with the best so far, and its status; the tracks are made after it.",
        default=None,
        metavar="SECONDS",
        flag="time",
        least=0.0,
    )


@options
class Gated(Replacing):
    """What commands take whose figures may have limits."""

    fail_above: Mapping[str, float] | None = _limits("above", "ospa.mean=0.8")
    fail_below: Mapping[str, float] | None = _limits("below", "completeness.mean=0.9")


@options
class EvaluateOptions(Gated, ScoreOptions):
    """Options of `evaluate`, for one run and for a folder of runs."""

    log_path: Path | str | None = option(
        "Detection log, for the objects that are seen.",
        default=None,
        metavar="FILE",
        flag="log",
        use="objects that are seen",
    )
    cameras_path: Path | str | None = option(
        "Cameras (YAML): the clocks of the log, the cameras in the plots; default: those of the tracks.",
        default=None,
        metavar="FILE",
        flag="cameras",
        use="a log, or plots",
    )
    plots: bool | None = option(
        "Make plots (needs the extra 'plot'); default: if it is installed.", default=None, use="an output folder"
    )
    jobs: int = _jobs("Processes; the results do not depend on it.", FOLDERS)
    dask: str | None = _dask("Score the runs on a Dask cluster, such as tcp://host:8786.", FOLDERS)


@options
class EvaluateCamerasOptions(Gated):
    """Options of `evaluate_calibration`."""

    fail_above: Mapping[str, float] | None = _limits("above", "joint.rotation_deg=0.1")
    fail_below: Mapping[str, float] | None = _limits("below", "joint.scale_ratio=0.99")
    reference: str | None = option(
        "Camera that fixes the frame; default: that of the posterior, else the first whose poses agree.",
        default=None,
        metavar="NAME",
    )


@options
class AlignOptions(Replacing):
    """Options of `align`."""

    tracks_path: Path | str | None = option(
        "Tracks of these cameras; default: tracks.parquet beside them.", default=None, metavar="FILE", flag="tracks"
    )
    forward: str | None = option(
        "Camera whose foot or centre is the origin, and whose view is forward, of a floor or gravity; default: the "
        "first.",
        default=None,
        metavar="NAME",
    )
    same_scale: bool = option("The control track has the scale of the cameras.", default=False)
    same_clock: bool = option("The control track has the clock of the cameras.", default=False)


@options
class SimulateOptions(Replacing):
    """Options of `simulate`."""

    force_size: bool = option("Run even if that fills much of the disk.", default=False, flag="ignore-size-limit")
    runs: int | None = option("Make N runs, in folders run-0000 and so on.", default=None, metavar="N", least=1)
    jobs: int = _jobs("Processes for several runs.", "several runs")


@options
class ExperimentOptions(Replacing):
    """Options of `experiment`."""

    jobs: int = _jobs("Processes; the results do not depend on it.", "without a cluster")
    dask: str | None = _dask("Do the runs on a Dask cluster, such as tcp://host:8786.")
    resume: bool = option("Continue an interrupted experiment.", default=False)


@options
class InitOptions(Replacing):
    """Options of `init`."""

    length_unit: Literal["mm", "cm", "m", "km"] | None = option(
        "Unit of length; default: that of the cameras, else m.", default=None
    )
    kind: Literal["animals", "drones", "lab"] | None = option(
        "Kind of the objects, for values that the log does not show; default lab.", default=None, flag="preset"
    )


@options
class ReportOptions(Replacing):
    """Options of `report`."""

    logs: list[Path] | None = option("Detection log elsewhere (repeatable).", default=None, metavar="FILE", flag="log")
    truths: list[Path] | None = option("Truth elsewhere (repeatable).", default=None, metavar="FILE", flag="truth")
    title: str = option("Title of the page.", default="stereophd report", metavar="TEXT")


#: Command -> the class of its options.
OPTIONS: Mapping[str, type] = {
    "align": AlignOptions,
    "calibrate": CalibrateOptions,
    "evaluate": EvaluateOptions,
    "evaluate-cameras": EvaluateCamerasOptions,
    "experiment": ExperimentOptions,
    "export": ExportOptions,
    "import": ImportOptions,
    "init": InitOptions,
    "report": ReportOptions,
    "simulate": SimulateOptions,
    "track": TrackOptions,
}
