"""People on an annotated floor and beside it: who is beside it is neither taken for others nor reported nor scored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.errors import InputError

pytestmark = pytest.mark.usefixtures("without_checks")

SCENE = """
units: {length: m}
seed: 3
cameras:
  left: &camera
    image_size_px: [800, 600]
    intrinsics: {fx: 500.0, fy: 500.0, cx: 399.5, cy: 299.5}
    pose: {center: [-3.0, -2.0, 0.0], rotation_vector_deg: [0.0, 20.0, 0.0]}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 0.5}
    frame_rate_hz: 10.0
  right:
    <<: *camera
    pose: {center: [3.0, -2.0, 0.0], rotation_vector_deg: [0.0, -20.0, 0.0]}
  above:
    <<: *camera
    pose: {center: [0.0, -6.0, 0.0], rotation_vector_deg: [20.0, 0.0, 0.0]}
motion: {model: constant_velocity, acceleration_std: 0.1, max_speed: 3.0}
filter: {kind: pmb, birth: {per_s: 0.2, depth_range: [3.0, 20.0], velocity_std: 0.5}}
report: {max_position_std: 0.5}
simulate:
  duration_s: 2.0
  objects:
    count: 6
    box: {x: [-2.5, 2.5], y: [-1.5, -0.5], z: [8.0, 15.0]}
    velocity_std: 0.2
"""
POLYGON = "region.polygon={corners: [[-4, 0, 5], [4, 0, 5], [4, 0, 13.1], [-4, 0, 13.1]], heights: [-2.0, 4.0]}"


def test_who_is_beside_the_floor(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    loaded = load_config(tmp_path / "scene.yaml")
    simulate(loaded, tmp_path / "log")
    report = track(
        load_config(tmp_path / "scene.yaml", [POLYGON]), tmp_path / "log" / "detections.parquet", tmp_path / "run"
    )
    z = pq.read_table(tmp_path / "run" / "tracks.parquet")["z"].to_numpy()
    truth = pq.read_table(tmp_path / "log" / "truth.parquet")["z"].to_numpy()
    assert 0.2 < np.mean(truth <= 13.1) < 0.8
    assert len(z)
    assert z.max() <= 13.1
    for camera in report["cameras"].values():
        assert 0.1 * camera["detections"] < camera["outside_region"] < 0.9 * camera["detections"]
    scores = evaluate(
        tmp_path / "run" / "tracks.parquet", tmp_path / "log" / "truth.parquet", cutoff=1.0, region="tracks"
    )
    assert scores["ospa"]["mean"] < 0.25
    assert abs(scores["cardinality"]["bias"]) < 0.5
    with pytest.raises(InputError, match="convex polygon"):
        load_config(tmp_path / "scene.yaml", [POLYGON.replace("[-4, 0, 13.1]", "[0, 0, 6]")])
    bare = pq.read_table(tmp_path / "run" / "tracks.parquet").replace_schema_metadata(None)
    pq.write_table(bare, tmp_path / "bare.parquet")
    with pytest.raises(InputError, match="configuration with region"):
        evaluate(tmp_path / "bare.parquet", tmp_path / "log" / "truth.parquet", cutoff=1.0, region="tracks")
