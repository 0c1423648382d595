"""From raw files of other programs to a page: import, init, check, track, report; what each of them warns of.

    python benchmarks/raw_files.py [--only dltdv ...] [--frames 40]

Three objects on smooth curves before two cameras, with noise of half a pixel, written as DLTdv, caliscope (both
layouts), OpenPTV (through glass and water), DeepLabCut, SLEAP and MOTChallenge write them: by the writers of the tests
of these formats, which follow the programs' documents. Prints a line a format: tracks, estimated noise, CPU seconds and
the causes of the warnings. Exit code 1 if a cause is not one of data that are few, or the tracks are not three.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import common  # noqa: F401  (one thread)

# isort: split
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from stereophd.commands.check import check  # noqa: E402
from stereophd.commands.importing import import_recording  # noqa: E402
from stereophd.commands.init import init  # noqa: E402
from stereophd.commands.report import report  # noqa: E402
from stereophd.commands.track import track  # noqa: E402
from stereophd.config.loading import load_config  # noqa: E402
from stereophd.io.cameras.writing import write_cameras  # noqa: E402
from stereophd.io.interchange.base import ImportOptions, PerCamera  # noqa: E402
from tests.io.formats.conftest import SIZES, rig  # noqa: E402
from tests.io.formats.test_caliscope import write_session  # noqa: E402
from tests.io.formats.test_dltdv import from_below, write_coefficients, write_points  # noqa: E402
from tests.io.formats.test_laboratory import CORNERS, through_glass, write_tank  # noqa: E402

RATE_HZ, NOISE_PX, OBJECTS = 25.0, 0.5, 3
# Causes that say of a short recording that it is short.
FEW = {"too_few_detections", "clutter_unsure", "not_converged"}
# What is true of a format: a pinhole with a lens in place of glass and water errs by 0.05 px, which lasts.
TRUE = {"openptv through glass": {"errors_last"}}
# What imports a folder: its sources, and what the user states.
Written = tuple[list[Path], dict[str, Any], Path | None]


def curves(frames: int, size: float, delay_s: float = 0.0) -> np.ndarray[Any, Any]:
    """Positions (frames, objects, 3) on smooth curves about the origin, within this half size."""
    rng = np.random.default_rng(5)
    phase, turns = rng.uniform(0.0, 6.28, (2, OBJECTS, 3))
    times = np.arange(frames)[:, None, None] / RATE_HZ + delay_s
    return np.asarray(size * np.sin(phase + (0.5 + 0.2 * turns) * times))


def noisy(pixels: np.ndarray[Any, Any], camera: int = 0) -> np.ndarray[Any, Any]:
    """Pixels with noise, of its own for each camera."""
    return pixels + NOISE_PX * np.random.default_rng([6, camera]).standard_normal(pixels.shape)


def seen(frames: int, delay_s: float = 0.0) -> dict[str, np.ndarray[Any, Any]]:
    """Pixels (frames, objects, 2) of the rig of the tests, by camera; the second camera is later by a delay."""
    found = {}
    for k, (name, config) in enumerate(rig().items()):
        pixels = config.build(name).project(curves(frames, 0.25, k * delay_s).reshape(-1, 3))
        found[name] = noisy(pixels.reshape(frames, OBJECTS, 2), k)
    return found


def dltdv(folder: Path, frames: int) -> Written:
    """Digitised points and coefficients."""
    cameras = [config.build(name) for name, config in rig(lens=(0.0,)).items()]
    points = curves(frames, 0.25)
    images = [np.concatenate([points, np.ones((frames, OBJECTS, 1))], axis=2) @ from_below(c).T for c in cameras]
    pixels = noisy(np.stack([image[..., :2] / image[..., 2:] for image in images], axis=2))
    sources = [
        write_points(folder / "flight-xypts.csv", pixels),
        write_coefficients(folder / "dlt.csv", [from_below(c) for c in cameras]),
    ]
    sizes = PerCamera({f"cam{k + 1}": size for k, size in enumerate(SIZES.values())})
    return sources, {"rates": PerCamera(other=RATE_HZ), "image_sizes": sizes, "length_unit": "m"}, None


def caliscope(version: int) -> Callable[[Path, int], Written]:
    """A session, with the layout of version 0 or 1."""

    def write(folder: Path, frames: int) -> Written:
        write_session(folder, version)
        camera, point = ("cam_id", "keypoint_id") if version else ("port", "point_id")
        rows, times = [], []
        for index, pixels in enumerate(seen(frames, 0.4 / RATE_HZ).values()):
            for frame in range(frames):
                now = 100.0 + (frame + 0.4 * index) / RATE_HZ
                times.append(f"{frame},{index},{now!r}")
                rows += [
                    f"{frame},{index},{frame},{now!r},{k},{u!r},{v!r}"
                    for k, (u, v) in enumerate(pixels[frame].tolist())
                ]
        head = f"sync_index,{camera},frame_index,frame_time,{point},img_loc_x,img_loc_y"
        (folder / "xy.csv").write_text("\n".join([head, *rows]) + "\n")
        (folder / "timestamps.csv").write_text("\n".join([f"sync_index,{camera},frame_time", *times]) + "\n")
        return [folder], {}, None

    return write


def openptv(folder: Path, frames: int) -> Written:
    """A project with a tank of water: targets of every frame."""
    write_tank(folder)
    points = curves(frames, 15.0)
    for k, center in enumerate(map(np.array, CORNERS), start=1):
        dm = np.loadtxt(folder / f"cal/cam{k}.ori", skiprows=3, max_rows=3)
        directions = np.array([through_glass(center, point) for point in points.reshape(-1, 3)]) @ dm
        u, v = (
            -70 * directions[:, 0] / directions[:, 2] / 0.012 + 640,
            512 + 70 * directions[:, 1] / directions[:, 2] / 0.012,
        )
        pixels = noisy(np.column_stack([u, v]), k).reshape(frames, OBJECTS, 2)
        for frame in range(frames):
            lines = [f" {n} {u!r} {v!r} 9 3 3 99 -1\n" for n, (u, v) in enumerate(pixels[frame].tolist())]
            (folder / f"img/cam{k}.{frame}_targets").write_text(f"{OBJECTS}\n{''.join(lines)}")
    (folder / "parameters/sequence.par").write_text(f"img/cam1.%d\nimg/cam2.%d\n0\n{frames - 1}\n")
    return [folder], {"rates": PerCamera(other=RATE_HZ)}, None


def _cameras(folder: Path) -> Path:
    write_cameras(folder / "cameras.yaml", rig(), "m")
    return folder / "cameras.yaml"


def deeplabcut(folder: Path, frames: int) -> Written:
    """A table of body parts for each camera."""
    parts = ["nose", "wing", "tail"]
    sources = []
    for name, pixels in seen(frames).items():
        head = [
            "scorer" + 9 * ",net",
            "bodyparts," + ",".join(p for p in parts for _ in range(3)),
            "coords" + 3 * ",x,y,likelihood",
        ]
        rows = [f"{k}," + ",".join(f"{u!r},{v!r},0.99" for u, v in frame) for k, frame in enumerate(pixels.tolist())]
        sources.append(folder / f"{name}.csv")
        sources[-1].write_text("\n".join([*head, *rows]) + "\n")
    return sources, {"rates": PerCamera(other=RATE_HZ)}, _cameras(folder)


def sleap(folder: Path, frames: int) -> Written:
    """An analysis file for each camera."""
    import h5py

    sources = []
    for name, pixels in seen(frames).items():
        sources.append(folder / f"{name}.analysis.h5")
        with h5py.File(sources[-1], "w") as file:
            file["tracks"] = pixels.transpose(1, 2, 0)[:, :, None]
            file["point_scores"] = np.full((OBJECTS, 1, frames), 0.9)
            file["node_names"], file["track_names"] = [b"body"], [b"a", b"b", b"c"]
    return sources, {"rates": PerCamera(other=RATE_HZ)}, _cameras(folder)


def mot(folder: Path, frames: int) -> Written:
    """A sequence of boxes for each camera."""
    sources = []
    for name, pixels in seen(frames).items():
        sources.append(folder / name)
        (folder / name / "det").mkdir(parents=True)
        rows = [
            f"{frame + 1},-1,{u - 8.5:.3f},{v - 13.5:.3f},20,30,0.9,-1,-1,-1\n"
            for frame, row in enumerate(pixels.tolist())
            for u, v in row
        ]
        (folder / name / "det/det.txt").write_text("".join(rows))
        width, height = SIZES[name]
        (folder / name / "seqinfo.ini").write_text(
            f"[Sequence]\nname={name}\nimDir=img1\nframeRate={RATE_HZ}\nseqLength={frames}\nimWidth={width}\n"
            f"imHeight={height}\n"
        )
    return sources, {}, _cameras(folder)


FORMATS: dict[str, tuple[str, Callable[[Path, int], Written]]] = {
    "dltdv": ("dltdv", dltdv),
    "caliscope, ports": ("caliscope", caliscope(0)),
    "caliscope, cameras": ("caliscope", caliscope(1)),
    "openptv through glass": ("openptv", openptv),
    "deeplabcut": ("deeplabcut", deeplabcut),
    "sleap": ("sleap", sleap),
    "mot": ("mot", mot),
}


def one_run(title: str, folder: Path, frames: int) -> bool:
    """Take a recording from its raw files to its page; print a line, and return whether all is well."""
    since = time.process_time()
    form, write = FORMATS[title]
    raw, log = folder / "raw", folder / "log"
    raw.mkdir(parents=True)
    sources, stated, cameras = write(raw, frames)
    warned = [
        ("import", word) for word in import_recording(form, sources, log, ImportOptions(**stated), cameras)["warnings"]
    ]

    def add(step: str, checks: list[dict[str, Any]]) -> None:
        warned.extend((step, f"{one['cause']}: {one['message']}") for one in checks if one["status"] == "warning")

    add("init", init(folder / "run", log)["checks"])
    loaded = load_config(folder / "run" / "config.yaml")
    add("check", check(loaded, log)["checks"])
    tracked = track(loaded, log / "detections.parquet", folder / "tracks")
    add("track", tracked["checks"])
    page = report([folder / "tracks"], folder / "report.html", logs=[log / "detections.parquet"])
    noise = [float(np.sqrt(np.prod(camera.detector.sigma_px))) for camera in loaded.cameras.values()]
    false = [
        text for text in warned if text[0] == "import" or text[1].split(":")[0] not in FEW | TRUE.get(title, set())
    ]
    count = len(tracked["tracks"])
    print(
        f"{title}: {count} tracks, noise {', '.join(f'{x:.2f}' for x in noise)} px, "
        f"{time.process_time() - since:.1f} s, page {page['bytes'] // 1000} kB, {len(warned)} warnings", flush=True,
    )  # fmt: skip
    for step, text in warned:
        print(f"    {'FALSE ' if (step, text) in false else ''}{step}: {text}", flush=True)
    return not false and count == OBJECTS


def main() -> int:
    """Run and print; return the exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="*", choices=FORMATS)
    parser.add_argument("--frames", type=int, default=40)
    options = parser.parse_args()
    logging.getLogger("stereophd").setLevel(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as temporary:
        right = [one_run(title, Path(temporary) / title, options.frames) for title in options.only or FORMATS]
    return int(not all(right))


if __name__ == "__main__":
    raise SystemExit(main())
