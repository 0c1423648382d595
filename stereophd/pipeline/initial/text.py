"""A draft as commented YAML."""

import textwrap
from collections.abc import Iterable, Iterator
from typing import Any

import yaml

from stereophd.io.cameras.writing import CONVENTIONS, cameras_text
from stereophd.pipeline.initial.template import Draft
from stereophd.site import page

# The first line, by which `init` knows a file of its own.
MARK = "# Written by stereophd init"
WIDTH = 110
# Sections in the order of the file.
SECTIONS = ("object", "motion", "region", "filter", "report", "evaluation")

SMOOTHING = (
    "  # the whole log improves every position, and tracks begin at their first detection; it is then held in memory.",
    "  # null: no smoothing; {max_gap_s: 1.0}: over the whole log, across gaps of up to 1 s",
    "  smooth: null",
)


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
    values.setdefault("report", {})
    others = [section for section in values if section not in (*SECTIONS, "units")]
    for section in (*SECTIONS, *others):
        if section in draft.choices:  # a plain value, or a section given whole
            lines += [f"{section}: {_scalar(values[section])}", ""]
        elif section in values:
            lines += [f"{section}:", *_entries(draft, values[section], section, 1)]
            smoothing = section == "report" and "smooth" not in values["report"]
            lines += [*(SMOOTHING if smoothing else ()), ""]
    if "calibration" not in values:
        lines += draft.calibration
    return "\n".join(lines).rstrip() + "\n"


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
        yield f"{indent}{key}: {_scalar(value)}"


def _comment(sentences: Iterable[str], level: int) -> Iterator[str]:
    prefix = "  " * level + "# "
    for sentence in sentences:
        yield from textwrap.wrap(
            sentence, WIDTH, initial_indent=prefix, subsequent_indent=prefix, break_long_words=False,
            break_on_hyphens=False,
        )  # fmt: skip


def _scalar(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1000)
    return text.removesuffix("\n").removesuffix("\n...")


def _cameras(draft: Draft, cameras_file: str) -> Iterator[str]:
    """Yield the section of the cameras."""
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
