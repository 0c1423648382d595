"""Files that are not what their format says: every reader refuses them, and names the file."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import math
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from stereophd.commands.importing import import_recording
from stereophd.errors import InputError
from stereophd.io.formats import csv
from stereophd.io.interchange.assembly import spool_pieces
from stereophd.io.interchange.base import ForeignRecording, ImportOptions, PerCamera, Piece, named_files
from stereophd.io.interchange.registry import find, names, recognise_cameras

READERS = [name for name in names() if find(name).read is not None]
OPTIONS = ImportOptions(rates=PerCamera(other=10.0), image_sizes=PerCamera(other=(100, 100)), length_unit="m")
EYE = np.eye(3).tolist()
K = [[100, 0, 50], [0, 100, 50], [0, 0, 1]]
CAMERA = "rotation = [0, 0, 0]\ntranslation = [0, 0, 0]\n"
FILES = {
    "empty.txt": b"",
    "empty.csv": b"",
    "random.dat": np.random.default_rng(3).bytes(3000),
    "random.h5": np.random.default_rng(4).bytes(3000),
    "random.npz": b"PK" + np.random.default_rng(5).bytes(300),
    "text.json": b'"abc"',
    "list.json": b'[1, 2, "a"]',
    "deep.json": b"[\n" * 1500 + b"]" * 1500,
    "deep.yaml": b"a: " + b"[" * 600 + b"]" * 600,
    "names.json": b'{"images": ["a"], "annotations": []}',
    "null.json": b'{"images": [{"id": 1, "file_name": null}], "annotations": [{"image_id": 1, "bbox": [1, 2, 3]}]}',
    "matrix.json": json.dumps({"K": [[1, 0, 0], [0, 1, "x"], [0, 0, 1]], "R": EYE, "T": [0, 0, 0]}).encode(),
    "translation.json": json.dumps({"K": K, "R": EYE, "T": ["a", 0, 0]}).encode(),
    "lens.json": json.dumps({"K": K, "R": EYE, "T": [0, 0, 0], "dist": "abc"}).encode(),
    "headers.csv": b"scorer,a,a\nbodyparts,x\ncoords,x,y,z\n0,1,2\n",
    "no_scorer.csv": b"bodyparts,x,x\ncoords,x,y\n0,1,2\n1,1,2\n",
    "words.csv": b"a,b,c\nx,y,z\n",
    "size.toml": f'[cam_0]\nname = "a"\nsize = 5\nmatrix = {K}\ndistortions = [0, 0, 0, 0, 0]\n{CAMERA}'.encode(),
    "cameras.toml": b'cameras = 3\n[cam_0]\nname = 3\nmatrix = "x"\ndistortions = 1\nrotation = {}\n',
    "numbers.yaml": b"cam0: 5\ncam1: [1, 2]\n",
    "chain.yaml": b"cam0: {camera_model: pinhole, intrinsics: [a, b], resolution: 5}\n",
    "storage.xml": b"<opencv_storage><K type_id='opencv-matrix'><rows>x</rows></K></opencv_storage>",
    "cameras.txt": b"# Camera list\n1 PINHOLE a b c\n",
}


@pytest.mark.parametrize("form", READERS)
def test_malformed_files_are_refused(form: str, tmp_path: Path) -> None:
    for name, content in FILES.items():
        source = tmp_path / name
        source.write_bytes(content)
        # some formats name a file beside it
        with pytest.raises(InputError, match=re.escape(str(tmp_path))):
            import_recording(form, [source], tmp_path / "out", OPTIONS)
        assert not (tmp_path / "out").exists()


def test_malformed_files_are_recognised_or_not(tmp_path: Path) -> None:
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
        assert recognise_cameras(tmp_path / name) in (None, *READERS)


@pytest.mark.parametrize("form", ["deeplabcut", "sleap"])
def test_malformed_hdf5_is_refused(form: str, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    source = tmp_path / "table.h5"
    for shape in ((3,), (2, 3, 3)):
        with h5py.File(source, "w") as file:
            group = file.create_group("df_with_missing")
            group.attrs["non_index_axes"] = b"(lp0\n."
            group["table"] = np.zeros(3)
            file["tracks"] = np.zeros(shape)
            file["node_names"] = np.zeros(3)
            file["track_names"] = np.zeros((2, 2))
        with pytest.raises(InputError, match=r"table\.h5"):
            import_recording(form, [source], tmp_path / "out", OPTIONS)


def test_a_damaged_archive_is_refused_wherever_it_is_cut(tmp_path: Path) -> None:
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:
        archive.writestr("cam_info.csv.gz", gzip.compress(b"camn,cam_id\n0,a\n"))
        rows = b"".join(b"0,%d,0.1,0.1,5,6\n" % k for k in range(50))
        archive.writestr("data2d_distorted.csv.gz", gzip.compress(b"camn,frame,timestamp,x,y\n" + rows))
    content, source = whole.getvalue(), tmp_path / "cut.braidz"
    for place in range(0, len(content), 7):
        for damaged in (content[:place], content[:place] + b"\xff\x00" + content[place + 2 :]):
            source.write_bytes(damaged)
            # a change in the time of a member, say, harms nothing
            with contextlib.suppress(InputError):
                import_recording("braid", [source], tmp_path / "out", OPTIONS, force=True)


@pytest.mark.parametrize("score", [math.nan, math.inf])
def test_a_score_that_is_no_number_is_refused(score: float) -> None:
    with pytest.raises(InputError, match="`least_score`: expected a finite number"):
        ImportOptions(least_score=score)


def test_a_camera_that_is_named_but_has_no_rows_is_left_out(tmp_path: Path) -> None:
    """As an importer makes it of a column of ports with a gap."""
    rows = (np.array([[1.0, 2.0]]), np.array([0.0]))
    pieces = [Piece(tmp_path, "a", *rows), Piece(tmp_path, "nan", np.empty((0, 2)), np.empty(0))]
    spools = spool_pieces(ForeignRecording(pieces=pieces), tmp_path, ImportOptions())
    assert list(spools) == ["a"]
    for spool in spools.values():
        spool.discard()


def test_a_message_names_the_file_with_the_row_and_no_other(tmp_path: Path) -> None:
    for name, frame in (("left", "1"), ("right", "0.5")):
        (tmp_path / f"{name}.csv").write_text(f"frame,u,v\n{frame},2,3\n")
    recording = csv.read([tmp_path / "left.csv", tmp_path / "right.csv"], ImportOptions())
    with pytest.raises(InputError, match=r"^\S*right\.csv: camera right: expected whole frame numbers, found 0\.5$"):
        spool_pieces(recording, tmp_path, ImportOptions())


def test_of_many_files_a_message_names_the_first() -> None:
    assert named_files(map(Path, "aab")) == "a, b"
    assert named_files(map(Path, "abcdef")) == "a and 5 other files"
