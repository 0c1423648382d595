"""Tracks in the files of other programs: read back by other readers where there are any."""

from __future__ import annotations

import csv
import errno
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.commands.export import export
from stereophd.errors import InputError
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.interchange.base import ExportOptions
from stereophd.io.interchange.registry import find, names
from stereophd.io.outputs.provenance import provenance, to_metadata
from stereophd.io.tables.schemas import TRACKS
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.inspection.tables import summarise_objects

from .conftest import rig

WRITERS = [name for name in names() if find(name).write_tracks is not None]
# Packages that formats need, and formats whose files differ each time: the library writes an identity into them.
EXTRAS, UNIQUE = {"c3d": "ezc3d", "rerun": "rerun"}, {"rerun"}
TIMES = {3: np.array([0.0, 0.1, 0.2, 0.3]), 8: np.array([0.2, 0.3, 0.5])}


def positions(track: int) -> np.ndarray:
    """Return positions on a line, of numbers that no short decimal holds."""
    return np.stack([TIMES[track] * np.pi, np.full(len(TIMES[track]), track / 7), -TIMES[track] / 3], axis=1)


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    """Tracks at multiples of 0.1 s, not all of them."""
    cameras = {name: config.model_dump(mode="json") for name, config in rig().items()}
    record = provenance("track", {"cameras": cameras}, length_unit="cm")
    path = tmp_path / "tracks.parquet"
    with TableWriter(path, TRACKS, to_metadata(record)) as table:
        rows = [(t, k, i) for k, times in TIMES.items() for i, t in enumerate(times.tolist())]
        for time, track, index in sorted(rows):
            x, y, z = positions(track)[index]
            columns = {"x": x, "y": y, "z": z, "vx": np.pi, "vy": 0.0, "vz": -1 / 3}
            covariance = np.arange(36.0)[None] / 7
            key = {"time_s": np.array([time]), "camera": "left", "frame": round(time * 10), "track_id": track}
            columns = {k: float(v) for k, v in columns.items()}
            table.append({**key, **columns, "covariance": covariance, "existence": 0.5, "status": "confirmed"})
    return path


@pytest.mark.parametrize("form", WRITERS)
def test_every_writer_of_tracks_keeps_the_contract(form: str, tracks: Path, tmp_path: Path) -> None:
    """A known track is written, the same again; what is refused leaves nothing, and replaces nothing."""
    if form in EXTRAS:
        pytest.importorskip(EXTRAS[form])
    first, again = tmp_path / "first", tmp_path / "again"
    for target in (first, again):
        report = export(form, tracks, target, ExportOptions(tracks=[3]))
        assert (report["format"], report["what"], report["file"]) == (form, "tracks", target.name)
    if form not in UNIQUE:
        assert first.read_bytes() == again.read_bytes()
    assert first.stat().st_size > 0
    with pytest.raises(InputError, match=r"expected the tracks \[5\]"):
        export(form, tracks, tmp_path / "refused", ExportOptions(tracks=[5]))
    with pytest.raises(InputError, match="the file exists"):
        export(form, tracks, first, ExportOptions(tracks=[3]))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again", "first", "tracks.parquet"]


