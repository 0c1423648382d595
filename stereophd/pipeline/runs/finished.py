"""Whether an output folder holds the finished results of a run already."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stereophd.errors import InputError
from stereophd.io.outputs.atomic import tidy

REPORT_FILE = "report.json"


def finished_report(folder: Path | str, record: Mapping[str, Any], force: bool) -> dict[str, Any] | None:
    """Return the report of a run that is finished in an output folder; None if there is none, or it is to be replaced.

    `record` is the provenance of the wanted run (`stereophd.io.outputs.provenance.provenance`). Raises InputError if
    the folder holds the results of another configuration or of other inputs, which only `force` lets a run replace.
    """
    path = Path(folder) / REPORT_FILE
    tidy(path.parent)
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); use `force=True` to start anew") from error
    if isinstance(report, dict) and report.get("provenance") == record:
        return report
    if force:
        return None
    raise InputError(
        f"output folder {folder} holds the results of another configuration, log or version; use `force=True` to "
        "replace them"
    )
