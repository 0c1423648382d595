"""OpenCV calibrations: YAML (also with the line ``%YAML:1.0``), XML, JSON as ``FileStorage`` writes them, and NPZ.

Quantities are found by their usual names, in any case: the camera matrix (``K``, ``camera_matrix``, ``mtx``, ``M``),
lens coefficients (``D``, ``dist``, ``distortion_coefficients``), and the pose by ``rvec`` and ``tvec`` or by ``R``
and ``T``. A camera is a mapping of its name, a part of the names (``K1``, ``left_K``, ``K_left``), or a file of its
own, named as the file. Where two cameras are there and one R, T without a name, as ``stereoCalibrate`` returns them,
the first camera is at the origin and R, T map its axes to those of the second. Without any pose all are unknown.

Conventions: pixels and camera axes are the native ones. ``x_camera = R x_world + T``, so the centre is ``-R^T T``.
Coefficients: k1, k2, p1, p2, k3, k4, k5, k6; four of a fisheye where ``fisheye_model`` (or a similar key) is set.
Lengths have the unit of the calibration board, which the files do not name.
"""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.documents import SAFE_LOADER, expecting, load_npz, load_yaml, read_bytes
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions
from stereophd.io.interchange.cameras import Parts, image_size, put_together, take_apart, unit

