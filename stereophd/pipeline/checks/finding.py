"""A finding: the outcome of one check, with its evidence, the likely cause and a remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

Status = Literal["ok", "warning", "not checked"]


@dataclass(frozen=True)
class Finding:
    """The outcome of one check.

    Attributes
    ----------
    name : str
        The check, such as ``geometry.rays``.
    status : {"ok", "warning", "not checked"}
    message : str
        What was found, with the likely cause of a warning. One or two sentences.
    value, expected : float, str or None
        The figure that was found, and the one that a correct set-up has.
    camera : str or None
        The camera that is concerned; None: all of them.
    remedy : str or None
        What to change.
    cause : str or None
        Short name of the likely cause, such as ``rotation_transposed``; stable, for programs.
    """

    name: str
    status: Status
    message: str
    value: float | str | None = None
    expected: float | str | None = None
    camera: str | None = None
    remedy: str | None = None
    cause: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the finding as JSON-able data."""
        return asdict(self)


def warnings_of(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Return the findings that are warnings."""
    return tuple(finding for finding in findings if finding.status == "warning")


def count_warnings(report: Mapping[str, Any]) -> int:
    """Return how many checks of a report (its ``checks``, as JSON) warn."""
    return sum(found["status"] == "warning" for found in report["checks"])
