"""COCO: detections in JSON, as annotations (``images``, ``annotations``) of one camera per file or of several in one.

A camera is the folder in an image's ``file_name`` where there are several folders, else the file. The frame is the
image's ``frame_id`` (or ``frame_index``), else the last number in its file name, else its place among the images.
Every image without annotations is an empty frame. The detection is the centre of the box, whose width and
height are kept (or the middle of its lower side), or each visible keypoint of an annotation without a box.

Conventions: a box is left, top, width, height measured from the corner of the top-left pixel, so pixels are shifted
by half a pixel; keypoints are pixel indices and stay as they are. The whole file is held in memory, as JSON needs.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from stereophd.io.documents import expecting
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.pixels import native_pixels

Annotation = Mapping[str, Any]


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read detections."""
    recording = ForeignRecording(files=list(sources))
    recording.assumed.append(f"the detection is the {options.box_point} of its box")
    recording.pieces = _pieces(sources, options, recording)
    return recording


def _pieces(sources: Sequence[Path], options: ImportOptions, recording: ForeignRecording) -> Iterator[Piece]:
    for path in sources:
        with expecting("COCO's images and annotations", path):
            document = json.loads(path.read_text(encoding="utf-8-sig"))
            yield from _split(path, document["images"], document["annotations"], options, recording)


def _split(
    path: Path,
    images: Sequence[Annotation],
    annotations: Sequence[Annotation],
    options: ImportOptions,
    recording: ForeignRecording,
) -> Iterator[Piece]:
    of_image: dict[Any, list[Annotation]] = {}
    for annotation in annotations:
        of_image.setdefault(annotation["image_id"], []).append(annotation)
    folders = {str(PurePosixPath(image.get("file_name", "")).parent) for image in images}
    numbers = _frame_numbers(path, images, recording)
    rows: dict[str, list[tuple[float, ...]]] = {}
    for image, number in zip(images, numbers, strict=True):
        folder = PurePosixPath(image.get("file_name", "")).parent.name
        camera = options.name(folder if len(folders) > 1 and folder else path.stem)
        found = [row for a in of_image.get(image["id"], ()) for row in _detections(a, options)]
        if "width" in image and "height" in image:
            recording.image_sizes.setdefault(camera, (int(image["width"]), int(image["height"])))
        rows.setdefault(camera, []).extend((number, *row) for row in found or [(np.nan,) * 7])
    for camera, values in rows.items():
        table = np.array(values, dtype=np.float64)
        # the second shift marks boxes, which are measured from a corner
        pixels = table[:, 1:3] - table[:, 5:6]
        extra = {"score": table[:, 3], "object_id": table[:, 4], "width_px": table[:, 6], "height_px": table[:, 7]}
        yield Piece(path, camera, native_pixels(pixels, camera, options, recording), table[:, 0], extra=extra)


def _frame_numbers(path: Path, images: Sequence[Annotation], recording: ForeignRecording) -> list[float]:
    for key in ("frame_id", "frame_index", "frame_number"):
        if all(key in image for image in images):
            return [float(image[key]) for image in images]
    found = [re.findall(r"\d+", PurePosixPath(image.get("file_name", "")).stem) for image in images]
    if all(found):
        recording.assumed.append(f"{path.name}: the frame is the last number in the name of its image")
        return [float(words[-1]) for words in found]
    recording.assumed.append(f"{path.name}: the images are frames in the order of the file, from 0")
    return [float(index) for index in range(len(images))]


def _detections(annotation: Annotation, options: ImportOptions) -> Iterator[tuple[float, ...]]:
    """Yield (u, v, score, object, shift, width, height) of an annotation; NaN where there is no box."""
    score = float(annotation.get("score", np.nan))
    identity = annotation.get("track_id", annotation.get("instance_id"))
    number = np.nan if identity is None else float(identity)
    if annotation.get("bbox"):
        left, top, width, height = map(float, annotation["bbox"])
        if options.box_point == "bottom":
            yield left + width / 2, top + height, score, number, 0.5, np.nan, np.nan
        else:
            yield left + width / 2, top + height / 2, score, number, 0.5, width, height
        return
    keypoints = annotation.get("keypoints", ())
    for index in range(0, len(keypoints) - 2, 3):
        u, v, visibility = keypoints[index : index + 3]
        if visibility > 0:
            yield float(u), float(v), score, float(index // 3), 0.0, np.nan, np.nan


FORMAT = Format("COCO: detections (JSON)", read=read)
