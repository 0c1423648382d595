"""The one way to JSON: reports, timings, what a command prints."""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stereophd.errors import InputError

#: Version of all reports; a change that a reader could trip over is a new one.
REPORT_VERSION = 1


def json_text(value: Any, ascii_only: bool = False) -> str:
    """Return a value as indented JSON; NaN and infinity become null, arrays become lists."""
    return json.dumps(plain(value), indent=2, ensure_ascii=ascii_only, allow_nan=False)


def write_json(path: Path | str, value: Any) -> None:
    """Write a value as JSON, in UTF-8."""
    Path(path).write_text(json_text(value) + "\n", encoding="utf-8")


def read_report(path: Path) -> dict[str, Any] | None:
    """Return the report in a file, which names its provenance; None if there is no file.

    Raises InputError when it cannot be read, or is no report of stereophd.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except RecursionError:
        raise InputError(f"{path}: expected a report of stereophd, found JSON nested too deeply") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if not isinstance(document, dict) or not isinstance(document.get("provenance"), dict):
        raise InputError(f"{path}: expected a report of stereophd, found none of its keys")
    return document


def finite_or_none(value: Any) -> float | None:
    """Return a number as a float, or None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None


def plain(value: Any, of_float: Callable[[float], Any] = finite_or_none) -> Any:
    """Return a value of dicts, lists, texts and numbers that JSON knows; by default NaN and infinity become None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item, of_float) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, of_float) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist(), of_float)
    return of_float(value) if isinstance(value, float) else value


def infinity_as_text(value: Any) -> Any:
    """Return a value with infinities as text, which JSON lacks; a configuration that is read again takes them back."""
    return plain(value, lambda number: str(number) if math.isinf(number) else number)
