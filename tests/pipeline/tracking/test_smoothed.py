"""Smoothed runs: detections known by their rows, and residuals of the filter that stay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config
from stereophd.config.report import ReportConfig, SmoothConfig
from stereophd.io.logs.reading import LogReader
from stereophd.io.tables.reading import open_parquet
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.stream import EventStream
from stereophd.pipeline.tracking.residuals import TrackErrors
from stereophd.pipeline.tracking.tracking_run import reported_records
from tests.commands.test_track import SCENE


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration, with a log of its scene beside it."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "scene.yaml").write_text(SCENE)
    simulate(load_config(folder / "scene.yaml"), folder / "log")
    return folder


def test_detections_carry_their_rows_of_the_log(log: Path) -> None:
    loaded = load_config(log / "scene.yaml")
    cameras, path = loaded.build_cameras(), log / "log" / "detections.parquet"
    with open_parquet(path, "log") as parquet:
        table = parquet.read()
    pixels = np.stack([table[name].to_numpy() for name in ("u_px", "v_px")], axis=1)
    seen = []
    for event in EventStream(cameras, LogReader(path, cameras)):
        assert event.pixels is not None
        assert event.rows is not None
        np.testing.assert_array_equal(pixels[event.rows], event.pixels)
        seen += event.rows.tolist()
    assert sorted(seen) == np.flatnonzero(np.isfinite(pixels[:, 0])).tolist()
    # frames in memory state no rows: their detections are numbered as they come
    frames = [replace(frame, rows=None) for frame in LogReader(path, cameras)]
    rows = np.concatenate([event.rows for event in EventStream(cameras, frames) if event.rows is not None])
    assert sorted(rows.tolist()) == list(range(len(seen)))


@pytest.mark.parametrize("length_s", [0.0, 3.0])
def test_smoothing_leaves_what_successive_detections_say(length_s: float, log: Path) -> None:
    """Smoothed residuals are not white: what tells whether tracks are too sure are those of the filter."""
    loaded = load_config(log / "scene.yaml", ["filter.kind=pmb"])
    cameras = loaded.build_cameras()
    tracker = replace(build_filter(loaded.config, cameras, loaded.path), claims=True)
    by_name, found = {camera.name: camera for camera in cameras}, []
    for smooth in (None, SmoothConfig()):
        stream = EventStream(cameras, LogReader(log / "log" / "detections.parquet", cameras))
        errors = TrackErrors()
        for record in reported_records(
            tracker, tracker.motion, stream, ReportConfig(smooth=smooth, min_track_length=length_s)
        ):
            assert (record.filtered is None) == (smooth is None)
            errors.add(record, by_name)
        found.append(errors.report(by_name))
    assert found[0]["same_camera"]["pairs"] > 20
    assert found[0] == found[1]
