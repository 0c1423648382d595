"""Options of the commands, each declared once; see `stereophd.options`.

Nothing heavy may be imported here: the command line makes its help from these classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from stereophd.options import numbers_by_key, option, options
from stereophd.pipeline.evaluation.options import ScoreOptions

# The use of `evaluate` with many runs.
FOLDERS = "folders of runs"


@options
class Replacing:
    """What every command that writes takes."""

    force: bool = option("Replace the outputs of an earlier run.", default=False)


@options
class TrackOptions(Replacing):
    """Options of `track`, for one log and for several."""

    jobs: int = option(
        "Processes for several logs, or for the pieces of one; the results do not depend on it.",
        default=1,
        metavar="N",
        least=1,
        use="several logs, or pieces of one",
    )
    dask: str | None = option(
        "Track the logs or pieces on a Dask cluster, such as tcp://host:8786.",
        default=None,
        metavar="ADDRESS",
        use="several logs, or pieces of one",
    )
    threads: int = option(
        "Threads; the outputs do not depend on it.",
        default=1,
        metavar="N",
        least=1,
        use="filters of several objects",
    )
    pieces_s: float | None = option(
        "Cut the log into pieces of this length, track them independently, and join their tracks. The last piece is "
        "shorter, or longer by up to the overlap.",
        default=None,
        metavar="SECONDS",
        flag="pieces",
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
        "Track a recording that is still running: a growing file of JSON lines or Arrow IPC, or a folder of Parquet "
        "parts.",
        default=None,
        metavar="LOG",
    )
    listen: str | None = option(
        "Track frames that arrive at a ZeroMQ address, such as tcp://127.0.0.1:5555 (needs the extra 'live').",
        default=None,
        metavar="ADDRESS",
    )
    record: Path | None = option(
        "Keep the frames of a running recording as JSON lines while they arrive.",
        default=None,
        metavar="FILE",
    )


@options
class CalibrateOptions(Replacing):
    """Options of `calibrate`, for one log and for several."""

    jobs: int = option(
        "Processes (threads, of particles); the results do not depend on it. -1: all cores.",
        default=-1,
        metavar="N",
        use="without a cluster",
    )
    dask: str | None = option(
        "Calibrate several logs on a Dask cluster.", default=None, metavar="ADDRESS", use="several logs"
    )
    resume: bool = option("Continue an interrupted run from what it has kept (DIR/partial-HASH).", default=False)
    plots: bool | None = option("Make plots (needs the extra 'plot'); default: if it is installed.", default=None)
    require: Literal["determined", "partly"] | None = option(
        "Exit with 1 if the data determine the cameras less than this.", default=None, flag="require-status"
    )


@options
class Gated(Replacing):
    """What commands take whose figures may have limits."""

    fail_above: Mapping[str, float] | None = option(
        "Exit with 1 if a figure is above a limit, such as ospa.mean=0.8 (repeatable).",
        default=None,
        metavar="KEY=VALUE",
        parse=numbers_by_key,
    )
    fail_below: Mapping[str, float] | None = option(
        "Exit with 1 if a figure is below a limit, such as completeness.mean=0.9 (repeatable).",
        default=None,
        metavar="KEY=VALUE",
        parse=numbers_by_key,
    )


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
    jobs: int = option("Processes; the results do not depend on it.", default=1, metavar="N", least=1, use=FOLDERS)
    dask: str | None = option(
        "Score the runs on a Dask cluster, such as tcp://host:8786.",
        default=None,
        metavar="ADDRESS",
        use=FOLDERS,
    )


@options
class EvaluateCamerasOptions(Gated):
    """Options of `evaluate_calibration`."""

    reference: str | None = option(
        "Camera that fixes the frame; default: that of the posterior, else the first whose poses agree.",
        default=None,
        metavar="NAME",
    )


@options
class SimulateOptions(Replacing):
    """Options of `simulate`."""

    force_size: bool = option("Run even if that fills much of the disk.", default=False, flag="ignore-size-limit")
    runs: int | None = option("Make N runs, in folders run-0000, ...", default=None, metavar="N", least=1)
    jobs: int = option("Processes for several runs.", default=1, metavar="N", least=1, use="several runs")


@options
class ExperimentOptions(Replacing):
    """Options of `experiment`."""

    jobs: int = option(
        "Processes; the results do not depend on it.", default=1, metavar="N", least=1, use="without a cluster"
    )
    dask: str | None = option(
        "Do the runs on a Dask cluster, such as tcp://host:8786.", default=None, metavar="ADDRESS"
    )
    resume: bool = option("Continue an interrupted experiment.", default=False)


#: Command -> the class of its options.
OPTIONS: Mapping[str, type] = {
    "calibrate": CalibrateOptions,
    "evaluate": EvaluateOptions,
    "evaluate-cameras": EvaluateCamerasOptions,
    "experiment": ExperimentOptions,
    "simulate": SimulateOptions,
    "track": TrackOptions,
}
