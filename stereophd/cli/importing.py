"""``stereophd import``."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from stereophd import options
from stereophd.cli.options import Form, Out, Session, argument, option
from stereophd.cli.terminal import print_report
from stereophd.cli.unused_options import refuse
from stereophd.commands.options import Replacing
from stereophd.io.interchange.options import ImportOptions

Sources = Annotated[list[Path], argument("SOURCE", "Files or folders of that format.")]
Cameras = Annotated[Path | None, option("--cameras", "FILE", "Cameras, native or foreign, if the source has none.")]


@options.options
class StatedDetector:
    """The detector of all cameras of a source, as the command line states it."""

    sigma_px: float | None = options.option("Noise of the detections; default: estimated.", default=None, metavar="PX")
    p_detect: float = options.option("With --sigma-px: detection probability.", default=0.9, metavar="P")
    clutter: float = options.option(
        "With --sigma-px: mean number of false detections per frame.", default=1.0, metavar="N",
    )  # fmt: skip

    @property
    def values(self) -> dict[str, Any] | None:
        """The detector as `ImportOptions` take it; None: it is estimated."""
        if self.sigma_px is None:
            return None
        noise = (self.sigma_px, self.sigma_px)
        return {"sigma_px": noise, "p_detect": self.p_detect, "clutter_per_frame": self.clutter}


def import_command(
    session: Session, form: Form, sources: Sources, out: Out, stated: ImportOptions, detector: StatedDetector,
    replacing: Replacing, cameras: Cameras = None,
) -> None:  # fmt: skip
    """Convert files of another program to detections.parquet, cameras.yaml and report.json."""
    if detector.sigma_px is None:
        refuse(session, ("p_detect", "clutter"), "with --sigma-px PX, found none: the detectors are estimated")
    from stereophd.commands.importing import import_recording

    stated = replace(stated, detector=detector.values)
    report = import_recording(form, sources, out, stated, cameras, replacing.force)
    print_report(session, report, lambda: _lines(report, out))


def _lines(report: dict[str, Any], out: Path) -> list[str]:
    """Return the summary of an import as text."""
    lines = [f"assumed: {sentence}" for sentence in report["assumed"]]
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
    if (between := report["distances"]) is not None:
        near, far = f"{between['nearest']:.4g}", f"{between['farthest']:.4g}"
        lines.append(f"distances between cameras: {near} to {far} {report['length_unit']}")
    files = [name for name in ("detections.parquet", "cameras.yaml", "truth.parquet") if (out / name).exists()]
    return [*lines, f"Written to {out}: {', '.join(files)}, report.json"]


def _digits(first: float, last: float) -> int:
    """Return how many digits show six of the time between two, such as stamps since 1970."""
    return 6 + max(0, int(math.log10(max(abs(last), 1.0) / max(last - first, 1e-3))))
