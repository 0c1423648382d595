"""Options of ``stereophd import``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli.options import argument, option
from stereophd.site import page

Form = Annotated[str, argument("FORMAT", f"Format, such as csv; all: {page('reference/interchange')}")]
Sources = Annotated[list[Path], argument("SOURCE", "Files or folders of that format.")]
Cameras = Annotated[Path | None, option("--cameras", "FILE", "Cameras, native or foreign, if the source has none.")]
Truth = Annotated[
    Path | None, option("--truth", "FILE", "The program's points in space, of the same format: truth.parquet.")
]
Columns = Annotated[
    list[str] | None,
    option("--column", "NAME=COLUMN", "Read a native column from a column of the table: u_px=x (repeatable)."),
]
Fps = Annotated[list[str] | None, option("--fps", "[CAM=]HZ", "Frame rate: times are frame / rate.")]
Offset = Annotated[list[str] | None, option("--offset", "[CAM=]S", "Seconds to add to the times of a camera.")]
Frames = Annotated[
    list[str] | None, option("--recorded-frames", "[CAM=]FIRST:LAST", "Frames recorded; those without rows are empty.")
]
ImageSize = Annotated[list[str] | None, option("--image-size", "[CAM=]WxH", "Width and height of the images.")]
Rename = Annotated[list[str] | None, option("--rename", "OLD=NEW", "Another name for a camera.")]
LengthUnit = Annotated[str | None, option("--length-unit", "UNIT", "Unit of the cameras: mm, cm, m, km.")]
TimeUnit = Annotated[str, option("--time-unit", "UNIT", "Unit of the times: s, ms, us, ns.")]
PixelOrigin = Annotated[
    str | None,
    option(
        "--pixel-origin",
        "WHERE",
        "Pixel (0, 0) is the center or the corner of the top-left pixel; one: its center is (1, 1).",
    ),
]
RowsFrom = Annotated[str | None, option("--rows-from", "SIDE", "Rows count from the top or bottom.")]
Fill = Annotated[
    bool,
    typer.Option("--fill-missing-frames/--no-fill-missing-frames", help="Missing frame numbers become empty frames."),
]
BoxPoint = Annotated[str, option("--box-point", "POINT", "Point of a box: center or bottom.")]
LeastScore = Annotated[float | None, option("--min-score", "S", "Leave out detections of a lower score.")]
Undistorted = Annotated[bool, typer.Option("--pixels-undistorted", help="The pixels are undistorted already.")]
SigmaPx = Annotated[float | None, option("--sigma-px", "PX", "Noise of the detections; default: estimated.")]
PDetect = Annotated[float, typer.Option("--p-detect", metavar="P", help="With --sigma-px: detection probability.")]
Clutter = Annotated[
    float, typer.Option("--clutter", metavar="N", help="With --sigma-px: mean number of false detections per frame.")
]
