"""Small valid files of every kind that a command reads, and one use of them by every command and every format."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.csv as csv
import pyarrow.parquet as pq
import yaml

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.io.interchange.cameras import take_apart
from stereophd.io.interchange.registry import find
from tests.io.formats.conftest import rig
from tests.io.formats.test_boxes import write_sequence
from tests.io.formats.test_caliscope import write_session
from tests.io.formats.test_dltdv import scene, write_coefficients, write_points
from tests.io.formats.test_laboratory import write_braidz, write_openptv, write_tank
from tests.io.formats.test_pose import SINGLE

CONFIGS = Path(__file__).resolve().parents[2] / "configs"

# Cameras see a few objects, for so long that their rays meet: else `check` looks for causes. What else takes time is
# off.
SMALL = {
    "simulate": {"duration_s": 2.0},
    "moments": {"samples": 64},
    "calibration": {"reference": "left", "priors": {"right": {"center_std": 0.1}}, "annealed": {"starts": 1}},
}


@dataclass(frozen=True)
class Use:
    """Words of a command that ends with 0 in its folder of valid files.

    ``OUT`` stands for a new file or folder: the only place where it may write. `stdin` is a file that it reads there.
    """

    folder: str
    words: str
    often: int = 24  # Share of the cases; fewer of what takes longer
    stdin: str = ""


USES = {
    "info of a log": Use("run", "info log.parquet"),
    "info of tracks": Use("run", "info tracked/tracks.parquet"),
    "info of a folder": Use("run", "info tracked"),
    "info of cameras": Use("run", "info cameras.yaml"),
    "check": Use("run", "check config.yaml log.parquet --cameras cameras.yaml", 4),
    "config check": Use("run", "config check config.yaml --cameras cameras.yaml", 48),
    "config check for calibrate": Use("run", "config check config.yaml --for calibrate"),
    "config show": Use("run", "config show config.yaml --cameras cameras.yaml"),
    "simulate": Use("run", "simulate config.yaml --out OUT"),
    "track": Use("run", "track config.yaml log.parquet --out OUT", 6),
    "track smoothed": Use("run", "track config.yaml log.parquet --smooth --associations --out OUT", 3),
    "track in pieces": Use("run", "track config.yaml log.parquet --pieces 1 --overlap 0.2 --out OUT", 3),
    "track bodies": Use("bodies", "track config.yaml log.parquet --out OUT", 8),
    "simulate bodies": Use("bodies", "simulate config.yaml --out OUT", 12),
    "check bodies": Use("bodies", "check config.yaml log.parquet", 12),
    "track several": Use("run", "track config.yaml log.parquet other.parquet --out OUT", 1),
    "track a stream": Use("run", "track config.yaml - --out OUT", 3, stdin="frames.jsonl"),
    "init": Use("run", "init OUT --log log.parquet --cameras cameras.yaml", 1),
    "evaluate": Use(
        "run", "evaluate tracked/tracks.parquet truth.parquet --cutoff 1 --cameras cameras.yaml --log log.parquet "
        "--seen-by 1 --seen-within 1 --out OUT --no-plots",
    ),
    "calibrate": Use("run", "calibrate config.yaml short.parquet --out OUT", 6),
    "calibrate several": Use("run", "calibrate config.yaml short.parquet shorter.parquet --jobs 1 --out OUT", 1),
    "evaluate of folders": Use("run", "evaluate runs runs --cutoff 1 --out OUT --no-plots", 2),
    "experiment": Use("experiment", "experiment config.yaml --out OUT", 4),
    "align to a track": Use("control", "align cameras.yaml --to control.parquet --tracks tracks.parquet --out OUT", 6),
    "align to a camera": Use("run", "align cameras.yaml --to left --out OUT"),
    "evaluate cameras": Use("run", "evaluate-cameras cameras.yaml guess.yaml --out OUT"),
    "report": Use("run", "report tracked scores --log log.parquet --truth truth.parquet --out OUT.html"),
    "export csv": Use("run", "export csv tracked/tracks.parquet --out OUT.csv"),
    "export tum": Use("run", "export tum tracked --track 1 --out OUT.txt"),
    "export trc": Use("run", "export trc tracked/tracks.parquet --rate 20 --out OUT.trc"),
    "export mot": Use("run", "export mot tracked/tracks.parquet --rate 20 --out OUT.txt"),
    "export c3d": Use("run", "export c3d tracked/tracks.parquet --rate 20 --out OUT.c3d"),
    "export opencv": Use("run", "export opencv cameras.yaml --out OUT.yml"),
    "export colmap": Use("run", "export colmap cameras.yaml --out OUT"),
    "export anipose": Use("run", "export anipose cameras.yaml --out OUT.toml"),
    "import csv": Use("run", "import csv points.csv --cameras cameras.yaml --fps 20 --out OUT", 48),
    "import anipose": Use("anipose", "import anipose rig.toml --out OUT"),
    "import braid": Use("braid", "import braid fly.braidz --out OUT", 48),
    "import caliscope": Use("caliscope", "import caliscope session --out OUT", 48),
    "import coco": Use("coco", "import coco labels.json --fps 2 --out OUT", 48),
    "import colmap": Use("colmap", "import colmap model --out OUT"),
    "import deeplabcut": Use("deeplabcut", "import deeplabcut top.csv --fps 2 --min-score 0.5 --out OUT"),
    "import deeplabcut hdf5": Use("deeplabcut", "import deeplabcut topDLC_net.h5 --fps 2 --out OUT"),
    "import dlt": Use("dlt", "import dlt rig.csv --image-size 640x480 --length-unit m --out OUT"),
    "import dltdv": Use(
        "dltdv", "import dltdv flight-xypts.csv dlt.csv --fps 100 --image-size 640x480 --length-unit m --out OUT", 48
    ),
    "import kalibr": Use("kalibr", "import kalibr rig.yaml --out OUT"),
    "import mot": Use("mot", "import mot north south --out OUT", 48),
    "import opencv yaml": Use("opencv", "import opencv rig.yml --out OUT"),
    "import opencv xml": Use("opencv", "import opencv rig.xml --out OUT"),
    "import opencv json": Use("opencv", "import opencv left.json right.json --out OUT"),
    "import opencv npz": Use("opencv", "import opencv rig.npz --out OUT"),
    "import openptv through glass": Use("tank", "import openptv parameters/ptv.par --fps 50 --out OUT", 4),
    "import myptv": Use("myptv", "import myptv blobs_left --fps 50 --truth trajectories --out OUT", 48),
    "import openptv": Use("openptv", "import openptv parameters/ptv.par --fps 50 --out OUT", 48),
    "import sleap": Use("sleap", "import sleap top.analysis.h5 --fps 2 --out OUT"),
    "import yolo": Use("yolo", "import yolo north --fps 2 --image-size 64x48 --out OUT", 12),
    "foreign cameras of a configuration": Use("opencv", "info rig.yml"),
}  # fmt: skip


def write_run(folder: Path) -> None:
    """Write a configuration and what `simulate`, `track` and `evaluate` make of it."""
    document = yaml.safe_load((CONFIGS / "quickstart.yaml").read_text(encoding="utf-8"))
    for section, values in SMALL.items():
        document[section] = {**document.get(section, {}), **values}
    (folder / "config.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    loaded = load_config(folder / "config.yaml", ["report.associations=true"])
    simulate(loaded, folder / "scene")
    for path in (folder / "scene").iterdir():
        path.rename(folder / path.name)
    (folder / "scene").rmdir()
    (folder / "detections.parquet").rename(folder / "log.parquet")
    shutil.copy(folder / "log.parquet", folder / "other.parquet")
    whole = pq.read_table(folder / "log.parquet")
    for name, end_s in (("short", 0.8), ("shorter", 0.7)):  # too short to calibrate by, which takes long
        pq.write_table(whole.filter(pc.less(whole["time_s"], end_s)), folder / f"{name}.parquet")
    track(loaded, folder / "log.parquet", folder / "tracked")
    evaluate(
        folder / "tracked" / "tracks.parquet", folder / "truth.parquet", folder / "scores", cutoff=1.0, plots=False
    )
    for name in ("first", "second"):
        (folder / "runs" / name).mkdir(parents=True)
        shutil.copy(folder / "tracked" / "tracks.parquet", folder / "runs" / name)
        shutil.copy(folder / "truth.parquet", folder / "runs" / name)
    table = pq.read_table(folder / "log.parquet", columns=["camera", "frame", "time_s", "u_px", "v_px"])
    csv.write_csv(table.drop_columns(["time_s"]), folder / "points.csv")
    frames: dict[tuple[float, str, int], list[list[float]]] = {}
    for row in table.to_pylist():
        seen = frames.setdefault((row["time_s"], row["camera"], row["frame"]), [])
        if row["u_px"] is not None:
            seen.append([row["u_px"], row["v_px"]])
    lines = [
        json.dumps({"camera": name, "frame": frame, "time_s": time, "detections": seen})
        for (time, name, frame), seen in frames.items()
    ]
    (folder / "frames.jsonl").write_text("\n".join(lines) + "\n")


def write_control(folder: Path) -> None:
    """Write cameras, tracks and the truth of an object on curves: a control track."""
    changes = ["simulate.duration_s=3", "simulate.acceleration_std=6", "motion.acceleration_std=6"]
    changes += ["motion.max_speed=20", "simulate.objects.count=1", "simulate.objects.births_per_s=0"]
    loaded = load_config(CONFIGS / "quickstart.yaml", [*changes, "simulate.objects.stay_in_view=none"])
    simulate(loaded, folder / "scene")
    track(loaded, folder / "scene" / "detections.parquet", folder / "tracked")
    truth = pq.read_table(folder / "scene" / "truth.parquet", columns=["time_s", "x", "y", "z"])
    pq.write_table(truth, folder / "control.parquet")
    (folder / "scene" / "cameras.yaml").rename(folder / "cameras.yaml")
    (folder / "tracked" / "tracks.parquet").rename(folder / "tracks.parquet")
    shutil.rmtree(folder / "scene")
    shutil.rmtree(folder / "tracked")


def write_experiment(folder: Path) -> None:
    """Write an experiment of the paper, with two runs of two methods."""
    document = yaml.safe_load((CONFIGS / "paper" / "figure4.yaml").read_text(encoding="utf-8"))
    study = document["experiment"]
    study["runs"], study["scenario"]["reference_samples"] = 2, 2000
    study["methods"] = dict(list(study["methods"].items())[:2])
    (folder / "config.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")


def write_bodies(folder: Path) -> None:
    """Write a configuration of people and its log of boxes."""
    document = yaml.safe_load((CONFIGS / "crowd.yaml").read_text(encoding="utf-8"))
    document["simulate"]["duration_s"], document["simulate"]["walkers"]["count"] = 1.0, 3
    (folder / "config.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    simulate(load_config(folder / "config.yaml", []), folder / "scene")
    (folder / "scene" / "detections.parquet").rename(folder / "log.parquet")
    shutil.rmtree(folder / "scene")


def write_coco(folder: Path) -> None:
    images = [{"id": k, "file_name": f"a/frame_{k:06d}.png", "width": 64, "height": 48} for k in range(4)]
    boxes = [{"id": k, "image_id": k, "bbox": [k, 2, 3, 4], "score": 0.5, "track_id": 1} for k in range(4)]
    points = [{"id": 9, "image_id": 3, "keypoints": [3, 4, 2, 0, 0, 0, 7, 8, 1]}]
    (folder / "labels.json").write_text(json.dumps({"images": images, "annotations": [*boxes, *points]}))


def write_yolo(folder: Path) -> None:
    (folder / "north" / "labels").mkdir(parents=True)
    for frame in range(3):
        text = f"0 0.5 0.{frame + 1} 0.25 0.5 0.9 1\n"
        (folder / "north" / "labels" / f"street_{frame}.txt").write_text(text)


def write_deeplabcut(folder: Path) -> None:
    import h5py

    (folder / "top.csv").write_text(SINGLE)
    columns = [("net", part, axis) for part in ("nose", "tail") for axis in ("x", "y", "likelihood")]
    with h5py.File(folder / "topDLC_net.h5", "w") as file:
        rows = np.zeros(3, dtype=[("index", "<i8"), ("values_block_0", "<f8", (6,))])
        rows["index"], rows["values_block_0"] = [0, 1, 2], np.arange(18.0).reshape(3, 6)
        group = file.create_group("df_with_missing")
        group.create_dataset("table", data=rows)
        group.attrs["non_index_axes"] = np.bytes_(pickle.dumps([(1, columns)], protocol=0))


def write_sleap(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "top.analysis.h5", "w") as file:
        file["tracks"] = np.arange(24.0).reshape(2, 2, 2, 3)
        file["point_scores"] = np.full((2, 2, 3), 0.75)
        file["node_names"], file["track_names"] = [b"head", b"tail"], [b"fly", b"bee"]


def write_opencv(folder: Path) -> None:
    cameras = rig()
    for name in ("rig.yml", "rig.xml"):
        _exported("opencv", name)(folder)
    values = {}
    for name, config in cameras.items():
        parts = take_apart(name, config)
        one = {
            "K": parts.matrix, "dist": parts.coefficients, "R": parts.rotation, "t": parts.translation,
            "image_size": np.array(parts.size),
        }  # fmt: skip
        values |= {f"{name}_{key}": value for key, value in one.items()}
        text = json.dumps({key: value.tolist() for key, value in one.items()})
        (folder / f"{name}.json").write_text(text)
    np.savez(folder / "rig.npz", **values)


def write_dltdv(folder: Path) -> None:
    _, projections, pixels = scene()
    write_points(folder / "flight-xypts.csv", pixels)
    write_coefficients(folder / "dlt.csv", projections)


def write_caliscope(folder: Path) -> None:
    (folder / "session").mkdir()
    write_session(folder / "session", 1)


def write_mot(folder: Path) -> None:
    write_sequence(folder / "north", "1,-1,1,1,1,1,0.9,-1,-1,-1\n3,-1,11,21,4,6,0.4,-1,-1,-1\n")
    write_sequence(folder / "south", "2,-1,5,5,3,3,0.8\n", rate=20.0)


def _exported(form: str, name: str, lens: tuple[float, ...] | None = None) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        writer = find(form).write_cameras
        assert writer is not None
        writer(rig() if lens is None else rig(lens=lens), "m", folder / name)

    return write


def write_kalibr(folder: Path) -> None:
    _exported("kalibr", "rig.yaml", (-0.11, 0.02, 1e-3, -2e-3))(folder)


def write_braid(folder: Path) -> None:
    write_braidz(folder / "fly.braidz", 0.0)


def write_myptv(folder: Path) -> None:
    (folder / "blobs_left").write_text("181.10\t377.85\t3\t3\t144\t0\n205.60\t75.03\t2\t3\t120\t2\n")
    rows = "3\t6.5\t17.5\t-3.5\t49\t36\t0.020\t0.0\n3\t6.6\t17.5\t-3.5\t49\t36\t0.020\t2.0\n"
    (folder / "trajectories").write_text(rows)


def write_glass(folder: Path) -> None:
    write_tank(folder)


def write_ptv(folder: Path) -> None:
    write_openptv(folder)


WRITERS: dict[str, Callable[[Path], None]] = {
    "anipose": _exported("anipose", "rig.toml"),
    "bodies": write_bodies,
    "braid": write_braid,
    "caliscope": write_caliscope,
    "coco": write_coco,
    "colmap": _exported("colmap", "model"),
    "control": write_control,
    "deeplabcut": write_deeplabcut,
    "dlt": _exported("dlt", "rig.csv", (0.0,)),
    "dltdv": write_dltdv,
    "experiment": write_experiment,
    "kalibr": write_kalibr,
    "mot": write_mot,
    "myptv": write_myptv,
    "opencv": write_opencv,
    "openptv": write_ptv,
    "run": write_run,
    "sleap": write_sleap,
    "tank": write_glass,
    "yolo": write_yolo,
}


def write_all(folder: Path) -> Path:
    """Write every folder of valid files; return where."""
    for name, write in WRITERS.items():
        (folder / name).mkdir(parents=True)
        write(folder / name)
    return folder
