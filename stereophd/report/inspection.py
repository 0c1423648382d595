"""The findings of `stereophd.commands.info` as text."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from stereophd.report.tables import aligned
from stereophd.wording import counted, instant, span

# Lengths of this part of the largest are round-off.
ROUND_OFF = 1e-9
# Tracks and files listed one by one.
ROWS_SHOWN = 12
# Kinds of files that `info` names after the tables, in this order; pictures are counted in one line at the end.
AFTER_TABLES = ("report", "cameras", "configuration", "folder", "other")
#: Counts of a camera of a log: title, key, and digits of what is no whole number (None: a time).
COUNTS = (
    ("frames", "frames", 0), ("empty", "empty_frames", 0), ("detections", "detections", 0),
    ("per frame", "detections_per_frame", 3), ("most", "most_detections_in_a_frame", 0), ("rate Hz", "rate_hz", 5),
    ("gaps", "gaps", 0), ("longest s", "longest_interval_s", 3), ("first s", "first_s", None),
    ("last s", "last_s", None),
)  # fmt: skip
PICTURES = (".jpeg", ".jpg", ".pdf", ".png", ".svg")


def info_text(summary: Mapping[str, Any]) -> str:
    """Return the text of what a file or folder holds."""
    lines = [f"{summary['path']}: {summary['kind']}", *_origin(summary.get("origin"))]
    describe: dict[str, Callable[[Mapping[str, Any]], Iterator[str]]] = {
        "detections": _log,
        "tracks": _objects,
        "truth": _objects,
        "cameras": _cameras,
        "configuration": _configuration,
        "report": _report,
        "folder": _folder,
    }
    return "\n".join([*lines, *describe.get(summary["kind"], _table)(summary)])


def _origin(origin: Mapping[str, Any] | None) -> Iterator[str]:
    if origin is None:
        return
    seed = "" if origin["seed"] is None else f", seed {origin['seed']}"
    yield f"made by stereophd {origin['version']} {origin['command']}{seed}, config {origin['config_sha256'][:12]}"
    for role, digest in (origin.get("inputs") or {}).items():
        yield f"  from {role} {digest[:12]}"


def _log(found: Mapping[str, Any]) -> Iterator[str]:
    yield (
        f"{counted(found['rows'], 'row')}, {instant(found['first_s'])} to {instant(found['last_s'])} s, all cameras at "
        f"once for {found['overlap_s']:.6g} s"
    )
    yield f"columns: {', '.join(found['columns'])}"
    cells = ((name, *(_shown(c[key], digits) for _, key, digits in COUNTS)) for name, c in found["cameras"].items())
    yield from aligned([("camera", *(title for title, _, _ in COUNTS)), *cells])
    if found["times_backwards"]:
        yield f"times go backwards in {found['times_backwards']} places: rows are not in order of time"
    for name, c in found["cameras"].items():
        if c["missing_frame_numbers"]:
            missing, first, last = c["missing_frame_numbers"], c["first_frame"], c["last_frame"]
            yield f"{name}: {missing} frame numbers between {first} and {last} are missing"
        if c["frames_backwards"]:
            yield f"{name}: frame numbers go backwards in {c['frames_backwards']} places"


def _objects(found: Mapping[str, Any]) -> Iterator[str]:
    unit = f" {found['length_unit']}" if found["length_unit"] else ""
    what = "track" if found["kind"] == "tracks" else "object"
    yield f"{counted(found['objects'], what)}, {counted(found['rows'], 'row')}"
    if not found["objects"]:
        return
    duration = found["duration_s"]
    yield (
        f"{instant(found['first_s'])} to {instant(found['last_s'])} s; {what}s last {duration['shortest']:.4g} to "
        f"{duration['longest']:.4g} s, median {duration['median']:.4g} s"
    )
    spans = zip("xyz", found["lowest"], found["highest"], strict=True)
    extents = (f"{axis} {low:.4g} to {high:.4g}{unit}" for axis, low, high in spans)
    yield ", ".join(extents) + ("" if unit else "; the file states no unit of length")
    if "mean_existence" in found:
        yield f"mean existence {found['mean_existence']:.3f}"
    rows = [("id", "first s", "last s", "rows")]
    shown = found["rows_by_object"][:ROWS_SHOWN]
    rows += [(str(r["id"]), instant(r["first_s"]), instant(r["last_s"]), str(r["rows"])) for r in shown]
    yield from aligned(rows)
    if found["objects"] > len(shown):
        yield f"... and {found['objects'] - len(shown)} shorter ones"


def _cameras(found: Mapping[str, Any]) -> Iterator[str]:
    yield from (f"{sentence}" for sentence in found.get("assumed", ()))
    unit = found["length_unit"]
    rows = [
        ("camera", "image px", "focal px", "view deg", "lens", f"center {unit}", "looks along", "rate Hz", "detector")
    ]
    for name, c in found["cameras"].items():
        detector = "estimated" if c["detector_is_estimated"] else ""
        noise = " x ".join(f"{s:g}" for s in dict.fromkeys(c["sigma_px"]))
        rows.append(
            (
                name,
                "x".join(map(str, c["image_size_px"])),
                f"{c['focal_px'][0]:.5g}",
                "x".join(f"{a:.0f}" for a in c["field_of_view_deg"]),
                c["lens"],
                _vector(c["center"], 4),
                _vector(c["looks_along"], 2),
                _shown(c["frame_rate_hz"], 5),
                detector or f"{noise} px, pD {c['p_detect']:g}, clutter {c['clutter_per_frame']:g}",
            )
        )
    yield from aligned(rows)
    if found["distances"] is not None:
        yield f"distances between cameras: {span(found['distances']['nearest'], found['distances']['farthest'])} {unit}"
    if found["axes_meet_near"] is not None:
        centers = [camera["center"] for camera in found["cameras"].values() if camera["center"] is not None]
        least = ROUND_OFF * max(abs(x) for place in (found["axes_meet_near"], *centers) for x in place)
        *meet, within = (0.0 if abs(x) < least else x for x in (*found["axes_meet_near"], found["axes_distance_rms"]))
        yield f"the optical axes meet near {_vector(meet, 4)}, to within {within:.3g} {unit}"
        if found["axes_meet_behind"]:
            yield f"that point is behind {', '.join(found['axes_meet_behind'])}: do the cameras look apart?"


def _configuration(found: Mapping[str, Any]) -> Iterator[str]:
    yield f"sections: {', '.join(found['sections'])}; seed {found['seed']}, sha256 {found['config_sha256'][:12]}"
    if "cameras" in found:
        yield from _cameras(found)


def _report(found: Mapping[str, Any]) -> Iterator[str]:
    for key, value in found["values"].items():
        yield f"{key}: {value:.6g}" if isinstance(value, float) else f"{key}: {value}"


def _folder(found: Mapping[str, Any]) -> Iterator[str]:
    pictures = [file for file in found["files"] if _is_picture(file)]
    order = {kind: rank for rank, kind in enumerate(AFTER_TABLES, start=1)}  # tables, which are not in it, are first
    files = sorted(
        (file for file in found["files"] if not _is_picture(file)), key=lambda file: order.get(file["kind"], 0)
    )
    if files:
        rows = [("file", "kind", "what")]
        rows += [(Path(file["path"]).name, file["kind"], _brief(file)) for file in files[:ROWS_SHOWN]]
        yield from aligned(rows)
    if len(files) > ROWS_SHOWN:
        yield f"... and {len(files) - ROWS_SHOWN} more"
    if pictures:
        endings = sorted({Path(file["path"]).suffix[1:].lower() for file in pictures})
        yield f"{counted(len(pictures), 'picture')} ({', '.join(endings)})"


def _is_picture(file: Mapping[str, Any]) -> bool:
    return file["kind"] == "other" and Path(file["path"]).suffix.lower() in PICTURES


def _brief(file: Mapping[str, Any]) -> str:
    if file["kind"] in ("cameras", "configuration"):
        return ", ".join(file.get("cameras", ())) or "no cameras"
    if file["kind"] == "detections":
        rows, names = counted(file["rows"], "row"), ", ".join(file["cameras"])
        return f"{rows} of {names}, {instant(file['first_s'])} to {instant(file['last_s'])} s"
    if file["kind"] in ("tracks", "truth"):
        return f"{counted(file['objects'], 'object')}, {counted(file['rows'], 'row')}"
    return counted(file["rows"], "row") if "rows" in file else ""


def _table(found: Mapping[str, Any]) -> Iterator[str]:
    if "rows" in found:
        yield counted(found["rows"], "row")
    if "first_s" in found:
        yield f"{instant(found['first_s'])} to {instant(found['last_s'])} s"
    for name, kind in found.get("columns", {}).items():
        yield f"  {name}  {kind}"


def _shown(value: float | None, digits: int | None) -> str:
    """Return a number with so many digits; 0: a whole number, None: a time."""
    if value is None:
        return "-"
    return instant(value) if digits is None else f"{value:.{digits}g}" if digits else str(value)


def _vector(values: Sequence[float] | None, digits: int) -> str:
    return "unknown" if values is None else "(" + ", ".join(f"{value + 0.0:.{digits}g}" for value in values) + ")"