#: Quantity -> the names it goes by, in lower case and without separators.
ALIASES: Mapping[str, tuple[str, ...]] = {
    "matrix": ("cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx", "kmat", "k", "m"),
    "coefficients": (
        "distortioncoefficients",
        "distcoeffs",
        "distcoefs",
        "distcoeff",
        "distortions",
        "distortion",
        "dist",
        "d",
    ),
    "rotation": ("rotationmatrix", "rotationvector", "rotation", "rvec", "rmat", "rot", "r"),
    "translation": ("translationvector", "translation", "tvec", "trans", "t"),
    "size": ("imagesize", "imgsize", "resolution", "size"),
    "width": ("imagewidth", "imgwidth", "width"),
    "height": ("imageheight", "imgheight", "height"),
    "fisheye": ("fisheyemodel", "isfisheye", "fisheye"),
    "views": ("rvecs", "tvecs"),
    "unit": ("lengthunit",),
}
# Endings that name a camera where no separator divides them from the rest (K1, mtxL).
_TAG = r"(?:cam(?:era)?)?\d+|left|right|l|r"
# Matrices of a rectified pair: their R1, R2 are rectifying rotations, no poses.
_RECTIFICATION = ("Q", "P1", "P2")


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read the cameras of calibration files."""
    recording = ForeignRecording(files=list(sources))
    cameras: dict[str, dict[str, Any]] = {}
    for path in sources:
        for name, values in _cameras_of(path).items():
            cameras.setdefault(name, {}).update(values)
    where = ", ".join(str(path) for path in sources)
    pair = cameras.pop("", {})
    cameras = {name: values for name, values in cameras.items() if "matrix" in values}
    if not cameras:
        raise InputError(f"{where}: expected a camera matrix (K, camera_matrix, mtx), found none")
    if pair and {"rotation", "translation"} <= pair.keys() and not any("rotation" in c for c in cameras.values()):
        _place_pair(cameras, pair, where, recording)
    stated = pair.get("unit") if options.length_unit is None else None
    recording.length_unit = str(stated) if stated else unit(options, recording)
    if any("rotation" in values for values in cameras.values()):
        recording.assumed.append("poses map the world to the camera: x_camera = R x_world + T")
    of_all = {key: pair[key] for key in ("size", "width", "height", "fisheye") if key in pair}
    for name, values in cameras.items():
        native = options.name(name)
        recording.cameras[native] = _camera(native, of_all | values, options, where, recording)
    return recording


def _place_pair(
    cameras: dict[str, dict[str, Any]], pair: Mapping[str, Any], where: str, recording: ForeignRecording
) -> None:
    """Place a stereo pair: the first camera at the origin."""
    if len(cameras) == 1:
        next(iter(cameras.values())).update(pair)
        return
    if len(cameras) != 2:
        raise InputError(f"{where}: expected R and T of each camera, found one for {len(cameras)} cameras")
    first, second = cameras
    cameras[first] |= {"rotation": np.eye(3), "translation": np.zeros(3)}
    cameras[second] |= {"rotation": pair["rotation"], "translation": pair["translation"]}
    recording.assumed.append(
        f"the world is camera {first}; R, T lead from it to {second}, as stereoCalibrate returns them"
    )


def _cameras_of(path: Path) -> dict[str, dict[str, Any]]:
    """Return the quantities in a file by camera; those without a camera's name under ``""`` or the file's name."""
    document = read_document(path)
    cameras: dict[str, dict[str, Any]] = {}
    nested = document.get("cameras", document)
    if isinstance(nested, list):
        nested = {str(item.get("name", index)): item for index, item in enumerate(nested) if isinstance(item, dict)}
    for name, value in nested.items() if isinstance(nested, dict) else ():
        if isinstance(value, dict):
            found = {quantity: v for key, v in value.items() for quantity, _ in [_quantity(key)] if quantity}
            if "matrix" in found:
                cameras[name] = found
    rectified = any(key in document for key in _RECTIFICATION)
    untagged: dict[str, Any] = {}
    for key, value in document.items():
        quantity, tag = _quantity(key)
        if quantity is None or isinstance(value, dict) or (rectified and tag and quantity == "rotation"):
            continue
        (cameras.setdefault(tag, {}) if tag else untagged)[quantity] = value
    if "matrix" in untagged:
        cameras[path.stem] = untagged
    elif untagged:
        cameras[""] = untagged
    return cameras


def _quantity(key: str) -> tuple[str | None, str]:
    """Return which quantity a key names (None: none), and the part of it that names a camera."""
    plain = re.sub(r"[\s_\-.]", "", key).lower()
    for quantity, aliases in ALIASES.items():
        if plain in aliases:
            return quantity, ""
    words = re.split(r"[\s_\-.]+", key)
    for count in range(len(words) - 1, 0, -1):
        for rest, tag in ((words[:count], words[count:]), (words[-count:], words[:-count])):
            for quantity, aliases in ALIASES.items():
                if "".join(rest).lower() in aliases:
                    return quantity, "_".join(tag)
    for quantity, aliases in ALIASES.items():
        match = re.fullmatch(rf"(?:{'|'.join(aliases)})({_TAG})", plain)
        if match:
            return quantity, match[1]
    return None, ""


def _camera(
    name: str, values: Mapping[str, Any], options: ImportOptions, where: str, recording: ForeignRecording
) -> CameraConfig:
    posed = {"rotation", "translation"} & values.keys()
    if len(posed) == 1:
        raise InputError(f"{where}: {name}: expected a pose (rvec and tvec, or R and T), found its {posed.pop()} alone")
    more = {} if posed else {"pose": "unknown"}
    if not posed:
        values = {**values, "rotation": np.eye(3), "translation": np.zeros(3)}
        board = ": rvecs and tvecs are poses of a board in several images" if "views" in values else ""
        recording.assumed.append(f"{name}: its pose is unknown: {where} has no rvec and tvec, or R and T, of it{board}")
    matrix = _array(values["matrix"], (3, 3), f"{where}: {name}: camera matrix")
    if matrix[0, 1] != 0.0:
        raise InputError(f"{where}: {name}: expected a camera matrix without skew, found K[0, 1] = {matrix[0, 1]:g}")
    rotation = _rotation(values["rotation"], f"{where}: {name}")
    translation = _array(values["translation"], (3,), f"{where}: {name}: translation")
    coefficients = np.asarray(values.get("coefficients", np.zeros(5)), dtype=np.float64).ravel()
    fisheye = str(values.get("fisheye", 0)).strip().lower() in ("1", "1.0", "true")
    sides = [values[side] for side in ("width", "height") if side in values]
    size = image_size(name, values.get("size", sides if len(sides) == 2 else None), options, where)
    parts = Parts(matrix, coefficients, fisheye, rotation, -rotation.T @ translation, size)
    return put_together(name, parts, options, where, **more)


def _rotation(value: Any, where: str) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.size == 3:
        return rotation_from_vector(array.ravel())
    return _array(array, (3, 3), f"{where}: rotation")


def _array(value: Any, shape: tuple[int, ...], where: str) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.size != np.prod(shape):
        raise InputError(f"{where}: expected {' x '.join(map(str, shape))} numbers, found shape {array.shape}")
    return array.reshape(shape)


def recognises_cameras(path: Path) -> bool:
    """Whether a file is of OpenCV's storage, or has a camera matrix and a pose by their usual names."""
    with open(path, "rb") as stream:
        head = stream.read(65536)
    is_storage = any(word in head for word in (b"%YAML:1.0", b"<opencv_storage", b"opencv-matrix"))
    if not is_storage and path.suffix.lower() not in (".npz", ".json", ".yaml", ".yml"):
        return False
    try:
        found = _cameras_of(path)
    except InputError:
        return is_storage
    # of a pair, R and T are of no camera alone
    return is_storage or {"matrix", "rotation"} <= {quantity for values in found.values() for quantity in values}


def write_cameras(cameras: Mapping[str, CameraConfig], length_unit: str, target: Path) -> list[str]:
    """Write all cameras into one YAML file of ``FileStorage``: a mapping of each camera's name."""
    document: dict[str, Any] = {"length_unit": length_unit}
    for name, config in cameras.items():
        parts = take_apart(name, config)
        document[_node_name(name)] = {
            "image_width": parts.size[0],
            "image_height": parts.size[1],
            "fisheye_model": int(parts.fisheye),
            "K": parts.matrix,
            "D": parts.coefficients,
            "R": parts.rotation,
            "T": parts.translation,
        }
    target.write_text(write_yaml(document), encoding="utf-8")
    return []


