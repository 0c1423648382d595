"""Programs that follow named points: DeepLabCut and SLEAP."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.errors import InputError

from .conftest import log_rows

Import = Callable[..., tuple[dict[str, Any], Path]]

SINGLE = """scorer,net,net,net,net,net,net
bodyparts,nose,nose,nose,tail,tail,tail
coords,x,y,likelihood,x,y,likelihood
0,1.5,2.5,0.99,3.5,4.5,0.98
1,1.6,2.6,0.2,3.6,4.6,0.1
2,1.7,2.7,0.97,,,
"""
EXPECTED = [
    (0.0, "top", 0, 1.5, 2.5),
    (0.0, "top", 0, 3.5, 4.5),
    (0.5, "top", 1, None, None),
    (1.0, "top", 2, 1.7, 2.7),
]


def test_deeplabcut_csv(tmp_path: Path, imported: Import) -> None:
    (tmp_path / "topDLC_resnet50_miceJan1shuffle1_1000.csv").write_text(SINGLE)
    report, out = imported("deeplabcut", next(tmp_path.glob("*.csv")), rates=2.0, least_score=0.5)
    assert log_rows(out / "detections.parquet") == EXPECTED
    assert report["labels"] == {"0": "nose", "1": "tail"}
    assert "top: 2 detections below `least_score` left out" in report["assumed"]
    assert pq.read_table(out / "detections.parquet").column("object_id").to_pylist() == [0, 1, None, 0]


def test_a_word_among_the_numbers_is_refused_by_its_column(tmp_path: Path, imported: Import) -> None:
    (tmp_path / "top.csv").write_text(SINGLE.replace("3.6", "soon"))
    with pytest.raises(InputError, match=r"in column 5 \(tail x\): .*'soon'"):
        imported("deeplabcut", tmp_path / "top.csv", rates=2.0)


def test_two_files_of_the_same_frames_are_warned_of(tmp_path: Path, imported: Import) -> None:
    """DeepLabCut writes filtered predictions beside the raw ones, and a pattern finds both."""
    (tmp_path / "topDLC_net.csv").write_text(SINGLE)
    report, _ = imported("deeplabcut", tmp_path / "topDLC_net.csv", rates=2.0)
    assert not report["warnings"]
    (tmp_path / "topDLC_net_filtered.csv").write_text(SINGLE.replace("1.5,2.5", "1.55,2.5").replace("1.6,", "1.61,"))
    report, _ = imported("deeplabcut", *sorted(tmp_path.glob("*.csv")), rates=2.0)
    assert any("top: 2 detections of an object that has another one" in sentence for sentence in report["warnings"])


def test_deeplabcut_of_several_animals(tmp_path: Path, imported: Import) -> None:
    head = "scorer,net,net,net,net\nindividuals,m1,m1,m2,m2\nbodyparts,nose,nose,nose,nose\ncoords,x,y,x,y\n"
    (tmp_path / "side.csv").write_text(head + "0,1,2,3,4\n1,,,5,6\n")
    report, out = imported("deeplabcut", tmp_path / "side.csv", rates=1.0)
    assert [row[3] for row in log_rows(out / "detections.parquet")] == [1.0, 3.0, 5.0]
    assert report["labels"] == {"0": "m1.nose", "1": "m2.nose"}


def test_deeplabcut_hdf5_as_pandas_writes_it(tmp_path: Path, imported: Import) -> None:
    h5py = pytest.importorskip("h5py")
    columns = [("net", part, axis) for part in ("nose", "tail") for axis in ("x", "y", "likelihood")]
    values = [[float(x or "nan") for x in line.split(",")[1:]] for line in SINGLE.splitlines()[3:]]
    with h5py.File(tmp_path / "topDLC_net.h5", "w") as file:
        rows = np.zeros(3, dtype=[("index", "<i8"), ("values_block_0", "<f8", (6,))])
        rows["index"], rows["values_block_0"] = [0, 1, 2], values
        group = file.create_group("df_with_missing")
        group.create_dataset("table", data=rows)
        group.attrs["non_index_axes"] = np.bytes_(pickle.dumps([(1, columns)], protocol=0))
    _, out = imported("deeplabcut", tmp_path / "topDLC_net.h5", rates=2.0, least_score=0.5)
    assert log_rows(out / "detections.parquet") == EXPECTED
    with h5py.File(tmp_path / "topDLC_net.h5", "a") as file:
        file["df_with_missing"].attrs["non_index_axes"] = np.bytes_(pickle.dumps(Path("x"), protocol=0))
    with pytest.raises(InputError, match="expected the table of DeepLabCut"):
        imported("deeplabcut", tmp_path / "topDLC_net.h5", rates=2.0)


@pytest.mark.parametrize("python_axes", [False, True])
def test_sleap_analysis(tmp_path: Path, imported: Import, python_axes: bool) -> None:
    h5py = pytest.importorskip("h5py")
    tracks = np.full((2, 2, 2, 3), np.nan)  # tracks, xy, nodes, frames
    tracks[0, :, 0, 0] = [1.5, 2.5]
    tracks[1, :, 1, 2] = [3.5, 4.5]
    scores = np.where(np.isnan(tracks[:, 0]), np.nan, 0.75)
    with h5py.File(tmp_path / "top.analysis.h5", "w") as file:
        if python_axes:
            file["tracks"], file["point_scores"] = tracks.transpose(3, 0, 2, 1), scores.transpose(2, 0, 1)
            file["tracks"].attrs["dims"] = json.dumps(["frame", "track", "node", "xy"])
        else:
            file["tracks"], file["point_scores"] = tracks, scores
        file["node_names"] = [b"head", b"tail"]
        file["track_names"] = [b"fly", b"bee"]
    report, out = imported("sleap", tmp_path / "top.analysis.h5", rates=2.0)
    assert log_rows(out / "detections.parquet") == [
        (0.0, "top", 0, 1.5, 2.5),
        (0.5, "top", 1, None, None),
        (1.0, "top", 2, 3.5, 4.5),
    ]
    assert report["labels"]["3"] == "bee.tail"
    assert pq.read_table(out / "detections.parquet").column("object_id").to_pylist() == [0, None, 3]
    (tmp_path / "x.slp").touch()
    with pytest.raises(InputError, match="expected an analysis file"):
        imported("sleap", tmp_path / "x.slp", rates=2.0)
