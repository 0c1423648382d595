"""A draft of a configuration: values, each with the reason for it, those to begin with, and the text."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import yaml

from stereophd.core.motion.settings import motion_models
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.io.cameras.models import CameraConfig, CovarianceRows
from stereophd.io.cameras.writing import CONVENTIONS, cameras_text
from stereophd.pipeline.checks.finding import DO_NOT_MEET, Finding, is_mistake
from stereophd.site import page
from stereophd.validated import METRES

# The first line, by which `init` knows a file of its own.
MARK = "# Written by stereophd init"
WIDTH = 110
# Standard deviations of the priors of a calibration: of angles, in degrees at least, where cameras do not agree, and
# over the angle of the noise, and of centres over their distance.
LEAST_ANGLE_DEG, WRONG_ANGLE_DEG, ANGLE_NOISES, LEAST_CENTER = 1.0, 10.0, 5.0, 0.01
# Of the logarithm of a focal length that is unknown: the width of the image, within a factor of 1.6.
UNKNOWN_FOCAL_STD = 0.47
# Sections in the order of the file.
SECTIONS = ("object", "motion", "region", "filter", "report", "evaluation")


def config_text(draft: Draft, version: str, source: str, cameras_file: str) -> str:
    """Return the text of a draft.

    `version` is that of the program, `source` says in words where the values come from, and `cameras_file` is the path
    of the cameras for a draft that holds none.
    """
    lines = [f"{MARK} {version}, {source}."]
    lines += _comment(
        [
            "Each comment names the source of the value below it. Every key is described at",
            page("reference/configuration"),
            *draft.head,
        ],
        0,
    )
    values = draft.values()
    lines += _comment(["Images do not show the unit: is it that of the centres of the cameras?"], 0)
    lines += [f"units: {{length: {draft.unit}}}", f"seed: {values.pop('seed', 0)}", ""]
    lines += _cameras(draft, cameras_file)
    others = [section for section in values if section not in (*SECTIONS, "units")]
    for section in (*SECTIONS, *others):
        if section in draft.choices:  # a plain value, or a section given whole
            lines += [f"{section}: {scalar(values[section])}", ""]
        elif section in values:
            lines += [f"{section}:", *_entries(draft, values[section], section, 1), ""]
    if "calibration" not in values and (calibration := list(_calibration(draft))):
        lines += [
            "# For `stereophd calibrate`: how well poses are known. These standard deviations are guesses: edit them,",
            "# and where nobody measured a clock or a lens, add clock_offset_std_s: 0.1 or distortion_std: {k1: 0.1}.",
        ]
        lines += [line if draft.must_be_calibrated else f"# {line}" for line in calibration]
    return "\n".join(lines).rstrip() + "\n"


def _calibration(draft: Draft) -> Iterator[str]:
    """Yield a section ``calibration``, with priors of the size that the noise and the depths suggest."""
    cameras = [camera.build(name) for name, camera in draft.cameras.items()]
    is_wrong, depths = draft.must_be_calibrated, draft.choices["filter.birth.depth_range"].value
    if len(cameras) < 2 or not all(camera.pose.is_static for camera in cameras):
        return
    if not is_wrong and not isinstance(depths, list):  # births by disparity
        return
    reference, *others = cameras
    distances = [float(np.linalg.norm(camera.pose.center - reference.pose.center)) for camera in cameras]
    yield "calibration:"
    yield f"  reference: {scalar(reference.name)}"
    yield "  priors:"
    for camera, apart in zip(cameras, distances, strict=True):
        prior = {}
        if camera is not reference:
            # where poses are wrong no depth is known
            depth, least = (apart, WRONG_ANGLE_DEG) if is_wrong else (float(np.sqrt(np.prod(depths))), LEAST_ANGLE_DEG)
            angle = max(least, np.rad2deg(ANGLE_NOISES * float(camera.detector.sigma.mean()) / camera.fx))
            std = max(np.deg2rad(angle) * depth, LEAST_CENTER * apart)
            prior = {"rotation_std_deg": rounded(angle), "center_std": rounded(std)}
        if draft.cameras[camera.name].intrinsics.unknown:
            prior["focal_std"] = UNKNOWN_FOCAL_STD
        if prior:
            yield f"    {scalar(camera.name)}: {scalar(prior)}"
    yield "  # Moving objects do not show the scale. A distance that you have measured, such as that of two cameras,"
    yield f"  # fixes it ({draft.unit}); without it the scale is that of the centres above, as far as they are known."
    yield (
        f"  # scale: {{kind: baseline, cameras: {scalar([reference.name, others[0].name])}, "
        f"distance: {rounded(distances[1], 4)}, std: {rounded(0.005 * distances[1])}}}"
    )


def _entries(draft: Draft, values: dict[str, Any], path: str, level: int) -> Iterator[str]:
    """Yield the lines of a section, comments before the values."""
    indent = "  " * level
    for key, value in values.items():
        place = f"{path}.{key}"
        if isinstance(value, dict) and place not in draft.choices:
            yield f"{indent}{key}:"
            yield from _entries(draft, value, place, level + 1)
            continue
        yield from _comment([draft.choices[place].reason], level)
        yield f"{indent}{key}: {scalar(value)}"


def _comment(sentences: Iterable[str], level: int) -> Iterator[str]:
    prefix = "  " * level + "# "
    for sentence in sentences:
        yield from textwrap.wrap(
            sentence, WIDTH, initial_indent=prefix, subsequent_indent=prefix, break_long_words=False,
            break_on_hyphens=False,
        )  # fmt: skip


def scalar(value: Any) -> str:
    """Return a value as YAML on one line, quoted where it must be."""
    text: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=1000)
    return text.removesuffix("\n").removesuffix("\n...")


def _cameras(draft: Draft, cameras_file: str) -> Iterator[str]:
    if not draft.cameras:
        yield "# The file of the cameras, relative to this one; its form is described at"
        yield f"# {page('reference/formats')}"
        yield f"cameras: {cameras_file}"
        yield ""
        return
    yield from textwrap.wrap(CONVENTIONS.strip().removeprefix("# "), WIDTH, initial_indent="# ", subsequent_indent="# ")
    yield "cameras:"
    for name, camera in draft.cameras.items():
        yield from _comment(draft.camera_notes.get(name, ()), 1)
        text = cameras_text({name: camera}, draft.unit)
        yield from text.split("cameras:\n", 1)[1].rstrip("\n").splitlines()
    yield ""
    if draft.covariance:
        yield from _comment(["What a calibration left uncertain of them: covariances, rows of a lower triangle"], 0)
        yield "cameras_covariance:"
        yield from (f"  {scalar(name)}: {scalar(row)}" for name, row in draft.covariance.items())
        yield ""


Kind = Literal["animals", "drones", "lab"]


@dataclass(frozen=True)
class Choice:
    """A value of the configuration, and where it comes from."""

    value: Any  # As YAML holds it
    reason: str  # A sentence for the comment
    measured: bool = True  # Whether the log or the cameras gave it, and not a template


@dataclass(frozen=True)
class Draft:
    """A configuration in the making."""

    unit: str  # Unit of lengths
    cameras: dict[str, CameraConfig]  # By name; empty where none are known
    choices: dict[str, Choice]  # Dotted key -> choice, in the order of the file
    camera_notes: dict[str, tuple[str, ...]] = field(default_factory=dict)  # Comments on each camera
    head: tuple[str, ...] = ()  # Comments at the top of the file
    findings: tuple[Finding, ...] = ()  # What is doubtful of the estimates
    given: frozenset[str] = frozenset()  # Keys and sections that the user states: nothing changes them
    covariance: CovarianceRows | None = None  # Of the cameras
    usual_acceleration: float | None = None  # The most probable one, once it was estimated

    @property
    def is_unplaced(self) -> bool:
        """Whether a pose, a clock or a focal length is unknown, so that rays show nothing."""
        return any(camera.unknown_key for camera in self.cameras.values())

    @property
    def must_be_searched(self) -> bool:
        """Whether a pose or a clock is unknown, so that `calibrate` searches for all poses."""
        return any(camera.must_be_found for camera in self.cameras.values())

    @property
    def must_be_calibrated(self) -> bool:
        """Whether something is unknown of a camera, or poses are so wrong that no tracks follow from them."""
        return self.is_unplaced or any(found.cause == DO_NOT_MEET for found in self.findings)

    @property
    def must_be_corrected(self) -> bool:
        """Whether a mistake is named with which neither tracks nor a calibration are right."""
        return any(map(is_mistake, self.findings))

    def with_choices(self, changes: Mapping[str, Choice]) -> Draft:
        """Return the draft with other values, save those that are given."""
        new = {key: choice for key, choice in changes.items() if not self.is_given(key)}
        return replace(self, choices={**self.choices, **new})

    def is_given(self, key: str) -> bool:
        """Whether the user states the value of a key, or a section that holds it."""
        return any(f"{key}.".startswith(f"{stated}.") for stated in self.given)

    def with_given(self, values: Mapping[str, Any]) -> Draft:
        """Return the draft with values of the user."""
        choices = {key: Choice(value, "given") for key, value in values.items()}
        return replace(self.with_choices(choices), given=self.given | choices.keys())

    def values(self) -> dict[str, Any]:
        """Return the values as the sections of a configuration, without cameras."""
        sections: dict[str, Any] = {"units": {"length": self.unit}}
        for key, choice in self.choices.items():
            *folders, name = key.split(".")
            place = sections
            for folder in folders:
                place = place.setdefault(folder, {})
            place[name] = choice.value
        return sections


@dataclass(frozen=True)
class Scale:
    """Values that objects of a kind usually have, in metres and seconds."""

    what: str
    depth_range: tuple[float, float]
    velocity_std: float
    max_speed: float
    acceleration_std: float
    births_per_s: float


SCALES: dict[Kind, Scale] = {
    "animals": Scale("flying or swimming animals", (0.3, 15.0), 2.0, 20.0, 5.0, 0.5),
    "drones": Scale("drones", (5.0, 200.0), 5.0, 30.0, 2.5, 0.05),
    "lab": Scale("objects moved by hand or walking", (0.3, 5.0), 0.5, 5.0, 0.5, 0.2),
}


def rounded(value: float, digits: int = 2) -> float:
    """Return a value with `digits` significant digits."""
    return float(f"{value:.{digits}g}")


def template(unit: str, cameras: dict[str, CameraConfig], kind: Kind) -> Draft:
    """Return a draft with the usual values of a kind of object, in the unit of the cameras."""
    scale, one = SCALES[kind], METRES.get(unit, 1.0)  # an unknown baseline may be a metre
    usual = f"not measured: usual for {scale.what}"

    def length(value: float) -> float:
        return rounded(value / one, 3)

    near, far = map(length, scale.depth_range)

    def guess(value: Any, advice: str) -> Choice:
        return Choice(value, f"{usual}; {advice}", measured=False)

    others = ", ".join(word for word in motion_models() if word != "constant_velocity")
    choices = {
        "motion.model": Choice("constant_velocity", f"with white acceleration; other models: {others}"),
        "motion.acceleration_std": guess(
            length(scale.acceleration_std),
            f"by how much the velocity changes in a second, {unit}/s^2; `estimate` takes it from the log",
        ),
        "motion.max_speed": guess(length(scale.max_speed), f"above the fastest object, {unit}/s"),
        "filter.kind": Choice("pmb", "labelled tracks; phd is the paper's filter"),
        "filter.survival_per_s": Choice(
            FilterSettings.survival_per_s, "the default: exp(-1 / mean time in view, s)", measured=False
        ),
        "filter.birth.per_s": guess(scale.births_per_s, "new objects per second in the view of a camera"),
        "filter.birth.depth_range": guess(
            [near, far], f"nearest and farthest depth at which objects appear in front of a camera, {unit}"
        ),
        "filter.birth.velocity_std": guess(length(scale.velocity_std), f"typical speed divided by 1.7, {unit}/s"),
        "evaluation.cutoff": guess(
            length(0.1 * (scale.depth_range[0] * scale.depth_range[1]) ** 0.5),
            f"largest position error at which an object still counts as found, {unit}",
        ),
    }
    draft = Draft(unit, cameras, choices)
    if draft.must_be_searched:
        known = [name for name, camera in cameras.items() if not camera.must_be_found]
        reason = (
            "poses and clocks that are unknown are found from the tracks; this camera is the origin, with the true "
            "clock; without a measured distance (scale: {kind: baseline, ...}) the distance of two cameras is 1"
        )
        return draft.with_choices({"calibration.reference": Choice(next(iter([*known, *cameras])), reason)})
    return draft
