"""``stereophd import``, ``init`` and ``check``: a recording, its configuration, and whether they fit."""

import shlex
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from stereophd import options as declared
from stereophd.cli.options import ConfigWords, Form, Out, Session, Set, Strict, argument, option
from stereophd.cli.terminal import again, exit_if_strict, load, print_report, progress_bar
from stereophd.cli.unused_options import refuse
from stereophd.commands.options import InitOptions, Replacing
from stereophd.io.interchange.options import ImportOptions
from stereophd.wording import counted, instant, span

Sources = Annotated[list[Path], argument("SOURCE", "Files or folders of that format.")]
SourceCameras = Annotated[
    Path | None, option("--cameras", "FILE", "Cameras, native or foreign, if the source has none.")
]
Folder = Annotated[Path, argument("DIR", "Folder of the new config.yaml; created if missing.")]
ShownLog = Annotated[Path | None, option("--log", "FILE", "Detection log to estimate values from.")]
LogCameras = Annotated[
    Path | None, option("--cameras", "FILE", "Cameras, of any program; default: cameras.yaml in the log's folder.")
]
Log = Annotated[Path, argument("LOG", "Detection log (Parquet).")]

MARKS = {"ok": "ok", "warning": "WARNING", "not checked": "not checked"}


@declared.options
class StatedDetector:
    """The detector of all cameras of a source, as the command line states it."""

    sigma_px: float | None = declared.option(
        "Noise of detections; default: estimated, or as in native --cameras.", default=None, metavar="PX"
    )
    p_detect: float = declared.option("With --sigma-px: detection probability.", default=0.9, metavar="P")
    clutter: float = declared.option(
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
    replacing: Replacing, cameras: SourceCameras = None,
) -> None:  # fmt: skip
    """Convert files of another program to detections.parquet, cameras.yaml and report.json."""
    if detector.sigma_px is None:
        refuse(session, ("p_detect", "clutter"), "with --sigma-px PX, found none: the detectors are estimated")
    from stereophd.commands.importing import import_recording

    stated = replace(stated, detector=detector.values)
    report = import_recording(form, sources, out, stated, cameras, replacing.force)
    print_report(session, report, lambda: _imported(report, out))


def _imported(report: dict[str, Any], out: Path) -> list[str]:
    """Return the summary of an import as text."""
    lines = [f"assumed: {sentence}" for sentence in report["assumed"]]
    for name, row in report["cameras"].items():
        size = " x ".join(map(str, row["image_size_px"])) + " px" if "image_size_px" in row else "no camera"
        if "frames" not in row:
            lines.append(f"{name}: {size}")
            continue
        rate = f"{row['rate_hz']:.6g} Hz" if row["rate_hz"] else "no rate"
        lines.append(
            f"{name}: {row['detections']} detections in {row['frames']} frames ({row['empty_frames']} empty, "
            f"{row['filled_frames']} of them filled in), {instant(row['first_s'])} to {instant(row['last_s'])} s, "
            f"{rate}, {size}"
        )
    if (between := report["distances"]) is not None:
        distances = span(between["nearest"], between["farthest"])
        lines.append(f"distances between cameras: {distances} {report['length_unit']}")
    files = [name for name in ("detections.parquet", "cameras.yaml", "truth.parquet") if (out / name).exists()]
    return [*lines, f"Written to {out}: {', '.join(files)}, report.json"]


def init_command(
    session: Session, folder: Folder, options: InitOptions, log: ShownLog = None, cameras: LogCameras = None,
    overrides: Set = None, strict: Strict = False,
) -> None:  # fmt: skip
    """Write a commented configuration, with values estimated from a log and cameras as far as these show them."""
    if log is None:
        refuse(session, ("strict",), "with --log FILE, which is checked, found none")
    from stereophd.commands.init import init

    with progress_bar(session, "init"):
        report = init(folder, log, cameras, overrides or (), options=options)
    print_report(session, report, lambda: _written(session, report, log))
    exit_if_strict(strict, report)


def _written(session: Session, report: dict[str, Any], log: Path | None) -> list[str]:
    """Return the values with their sources, and what to run next."""
    width = max(len(row["key"]) for row in report["values"])
    lines = [f"{row['key']:<{width}}  {_shown(row['value']):<18}  {row['source']}" for row in report["values"]]
    lines += _detectors(report["detectors"])
    config = Path(report["config"])
    if report["must_be_corrected"]:
        return [*lines, f"Written: {config}; next, once what the warnings name is corrected:", f"  {again(session)}"]
    # beside the configuration and quoted, so that the line can be copied as it is
    command, options, out = "track", ["--smooth", "--associations"], "tracks"
    then = ":" if report["cameras"] else ", once the cameras are known:"
    if report["must_be_calibrated"]:
        command, options, out = "calibrate", [], "calibrated"
        then = ", and `init` again with the cameras that it finds:"
    words = ["stereophd", command, str(config), str(log or "LOG"), *options, "--out", str(config.parent / out)]
    following = shlex.join(words)
    return [*lines, f"Written: {config}; next{then}", f"  {following}"]


def _detectors(detectors: dict[str, dict[str, Any]]) -> list[str]:
    """Return the detector of each camera, with its source; a source that several share is one line of its own."""
    sources = Counter(detector["source"] for detector in detectors.values())
    lines = []
    for name, detector in detectors.items():
        noise, source = " x ".join(f"{sigma:g}" for sigma in detector["sigma_px"]), detector["source"]
        lines.append(
            f"{name}: noise {noise} px, probability of detection {detector['p_detect']:g}, "
            f"{detector['clutter_per_frame']:g} false detections per frame"
            f"{f'  {source}' if sources[source] == 1 else ''}"
        )
    shared = {source: [name for name, one in detectors.items() if one["source"] == source] for source in sources}
    return [*lines, *(f"{', '.join(names)}: {source}" for source, names in shared.items() if len(names) > 1)]


def _shown(value: Any) -> str:
    if isinstance(value, list) and len(value) == 2:
        return f"{value[0]:g} to {value[1]:g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(part)}" for key, part in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)


def check_command(session: Session, words: ConfigWords, log: Log, strict: Strict = False) -> None:
    """Check whether a log fits the cameras and the settings; name likely causes and remedies."""
    loaded = load(words)
    from stereophd.commands.check import check

    report = check(loaded, log)
    print_report(session, report, lambda: _findings(report["checks"]))
    exit_if_strict(strict, report)


def _findings(checks: list[dict[str, Any]]) -> list[str]:
    """Return one or two lines a finding, warnings last, where they are seen."""
    lines = []
    for one in sorted(checks, key=lambda found: found["status"] == "warning"):
        lines.append(f"{MARKS[one['status']]:>11}  {one['name']}: {one['message']}")
        if one["remedy"] and one["status"] == "warning":
            lines.append(f"{'':>11}  remedy: {one['remedy']}")
    count = sum(one["status"] == "warning" for one in checks)
    return [*lines, f"{counted(len(checks), 'check')}, {counted(count, 'warning')}"]
