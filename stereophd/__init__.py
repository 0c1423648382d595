"""stereophd: 3-D tracks from the detection logs of several cameras.

The names below are the public interface; the page "Python" of the documentation shows how to use them. Each is imported
when it is first used, so that ``import stereophd`` takes almost no time. Modules and names that are not listed here are
private: they may change without notice.
"""

from __future__ import annotations

import os

__version__ = "0.1.0"

# One target of compiled code for every x86 processor with AVX2 (since 2013): numba, OpenBLAS and NumPy read theirs when
# they are first imported. Other architectures have one set of instructions that all their processors share.
if os.environ.get("STEREOPHD_TARGET") == "portable":
    if not hasattr(os, "uname") or os.uname().machine == "x86_64":
        if os.environ.setdefault("NUMBA_CPU_NAME", "haswell") == "haswell":
            os.environ.setdefault("NUMBA_CPU_FEATURES", "")  # those of the name, not of this processor
        os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
        os.environ.setdefault("NPY_DISABLE_CPU_FEATURES", "X86_V4 AVX512F AVX512CD AVX512_SKX AVX512_ICL AVX512_SPR")
    else:
        os.environ.setdefault("NUMBA_CPU_NAME", "generic")

# As in `typing`, whose import would cost more than all the rest.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from stereophd.commands.calibrate import calibrate
    from stereophd.commands.calibrate_logs import calibrate_logs
    from stereophd.commands.check import check
    from stereophd.commands.evaluate import evaluate
    from stereophd.commands.evaluate_cameras import evaluate_calibration
    from stereophd.commands.evaluate_runs import evaluate_runs
    from stereophd.commands.experiment import experiment
    from stereophd.commands.init import init
    from stereophd.commands.simulate import simulate
    from stereophd.commands.track import track
    from stereophd.commands.track_logs import track_logs
    from stereophd.config.loading import LoadedConfig, load_config, make_config
    from stereophd.core.disparity.events import make_event
    from stereophd.core.geometry.camera import Camera, Clock, Detector
    from stereophd.core.geometry.lens import Lens
    from stereophd.core.geometry.pose import Pose
    from stereophd.errors import GateError, InputError, StereophdError
    from stereophd.io.logs.reading import Frame
    from stereophd.pipeline.array_filters import make_filter, run_filter
    from stereophd.pipeline.files import read_cameras, read_log, write_cameras, write_log
    from stereophd.pipeline.tracking.loop import Record

# Public name -> module that holds it.
_HOMES = {
    "Camera": "core.geometry.camera",
    "Clock": "core.geometry.camera",
    "Detector": "core.geometry.camera",
    "Frame": "io.logs.reading",
    "GateError": "errors",
    "InputError": "errors",
    "Lens": "core.geometry.lens",
    "LoadedConfig": "config.loading",
    "Pose": "core.geometry.pose",
    "Record": "pipeline.tracking.loop",
    "StereophdError": "errors",
    "calibrate": "commands.calibrate",
    "calibrate_logs": "commands.calibrate_logs",
    "check": "commands.check",
    "init": "commands.init",
    "evaluate": "commands.evaluate",
    "evaluate_calibration": "commands.evaluate_cameras",
    "evaluate_runs": "commands.evaluate_runs",
    "experiment": "commands.experiment",
    "load_config": "config.loading",
    "make_config": "config.loading",
    "make_event": "core.disparity.events",
    "make_filter": "pipeline.array_filters",
    "read_cameras": "pipeline.files",
    "read_log": "pipeline.files",
    "run_filter": "pipeline.array_filters",
    "simulate": "commands.simulate",
    "track": "commands.track",
    "track_logs": "commands.track_logs",
    "write_cameras": "pipeline.files",
    "write_log": "pipeline.files",
}

__all__ = [
    "Camera",
    "Clock",
    "Detector",
    "Frame",
    "GateError",
    "InputError",
    "Lens",
    "LoadedConfig",
    "Pose",
    "Record",
    "StereophdError",
    "__version__",
    "calibrate",
    "calibrate_logs",
    "check",
    "evaluate",
    "evaluate_calibration",
    "evaluate_runs",
    "experiment",
    "init",
    "load_config",
    "make_config",
    "make_event",
    "make_filter",
    "read_cameras",
    "read_log",
    "run_filter",
    "simulate",
    "track",
    "track_logs",
    "write_cameras",
    "write_log",
]


if not TYPE_CHECKING:  # type checkers report names that do not exist

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first used."""
        if name not in _HOMES:
            raise AttributeError(f"module 'stereophd' has no attribute {name!r}")
        from importlib import import_module

        value = getattr(import_module(f"stereophd.{_HOMES[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Return the public names."""
    return list(__all__)
