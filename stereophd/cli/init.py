"""``stereophd init``."""

import shlex
from pathlib import Path
from typing import Annotated, Any

from stereophd.cli.options import Session, Set, Strict, argument, option
from stereophd.cli.terminal import exit_if_strict, print_report
from stereophd.cli.unused_options import refuse
from stereophd.commands.options import InitOptions

Folder = Annotated[Path, argument("DIR", "Folder of the new config.yaml; created if missing.")]
Log = Annotated[Path | None, option("--log", "FILE", "Detection log to estimate values from.")]
Cameras = Annotated[
    Path | None, option("--cameras", "FILE", "Cameras, of any program; default: cameras.yaml in the log's folder.")
]


def init_command(
    session: Session, folder: Folder, options: InitOptions, log: Log = None, cameras: Cameras = None,
    overrides: Set = None, strict: Strict = False,
) -> None:  # fmt: skip
    """Write a commented configuration, with values estimated from a log and cameras as far as these show them."""
    if log is None:
        refuse(session, ("strict",), "with --log FILE, which is checked, found none")
    from stereophd.commands.init import init

    report = init(folder, log, cameras, overrides or (), options=options)
    print_report(session, report, lambda: _lines(report, log))
    exit_if_strict(strict, report)


def _lines(report: dict[str, Any], log: Path | None) -> list[str]:
    """Return the values with their sources, and what to run next."""
    width = max(len(row["key"]) for row in report["values"])
    lines = [f"{row['key']:<{width}}  {_shown(row['value']):<18}  {row['source']}" for row in report["values"]]
    lines += [_detector(name, detector) for name, detector in report["detectors"].items()]
    config = Path(report["config"])
    # beside the configuration and quoted, so that the line can be copied as it is
    command, options, out = "track", ["--smooth", "--associations"], "tracks"
    if report["must_be_calibrated"]:
        command, options, out = "calibrate", [], "calibrated"
    words = ["stereophd", command, str(config), str(log or "LOG"), *options, "--out", str(config.parent / out)]
    following = shlex.join(words)
    return [*lines, f"Written: {config}; next:", f"  {following}"]


def _detector(name: str, detector: dict[str, Any]) -> str:
    noise = " x ".join(f"{sigma:g}" for sigma in detector["sigma_px"])
    return (
        f"{name}: noise {noise} px, probability of detection {detector['p_detect']:g}, "
        f"{detector['clutter_per_frame']:g} false detections per frame  {detector['source']}"
    )


def _shown(value: Any) -> str:
    if isinstance(value, list) and len(value) == 2:
        return f"{value[0]:g} to {value[1]:g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(part)}" for key, part in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)