def test_csv_is_exact(tracks: Path, tmp_path: Path) -> None:
    report = export("csv", tracks, tmp_path / "out.csv")
    assert report["what"] == "tracks"
    with open(tmp_path / "out.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 7
    for row in rows:
        track = int(row["track_id"])
        index = TIMES[track].tolist().index(float(row["time_s"]))
        assert [float(row[axis]) for axis in "xyz"] == positions(track)[index].tolist()
        assert float(row["cov_vx_vz"]) == (3 * 6 + 5) / 7


def test_csv_quotes_names_and_has_the_standard_deviations(tracks: Path, tmp_path: Path) -> None:
    table = pq.read_table(tracks)
    names = ['le,ft "1"'] * table.num_rows
    table = table.set_column(table.schema.get_field_index("camera"), "camera", pa.array(names))
    for axis in "xyz":
        table = table.append_column(f"std_{axis}", pa.array(np.full(table.num_rows, 1 / 3)))
    pq.write_table(table, tracks)
    export("csv", tracks, tmp_path / "out.csv")
    with open(tmp_path / "out.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["camera"] for row in rows] == names
    assert {(row["status"], float(row["std_x"]), float(row["std_z"])) for row in rows} == {("confirmed", 1 / 3, 1 / 3)}


@pytest.mark.parametrize("name", ["=cmd|' /C calc'!A0", "+1", "-1", "@x"])
def test_no_cell_of_a_table_is_a_formula(name: str, tracks: Path, tmp_path: Path) -> None:
    table = pq.read_table(tracks)
    names = pa.array([name] * table.num_rows)
    pq.write_table(table.set_column(table.schema.get_field_index("camera"), "camera", names), tracks)
    export("csv", tracks, tmp_path / "out.csv")
    with open(tmp_path / "out.csv", newline="") as stream:
        assert {row["camera"] for row in csv.DictReader(stream)} == {f"'{name}"}


def test_tracks_without_identities_are_refused(tracks: Path, tmp_path: Path) -> None:
    table = pq.read_table(tracks)
    nulls = pa.nulls(table.num_rows, pa.int64())
    pq.write_table(table.set_column(table.schema.get_field_index("track_id"), "track_id", nulls), tracks)
    with pytest.raises(InputError, match="column track_id: expected a value in every row"):
        export("tum", tracks, tmp_path / "out.tum")


@pytest.mark.parametrize("form", ["csv", "tum", "trc"])
def test_a_time_that_is_no_number_is_refused_with_its_row(form: str, tracks: Path, tmp_path: Path) -> None:
    table = pq.read_table(tracks)
    times = table["time_s"].to_numpy().copy()
    times[-1] = np.inf
    pq.write_table(table.set_column(table.schema.get_field_index("time_s"), "time_s", pa.array(times)), tracks)
    with pytest.raises(InputError, match=f"row {len(times) - 1}: column time_s: expected a finite number, found inf"):
        export(form, tracks, tmp_path / f"out.{form}")


def test_tentative_estimates_are_left_out_unless_asked_for(tracks: Path, tmp_path: Path) -> None:
    table = pq.read_table(tracks)
    status = pa.array(["tentative" if row % 2 else "confirmed" for row in range(table.num_rows)])
    pq.write_table(table.set_column(table.schema.get_field_index("status"), "status", status), tracks)
    export("csv", tracks, tmp_path / "confirmed.csv")
    assert len((tmp_path / "confirmed.csv").read_text().splitlines()) == 1 + (table.num_rows + 1) // 2
    report = export("csv", tracks, tmp_path / "all.csv", ExportOptions(tentative=True))
    assert len((tmp_path / "all.csv").read_text().splitlines()) == 1 + table.num_rows
    with open(tmp_path / "all.csv", newline="") as stream:
        assert [row["status"] for row in csv.DictReader(stream)] == status.to_pylist()
    summary = summarise_objects(tracks, "track_id")
    assert summary["tentative_rows"] == table.num_rows // 2
    assert sum(row["rows"] for row in summary["rows_by_object"]) == (table.num_rows + 1) // 2
    assert report["what"] == "tracks"


def test_tum_holds_one_track(tracks: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected one track for this format, found 2; choose one by `tracks`: 3, 8"):
        export("tum", tracks, tmp_path / "out.tum")
    assert not (tmp_path / "out.tum").exists()
    export("tum", tracks, tmp_path / "out.tum", ExportOptions(tracks=[8]))
    table = np.loadtxt(tmp_path / "out.tum")
    np.testing.assert_array_equal(table[:, 0], TIMES[8])
    np.testing.assert_array_equal(table[:, 1:4], positions(8))
    np.testing.assert_array_equal(table[:, 4:], [[0, 0, 0, 1]] * 3)


def test_mot_in_three_dimensions(tracks: Path, tmp_path: Path) -> None:
    export("mot", tracks, tmp_path / "out.txt")
    table = np.loadtxt(tmp_path / "out.txt", delimiter=",")
    assert table[:, 0].tolist() == [1, 2, 3, 3, 4, 4, 5]
    mine = table[table[:, 1] == 8]
    np.testing.assert_array_equal(mine[:, 7:], positions(8))
    assert (table[:, 2:6] == -1).all()


def test_trc_fills_the_grid(tracks: Path, tmp_path: Path) -> None:
    export("trc", tracks, tmp_path / "out.trc")
    lines = (tmp_path / "out.trc").read_text().splitlines()
    assert lines[2].split("\t")[2:5] == ["6", "2", "cm"]
    assert lines[3].split("\t")[:6] == ["Frame#", "Time", "track_3", "", "", "track_8"]
    rows = [line.split("\t") for line in lines[6:]]
    assert [len(row) for row in rows] == [8] * 6
    assert [float(x) for x in rows[1][2:5]] == pytest.approx(positions(3)[1], abs=1e-12)
    assert rows[0][5:] == ["", "", ""]
    # at 0.4 s the second track lies between two of its times
    assert float(rows[4][5]) == pytest.approx(0.4 * np.pi)


def test_irregular_times_need_a_rate(tracks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereophd.io.interchange.tracks.REGULAR", 1e-30)
    with pytest.raises(InputError, match="expected reports at a fixed rate"):
        export("trc", tracks, tmp_path / "out.trc")
    monkeypatch.undo()
    export("trc", tracks, tmp_path / "out.trc", ExportOptions(rate_hz=20.0))
    assert (tmp_path / "out.trc").read_text().splitlines()[2].split("\t")[:3] == ["20.0", "20.0", "11"]


def test_a_pause_without_end_is_refused(tracks: Path, tmp_path: Path) -> None:
    table = pq.read_table(tracks)
    times = table.column("time_s").to_numpy().copy()
    times[-1] = 1e90
    pq.write_table(table.set_column(table.schema.get_field_index("time_s"), "time_s", pa.array(times)), tracks)
    with pytest.raises(InputError, match=r"expected at most 50000000 times at the rate, found 2e\+91"):
        export("trc", tracks, tmp_path / "tracks.trc", ExportOptions(rate_hz=20.0))


def test_c3d_is_read_by_its_library(tracks: Path, tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    export("c3d", tracks, tmp_path / "out.c3d")
    file = ezc3d.c3d(str(tmp_path / "out.c3d"))
    assert file["parameters"]["POINT"]["LABELS"]["value"] == ["track_3", "track_8"]
    assert file["parameters"]["POINT"]["UNITS"]["value"] == ["cm"]
    assert file["parameters"]["POINT"]["RATE"]["value"][0] == pytest.approx(10)
    points = file["data"]["points"]
    assert points.shape == (4, 2, 6)
    np.testing.assert_allclose(points[:3, 0, :4].T, positions(3), atol=1e-6)
    assert np.isnan(points[0, 0, 4:]).all()


def test_rerun_holds_tracks_and_cameras(tracks: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    report = export("rerun", tracks, tmp_path / "out.rrd")
    content = (tmp_path / "out.rrd").read_bytes()
    assert content[:3] == b"RRF"
    for name in (b"world/tracks/3", b"world/tracks/8", b"world/cameras/left", b"Pinhole"):
        assert name in content
    assert report["notes"] == ["positions have single precision"]


def test_targets_and_sources_are_checked(tracks: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    target.write_text("mine")
    with pytest.raises(InputError, match="the file exists"):
        export("csv", tracks, target)
    assert target.read_text() == "mine"
    export("csv", tmp_path, target, force=True)
    with pytest.raises(InputError, match=rf"expected a format that holds tracks \({', '.join(WRITERS)}\)"):
        export("kalibr", tracks, tmp_path / "x.yaml")
    write_cameras(tmp_path / "cameras.yaml", rig(), "cm")
    with pytest.raises(InputError, match="expected a format that holds cameras"):
        export("csv", tmp_path / "cameras.yaml", tmp_path / "x.csv")
    with pytest.raises(InputError, match=r"expected the tracks \[5\]"):
        export("csv", tracks, tmp_path / "x.csv", ExportOptions(tracks=[5]))
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match="expected a file of cameras, or a folder that holds one"):
        export("opencv", tmp_path / "other", tmp_path / "x.yml")
    assert export("colmap", tmp_path / "cameras.yaml", tmp_path / "model")["what"] == "cameras"
    assert sorted(path.name for path in (tmp_path / "model").iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]
    # a foreign file of cameras becomes another one
    export("opencv", tmp_path / "cameras.yaml", tmp_path / "rig.yml")
    export("anipose", tmp_path / "rig.yml", tmp_path / "rig.toml")
    assert 'name = "left"' in (tmp_path / "rig.toml").read_text()


class TestAFormatThatIsAFolder:
    @pytest.fixture
    def cameras(self, tmp_path: Path) -> Path:
        write_cameras(tmp_path / "cameras.yaml", rig(), "cm")
        return tmp_path / "cameras.yaml"

    def test_a_move_that_fails_leaves_the_earlier_one(
        self, cameras: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        model = tmp_path / "model"
        export("colmap", cameras, model)
        (model / "cameras.txt").write_text("earlier")
        before = {path.name: path.read_text() for path in model.iterdir()}
        monkeypatch.setattr("stereophd.io.outputs.commit._exchange", lambda one, other: False)
        replace, calls = os.replace, [0]

        def fails_late(source: Path, target: Path) -> None:
            calls[0] += 1
            if calls[0] == 9:  # the second new file
                raise OSError(errno.EIO, "Input/output error", str(source))
            replace(source, target)

        monkeypatch.setattr(os, "replace", fails_late)
        with pytest.raises(InputError, match="cannot write"):
            export("colmap", cameras, model, force=True)
        assert {path.name: path.read_text() for path in model.iterdir()} == before

    def test_what_is_not_ours_stays(self, cameras: Path, tmp_path: Path) -> None:
        model = tmp_path / "model"
        export("colmap", cameras, model)
        with pytest.raises(InputError, match="already holds"):
            export("colmap", cameras, model)
        (model / "points3D.txt").write_text("points of a reconstruction")
        with pytest.raises(InputError, match=r"points3D\.txt: expected none or an empty file, found content"):
            export("colmap", cameras, model, force=True)
        assert (model / "points3D.txt").read_text() == "points of a reconstruction"
        (model / "points3D.txt").write_text("")
        (model / "notes.txt").write_text("mine")
        with pytest.raises(InputError, match="which this command does not write"):
            export("colmap", cameras, model, force=True)
