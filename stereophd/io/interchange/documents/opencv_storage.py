"""The files that OpenCV's ``FileStorage`` and NumPy write, as plain dictionaries of arrays, numbers and text."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.errors import InputError
from stereophd.io.documents import SAFE_LOADER, expecting, load_npz, load_yaml, read_bytes

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
    return "%YAML:1.0\n---\n" + "".join(_yaml_lines(document, 0))


def _yaml_lines(document: dict[str, Any], depth: int) -> list[str]:
    indent = "   " * depth
    lines = []
    for key, value in document.items():
        if isinstance(value, dict):
            lines += [f"{indent}{key}:\n", *_yaml_lines(value, depth + 1)]
        elif isinstance(value, np.ndarray):
            matrix = np.atleast_2d(value) if value.ndim > 1 else value.reshape(-1, 1)
            numbers = ", ".join(_yaml_number(x) for x in matrix.ravel().tolist())
            rows, cols = matrix.shape
            entries = (f"rows: {rows}", f"cols: {cols}", "dt: d", f"data: [ {numbers} ]")
            lines.append(f"{indent}{key}: !!opencv-matrix\n")
            lines += [f"{indent}   {entry}\n" for entry in entries]
        else:
            lines.append(f"{indent}{key}: {value}\n")
    return lines


def _yaml_number(value: float) -> str:
    """Return a number with all its digits, and a point in it: OpenCV takes one without for an integer."""
    text = repr(value)
    mantissa, _, exponent = text.partition("e")
    if "." not in mantissa:
        mantissa += "."
    return f"{mantissa}e{exponent}" if exponent else mantissa
