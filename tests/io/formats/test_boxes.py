"""Boxes: MOTChallenge, COCO and YOLO."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from stereophd.errors import InputError
from stereophd.io.cameras.writing import write_cameras

from .conftest import log_rows, rig

Import = Callable[..., tuple[dict[str, Any], Path]]


def write_sequence(folder: Path, rows: str, rate: float = 10.0, size: tuple[int, int] = (640, 480)) -> Path:
    (folder / "det").mkdir(parents=True)
    (folder / "det" / "det.txt").write_text(rows)
    text = f"[Sequence]\nname={folder.name}\nimDir=img1\nframeRate={rate}\nseqLength=4\n"
    text += "imWidth={}\nimHeight={}\n".format(*size)
    (folder / "seqinfo.ini").write_text(text)
    return folder


def test_sequences_of_motchallenge(tmp_path: Path, imported: Import) -> None:
    # a box over the first pixel alone has its centre in it
    first = write_sequence(tmp_path / "north", "1,-1,1,1,1,1,0.9,-1,-1,-1\n3,-1,11,21,4,6,0.4,-1,-1,-1\n")
    second = write_sequence(tmp_path / "south", "2,-1,5,5,3,3,0.8\n", rate=20.0)
    report, out = imported("mot", first, second)
    assert log_rows(out / "detections.parquet") == [
        (0.0, "north", 1, 0.0, 0.0),
        (0.0, "south", 1, None, None),
        (0.05, "south", 2, 5.0, 5.0),
        (0.1, "north", 2, None, None),
        (0.1, "south", 3, None, None),
        (pytest.approx(0.15), "south", 4, None, None),
        (0.2, "north", 3, 11.5, 22.5),
        (pytest.approx(0.3), "north", 4, None, None),
    ]
    assert "object_id" not in pq.read_schema(out / "detections.parquet").names
    assert report["cameras"]["north"]["rate_hz"] == pytest.approx(10)
    _, out = imported("mot", first, box_point="bottom", least_score=0.5)
    assert log_rows(out / "detections.parquet")[2] == (0.2, "north", 3, None, None)
    bare = tmp_path / "bare.txt"
    bare.write_text("1,-1,1,1,1,1,1\n")
    with pytest.raises(InputError, match=r"expected a seqinfo.ini or `rates`"):
        imported("mot", bare)


def test_stated_and_recorded_rates_give_the_same_times(tmp_path: Path, imported: Import) -> None:
    rows = "1,-1,1,1,1,1,0.9\n4,-1,11,21,4,6,0.4\n"
    north, south = write_sequence(tmp_path / "north", rows), write_sequence(tmp_path / "south", rows)
    found = [
        log_rows(imported("mot", north, south, **stated)[1] / "detections.parquet")
        for stated in ({}, {"rates": 10.0}, {"rates": {"north": 10.0}})
    ]
    assert [time for time, *_ in found[0]] == pytest.approx([0.0, 0.0, 0.1, 0.1, 0.2, 0.2, 0.3, 0.3])
    for other in found[1:]:
        assert [rest for _, *rest in other] == [rest for _, *rest in found[0]]
        assert [time for time, *_ in other] == pytest.approx([time for time, *_ in found[0]])


def test_annotations_of_coco(tmp_path: Path, imported: Import) -> None:
    document = {
        "images": [
            {"id": 11, "file_name": "a/frame_000000.png", "width": 64, "height": 48},
            {"id": 12, "file_name": "a/frame_000001.png", "width": 64, "height": 48},
            {"id": 13, "file_name": "b/frame_000000.png", "width": 64, "height": 48},
        ],
        "annotations": [
            {"id": 1, "image_id": 11, "bbox": [0, 0, 1, 1], "score": 0.5, "track_id": 4},
            {"id": 2, "image_id": 13, "keypoints": [3, 4, 2, 0, 0, 0, 7, 8, 1]},
        ],
    }
    (tmp_path / "labels.json").write_text(json.dumps(document))
    _, out = imported("coco", tmp_path / "labels.json", rates=2.0)
    assert log_rows(out / "detections.parquet") == [
        (0.0, "a", 0, 0.0, 0.0),
        (0.0, "b", 0, 3.0, 4.0),
        (0.0, "b", 0, 7.0, 8.0),
        (0.5, "a", 1, None, None),
    ]
    table = pq.read_table(out / "detections.parquet")
    assert table.column("object_id").to_pylist() == [4, 0, 2, None]
    assert table.column("score").to_pylist() == [0.5, None, None, None]
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(InputError, match="expected COCO's images"):
        imported("coco", tmp_path / "bad.json", rates=2.0)


@pytest.mark.parametrize("form", ["mot", "coco"])
def test_a_size_of_images_that_contradicts_the_cameras_is_named(tmp_path: Path, imported: Import, form: str) -> None:
    """The calibration is often of another resolution than the film."""
    write_cameras(tmp_path / "cameras.yaml", rig(), "m")
    sources = []
    for name, width in (("left", 640), ("right", 1600)):
        document = {
            "images": [{"id": 1, "width": width, "height": 3 * width // 4, "file_name": "1.png"}],
            "annotations": [{"id": 1, "image_id": 1, "bbox": [20, 20, 4, 4], "category_id": 1}],
        }
        (tmp_path / f"{name}.json").write_text(json.dumps(document))
        folder = write_sequence(tmp_path / name, "1,-1,20,20,4,4,0.9\n", size=(width, 3 * width // 4))
        sources.append(tmp_path / f"{name}.json" if form == "coco" else folder)
    report, _ = imported(form, *sources, cameras=tmp_path / "cameras.yaml", rates=10.0)
    (warning,) = report["warnings"]
    assert warning.startswith("camera right: its images have 1600 x 1200 px, and its intrinsics are those of 800 x 600")


def test_an_identity_that_no_integer_holds_is_refused(tmp_path: Path, imported: Import) -> None:
    images = [{"id": 1, "file_name": "a/frame_000000.png", "width": 64, "height": 48}]
    boxes = [{"id": 1, "image_id": 1, "bbox": [0, 0, 1, 1], "track_id": 1e300}]
    (tmp_path / "labels.json").write_text(json.dumps({"images": images, "annotations": boxes}))
    with pytest.raises(InputError, match="expected whole identities of objects"):
        imported("coco", tmp_path / "labels.json", rates=2.0)


@pytest.mark.parametrize(
    ("rate", "length", "message"),
    [("nan", "4", "frames per second > 0"), ("10", "9223372036854775808", "expected at most 1000000000")],
)
def test_what_a_sequence_says_of_itself_is_checked(
    tmp_path: Path, imported: Import, rate: str, length: str, message: str
) -> None:
    folder = write_sequence(tmp_path / "north", "1,-1,1,1,1,1,0.9\n")
    info = folder / "seqinfo.ini"
    info.write_text(info.read_text().replace("Rate=10.0", f"Rate={rate}").replace("Length=4", f"Length={length}"))
    with pytest.raises(InputError, match=message):
        imported("mot", folder)


def test_files_of_yolo(tmp_path: Path, imported: Import) -> None:
    for camera, rows in (("north", "0 0.5 0.5 0.25 0.5 0.9\n1 0.1 0.2 0.1 0.1 0.3\n"), ("south", "")):
        folder = tmp_path / camera / "labels"
        folder.mkdir(parents=True)
        (folder / "street_2.txt").write_text(rows)
        (folder / "street_4.txt").write_text("0 0.005 0.005 0.01 0.01 0.8\n")
        (folder / "classes.txt").write_text("person\n")
    stated = {"rates": 2.0, "image_sizes": (100, 200)}
    _, out = imported("yolo", tmp_path / "north", tmp_path / "south" / "labels", least_score=0.5, **stated)
    # the corner of the image is the corner of the first pixel
    assert log_rows(out / "detections.parquet") == [
        (0.5, "north", 2, 49.5, 99.5),
        (0.5, "south", 2, None, None),
        (1.0, "north", 3, None, None),
        (1.0, "south", 3, None, None),
        (1.5, "north", 4, 0.0, 0.5),
        (1.5, "south", 4, 0.0, 0.5),
    ]
    table = pq.read_table(out / "detections.parquet").to_pydict()
    assert (table["width_px"][0], table["height_px"][0]) == (25.0, 100.0)
    _, out = imported("yolo", tmp_path / "north", box_point="bottom", **stated)
    assert log_rows(out / "detections.parquet")[0] == (0.5, "north", 2, 49.5, 149.5)
    (tmp_path / "north" / "labels" / "street_0.txt").write_text("0 0.5 0.5 0.25 0.5 0.9\n")
    _, out = imported("yolo", tmp_path / "north", **stated)
    assert log_rows(out / "detections.parquet")[0] == (0.0, "north", 0, 49.5, 99.5)
    with pytest.raises(InputError, match=r"boxes are shares of images: .* expected the size of the images"):
        imported("yolo", tmp_path / "north", rates=2.0)
    (tmp_path / "north" / "labels" / "street_4.txt").write_text("0 0.5 0.5\n")
    with pytest.raises(InputError, match=r"street_4.txt: expected rows of numbers: class, x, y"):
        imported("yolo", tmp_path / "north", **stated)
