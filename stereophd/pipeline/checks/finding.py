"""A finding: the outcome of one check, with its evidence, the likely cause and a remedy."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

Status = Literal["ok", "warning", "not checked"]
# Cause of findings after which only a calibration makes tracks possible, and their remedy.
DO_NOT_MEET = "rays_do_not_meet"
ERRORS_LAST = "errors_last"
LASTING_REMEDY = "look for what smooths the detections, state more noise (sigma_px), or refine the cameras (calibrate)"
# Checks before the run, and of the tracks' errors, whose warnings change what tracks show.
MISLEADING = (
    "detector.clutter", "detector.pairs", "detector.sigma", "geometry.cause", "geometry.residuals", "tracking.errors",
    "tracking.noise",
)  # fmt: skip
CHECK_CAMERAS = "check the poses, intrinsics and clocks of both cameras; calibrate can estimate the poses"


@dataclass(frozen=True)
class Finding:
    """The outcome of one check."""

    name: str  # The check, such as ``geometry.rays``
    status: Status
    message: str  # What was found, with the likely cause of a warning. One or two sentences.
    # `value`, `expected`: The figure that was found, and the one that a correct set-up has.
    value: float | str | None = None
    expected: float | str | None = None
    camera: str | None = None  # The camera that is concerned; None: all of them
    remedy: str | None = None  # What to change
    cause: str | None = None  # Short name of the likely cause, such as ``rotation_transposed``; stable, for programs
    change: str | None = None  # KEY=VALUE of the configuration that follows the remedy

    def as_dict(self) -> dict[str, Any]:
        """Return the finding as JSON-able data."""
        return asdict(self)


def warnings_of(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Return the findings that are warnings."""
    return tuple(finding for finding in findings if finding.status == "warning")


def is_mistake(found: Finding) -> bool:
    """Whether a finding names a mistake in times, pixels or cameras: until it is corrected, what follows is untrue.

    Frames at another rate than the stated one are none: the times can be right.
    """
    if found.name == "log.frame_rate":
        return found.status == "warning" and found.cause != "frame_rate"
    causes = ("pixels_normalised", "too_few_cameras", "length_unit", "poses_equal")
    names_one = found.name in ("geometry.cause", "geometry.boxes", "camera.focal_length") or found.cause in causes
    return names_one and found.status == "warning" and found.cause != DO_NOT_MEET


def is_overstated(found: Finding) -> bool:
    """Whether a finding warns of a noise that is stated larger than it was measured."""
    stated, measured, warns = found.value, found.expected, (found.name, found.status) == ("detector.sigma", "warning")
    return warns and isinstance(stated, float) and isinstance(measured, float) and stated > measured


def misleads(found: Finding) -> bool:
    """Whether a finding warns of what changes tracks, so that what they show may follow from it."""
    is_alike = found.name in MISLEADING and found.status == "warning" and not is_overstated(found)
    return is_alike or is_mistake(found)


def once_mended(shown: Iterable[Finding], before: tuple[Finding, ...], but: tuple[str, ...] = ()) -> Iterator[Finding]:
    """Yield what tracks show, no warning where one `before` misleads, but for those of the checks or causes `but`."""
    first = next((one.name for one in before if misleads(one) and not {one.name, one.cause} & set(but)), None)
    for one in shown:
        if first is not None and one.status == "warning":
            text = f"{one.message}; mend what {first} warns of first"
            one = replace(one, status="not checked", message=text, remedy=None, cause=None, change=None)
        yield one


def count_warnings(report: Mapping[str, Any]) -> int:
    """Return how many checks of a report (its ``checks``, as JSON) warn."""
    return sum(found["status"] == "warning" for found in report["checks"])
