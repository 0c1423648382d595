"""``stereophd import``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import typer

from stereophd.cli import import_options as of
from stereophd.cli import options
from stereophd.cli.flags import with_flags
from stereophd.cli.terminal import print_report
from stereophd.cli.unused_options import refuse

Value = TypeVar("Value")


def import_command(
    session: options.Session,
    form: of.Form,
    sources: of.Sources,
    out: options.Out,
    cameras: of.Cameras = None,
    truth: of.Truth = None,
    columns: of.Columns = None,
    fps: of.Fps = None,
    offset: of.Offset = None,
    frames: of.Frames = None,
    image_size: of.ImageSize = None,
    rename: of.Rename = None,
    length_unit: of.LengthUnit = None,
    time_unit: of.TimeUnit = "s",
    pixel_origin: of.PixelOrigin = None,
    rows_from: of.RowsFrom = None,
    fill: of.Fill = True,
    box_point: of.BoxPoint = "center",
    least_score: of.LeastScore = None,
    undistorted: of.Undistorted = False,
    sigma_px: of.SigmaPx = None,
    p_detect: of.PDetect = 0.9,
    clutter: of.Clutter = 1.0,
    force: options.Force = False,
) -> None:
    """Convert files of another program to detections.parquet, cameras.yaml and report.json."""
    if sigma_px is None:
        refuse(session, ("p_detect", "clutter"), "with --sigma-px PX, found none: the detectors are estimated")
    from stereophd.commands.importing import import_recording
    from stereophd.io.interchange.base import ImportOptions

    detector = None
    if sigma_px is not None:
        detector = {"sigma_px": (sigma_px, sigma_px), "p_detect": p_detect, "clutter_per_frame": clutter}
    stated = ImportOptions(
        columns=_pairs("--column", columns),
        rates=_per_camera("--fps", fps, _number),
        offsets=_per_camera("--offset", offset, _number),
        frames=_per_camera("--recorded-frames", frames, _range),
        image_sizes=_per_camera("--image-size", image_size, _size),
        rename=_pairs("--rename", rename),
        length_unit=_choice("--length-unit", length_unit, ("mm", "cm", "m", "km")),
        time_unit=_choice("--time-unit", time_unit, ("s", "ms", "us", "ns")) or "s",
        pixel_origin=_choice("--pixel-origin", pixel_origin, ("center", "corner", "one")),
        rows_from=_choice("--rows-from", rows_from, ("top", "bottom")),
        fill=fill,
        box_point=_choice("--box-point", box_point, ("center", "bottom")) or "center",
        least_score=least_score,
        undistorted=undistorted,
        truth=truth,
        detector=detector,
    )
    report = import_recording(form, sources, out, stated, cameras, force)
    print_report(session, report, lambda: _lines(report, out))


def _lines(report: dict[str, Any], out: Path) -> list[str]:
    """Return the summary of an import as text."""
    lines = [with_flags(f"assumed: {sentence}") for sentence in report["assumed"]]
    for name, row in report["cameras"].items():
        size = " x ".join(map(str, row["image_size_px"])) + " px" if "image_size_px" in row else "no camera"
        if "frames" not in row:
            lines.append(f"{name}: {size}")
            continue
        rate = f"{row['rate_hz']:.6g} Hz" if row["rate_hz"] else "no rate"
        first, last = (f"{row[key]:.{_digits(row['first_s'], row['last_s'])}g}" for key in ("first_s", "last_s"))
        lines.append(
            f"{name}: {row['detections']} detections in {row['frames']} frames ({row['empty_frames']} empty, "
            f"{row['filled_frames']} of them filled in), {first} to {last} s, {rate}, {size}"
        )
    files = [name for name in ("detections.parquet", "cameras.yaml", "truth.parquet") if (out / name).exists()]
    return [*lines, f"Written to {out}: {', '.join(files)}, report.json"]


def _digits(first: float, last: float) -> int:
    """Return how many digits show six of the time between two, such as stamps since 1970."""
    return 6 + max(0, int(math.log10(max(abs(last), 1.0) / max(last - first, 1e-3))))


def _pairs(option: str, words: Sequence[str] | None) -> dict[str, str]:
    result = {}
    for word in words or ():
        name, separator, value = word.partition("=")
        if not separator or not name or not value:
            raise typer.BadParameter(f"{option}: expected NAME=VALUE, found {word}")
        result[name] = value
    return result


def _per_camera(option: str, words: Sequence[str] | None, parse: Callable[[str], Value]) -> Any:
    """Return the values of an option that may be stated for each camera (CAM=VALUE) or for all (VALUE)."""
    from stereophd.io.interchange.base import PerCamera

    named: dict[str, Value] = {}
    other: Value | None = None
    for word in words or ():
        name, separator, text = word.rpartition("=")
        try:
            value = parse(text)
        except ValueError:
            raise typer.BadParameter(f"{option}: expected [CAM=]VALUE, found {word}") from None
        if separator:
            named[name] = value
        else:
            other = value
    return PerCamera(named, other)


def _number(text: str) -> float:
    """Return a number, also a fraction such as 30000/1001."""
    above, separator, below = text.partition("/")
    value = float(above) / float(below) if separator and float(below) else float(above)
    if value != value or value in (float("inf"), float("-inf")):
        raise ValueError(text)
    return value


def _range(text: str) -> tuple[int, int]:
    first, last = map(int, text.split(":"))
    return first, last


def _size(text: str) -> tuple[int, int]:
    width, height = map(int, text.lower().split("x"))
    if width <= 0 or height <= 0:
        raise ValueError(text)
    return width, height


def _choice(option: str, value: str | None, known: Sequence[str]) -> str | None:
    if value is not None and value not in known:
        raise typer.BadParameter(f"{option}: expected one of {', '.join(known)}, found {value}")
    return value
