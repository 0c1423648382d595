"""`stereophd calibrate` on the drone recording: four cameras whose frames never coincide, one drone that manoeuvres."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stereophd.commands.calibrate import calibrate
from stereophd.commands.evaluate_cameras import evaluate_calibration
from stereophd.config.loading import load_cameras, load_config
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.io.cameras.writing import write_cameras
from stereophd.pipeline.calibration.configured_unknowns import with_quantities
from tests.shared_data import shared_data

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "drone_calibration.yaml"


def test_cameras_that_are_two_metres_and_five_degrees_off(tmp_path: Path) -> None:
    folder = shared_data() / "drone" / "1"
    supplied = load_cameras(folder / "cameras_as_supplied.yaml").cameras
    cameras = [camera.build(name) for name, camera in supplied.items()]
    rng = np.random.default_rng(1)
    guess = [cameras[0]]
    for camera in cameras[1:]:
        offset, turn = rng.standard_normal((2, 3))
        rotation = rotation_from_vector(np.deg2rad(5.0) * turn / np.linalg.norm(turn)) @ camera.pose.rotation
        pose = Pose(rotation, camera.pose.center + 2.0 * offset / np.linalg.norm(offset))
        guess.append(replace(camera, pose=pose))
    write_cameras(tmp_path / "guess.yaml", with_quantities(supplied, guess), "m")
    # 34 s of the log: a tenth of the time that all of it takes
    table = pq.read_table(folder / "detections.parquet")
    some = pc.and_(pc.greater(table["time_s"], 486.0), pc.less(table["time_s"], 520.0))
    pq.write_table(table.filter(some), tmp_path / "log.parquet")
    distance = float(np.linalg.norm(cameras[0].pose.center - cameras[1].pose.center))
    changes = [
        f"calibration.scale.distance={distance}",
        "calibration.annealed.max_events=1500",
        "calibration.annealed.starts=1",
        "calibration.annealed.agreeing_starts=1",
    ]
    loaded = load_config(CONFIG, changes, cameras_path=tmp_path / "guess.yaml")
    report = calibrate(loaded, tmp_path / "log.parquet", tmp_path / "out", plots=False)
    # the supplied lenses and clocks are known to a few tenths of a degree only: the answer says that it depends on them
    assert report["status"] == "partly determined"
    assert "cam0.focal may fit better" in report["reason"]
    assert report["scale"]["determined_by"] == "baseline"
    scores = evaluate_calibration(tmp_path / "out" / "cameras.yaml", folder / "cameras_as_supplied.yaml")
    # beside what was measured when this was written: 0.29 deg and 0.36 m, which is the error of lenses and clocks
    assert max(camera["rotation_deg"] for camera in scores["cameras"].values()) < 0.5
    assert max(camera["center"] for camera in scores["cameras"].values()) < 0.6
