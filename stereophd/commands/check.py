"""Check whether a detection log fits the cameras and the settings of a configuration."""

from pathlib import Path
from typing import Any

from stereophd.config.loading import LoadedConfig
from stereophd.io.outputs.provenance import provenance
from stereophd.pipeline.batch.names import expand
from stereophd.pipeline.checks.finding import warnings_of
from stereophd.pipeline.checks.run import check_log

REPORT_VERSION = 1


def check(loaded: LoadedConfig, log_path: Path | str) -> dict[str, Any]:
    """Check a log, or a folder that holds one, against a configuration with cameras; nothing is written.

    Returns ``report_version``, ``warnings`` (their number), ``checks`` (the fields of
    `stereophd.pipeline.checks.finding.Finding`, one entry a check) and ``provenance``. Raises InputError if the
    configuration has no cameras, or the log is not usable.
    """
    [log_path] = expand([log_path])
    findings = check_log(loaded, log_path)
    return {
        "report_version": REPORT_VERSION,
        "warnings": len(warnings_of(findings)),
        "checks": [finding.as_dict() for finding in findings],
        "provenance": provenance("check", loaded.record, inputs={"detections": log_path}),
    }
