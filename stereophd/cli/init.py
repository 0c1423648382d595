"""``stereophd init``."""

from __future__ import annotations

import shlex
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from stereophd.cli import options
from stereophd.cli.terminal import exit_if_strict, print_report
from stereophd.cli.unused_options import refuse


class ObjectKind(StrEnum):
    """Kind of the objects."""

    ANIMALS = "animals"
    DRONES = "drones"
    LAB = "lab"


class LengthUnit(StrEnum):
    """Units of length."""

    MM = "mm"
    CM = "cm"
    M = "m"
    KM = "km"


def init_command(
    session: options.Session,
    folder: Annotated[Path, options.argument("DIR", "Folder of the new config.yaml; created if missing.")],
    log: Annotated[Path | None, options.option("--log", "FILE", "Detection log to estimate values from.")] = None,
    cameras: Annotated[
        Path | None,
        options.option("--cameras", "FILE", "Cameras, of any program; default: cameras.yaml in the log's folder."),
    ] = None,
    length_unit: Annotated[
        LengthUnit | None,
        typer.Option("--length-unit", help="Unit of length; default: that of the cameras, else m.", show_default=False),
    ] = None,
    kind: Annotated[
        ObjectKind | None,
        typer.Option(
            "--preset",
            help="Kind of the objects, for values that the log does not show; default lab.",
            show_default=False,
        ),
    ] = None,
    overrides: options.Set = None,
    strict: options.Strict = False,
    force: options.Force = False,
) -> None:
    """Write a commented configuration, with values estimated from a log and cameras as far as these show them."""
    if log is None:
        refuse(session, ("strict",), "with --log FILE, which is checked, found none")
    from stereophd.commands.init import init

    report = init(
        folder, log, cameras, None if length_unit is None else length_unit.value, None if kind is None else kind.value,
        force, tuple(overrides or ()),
    )  # fmt: skip
    print_report(session, report, lambda: _lines(report, log))
    exit_if_strict(strict, report)


def _lines(report: dict[str, Any], log: Path | None) -> list[str]:
    """Return the values with their sources, and what to run next."""
    width = max(len(row["key"]) for row in report["values"])
    lines = [f"{row['key']:<{width}}  {_shown(row['value']):<18}  {row['source']}" for row in report["values"]]
    lines += [_detector(name, detector) for name, detector in report["detectors"].items()]
    config = Path(report["config"])
    # beside the configuration and quoted, so that the line can be copied as it is
    following = shlex.join(
        ["stereophd", "track", str(config), str(log or "LOG"), "--out", str(config.parent / "tracks")]
    )
    return [*lines, f"Written: {config}; next:", f"  {following}"]


def _detector(name: str, detector: dict[str, Any]) -> str:
    noise = " x ".join(f"{sigma:g}" for sigma in detector["sigma_px"])
    return (
        f"{name}: noise {noise} px, probability of detection {detector['p_detect']:g}, "
        f"{detector['clutter_per_frame']:g} false detections a frame  {detector['source']}"
    )


def _shown(value: Any) -> str:
    if isinstance(value, list) and len(value) == 2:
        return f"{value[0]:g} to {value[1]:g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(part)}" for key, part in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)