def _node_name(name: str) -> str:
    """Return a name as OpenCV allows it: letters, digits, minus and underscore, a letter or underscore first."""
    plain = re.sub(r"[^A-Za-z0-9_-]", "_", name)
    return plain if re.match(r"[A-Za-z_]", plain) else f"cam{plain}"


FORMAT = Format(
    "OpenCV: cameras in YAML, XML, JSON or NPZ",
    read=read,
    recognises_cameras=recognises_cameras,
    write_cameras=write_cameras,
)


# The first line that OpenCV writes is no YAML directive; YAML's own would be "%YAML 1.0".
_DIRECTIVE = re.compile(r"\A\ufeff?%YAML[: ]1\.\d\s*")


def read_document(path: Path) -> dict[str, Any]:
    """Return what a YAML, XML, JSON or NPZ file holds; matrices as arrays.

    Raises InputError when the file cannot be read, or is none of these.
    """
    content = read_bytes(path)
    if content[:2] == b"PK":
        return {name: array if array.ndim else array.item() for name, array in load_npz(path).items()}
    with expecting("YAML, XML, JSON or NPZ", path):
        text = content.decode("utf-8-sig")
        if text.lstrip().startswith("<"):
            document = _read_xml(text)
        elif text.lstrip().startswith("{"):
            document = _plain(json.loads(text))
        else:
            document = _plain(_read_yaml(text, str(path)))
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected named values, found something else")
    return document


def _read_yaml(text: str, where: str) -> Any:
    import yaml

    class Loader(SAFE_LOADER):  # type: ignore[misc]
        """SafeLoader that takes OpenCV's tags for what they are: mappings."""

    Loader.add_multi_constructor(
        "tag:yaml.org,2002:opencv", lambda loader, suffix, node: loader.construct_mapping(node, deep=True)
    )
    body = _DIRECTIVE.sub("", text)
    try:
        return load_yaml(body, where, Loader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error


def _read_xml(text: str) -> dict[str, Any]:
    import xml.etree.ElementTree as ElementTree

    root = ElementTree.fromstring(text)
    if root.tag != "opencv_storage":
        raise ValueError(f"XML with root {root.tag}, not opencv_storage")
    document: dict[str, Any] = _xml_value(root)
    return document


def _xml_value(element: Any) -> Any:
    if element.get("type_id") in ("opencv-matrix", "opencv-nd-matrix"):
        return _matrix({child.tag: (child.text or "").split() for child in element})
    if len(element):
        return {child.tag: _xml_value(child) for child in element}
    words = (element.text or "").split()
    numbers = [_number(word) for word in words]
    if numbers and all(number is not None for number in numbers):
        return numbers[0] if len(numbers) == 1 else np.array(numbers)
    return (element.text or "").strip().strip('"')


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _plain(value: Any) -> Any:
    """Turn matrices (mappings with ``data``) and lists of numbers into arrays, everywhere in a document."""
    if isinstance(value, dict):
        if "data" in value and {"rows", "sizes"} & value.keys():
            return _matrix(value)
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        try:
            array = np.array(value, dtype=np.float64)
        except (ValueError, TypeError):
            return [_plain(item) for item in value]
        return array if array.size else []
    return value


def _matrix(value: dict[str, Any]) -> Any:
    """Return a matrix of two dimensions (``rows``, ``cols``) or of any (``sizes``, OpenCV 5), with its channels."""

    def numbers(item: Any) -> list[float]:
        return [float(x) for x in (item if isinstance(item, list) else [item])]

    data = np.array(numbers(value["data"]))
    sizes = value["sizes"] if "sizes" in value else [*numbers(value["rows"]), *numbers(value["cols"])]
    shape = [int(size) for size in numbers(sizes)]
    return data.reshape(shape if len(data) == np.prod(shape) else (*shape, -1))


def write_yaml(document: dict[str, Any]) -> str:
    """Return the text of a document as OpenCV writes YAML; arrays become matrices of doubles, exactly."""
    import yaml

    class Dumper(yaml.SafeDumper):
        """SafeDumper with a point in every number that is no integer, as OpenCV needs it."""

    def represent(dumper: Any, array: Array) -> Any:
        rows, cols = array.shape if array.ndim > 1 else (array.size, 1)
        parts = {"rows": rows, "cols": cols, "dt": "d", "data": array.ravel().tolist()}
        return dumper.represent_mapping("tag:yaml.org,2002:opencv-matrix", parts)

    Dumper.add_representer(np.ndarray, represent)
    text = yaml.dump(document, Dumper=Dumper, sort_keys=False, default_flow_style=None, indent=3, width=1 << 30)
    return f"%YAML:1.0\n---\n{text}"
