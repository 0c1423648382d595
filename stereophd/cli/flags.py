"""Translation of messages: names of parameters become options of the command line.

The messages of the package name parameters of its functions in backquotes, such as ``use `force=True` to replace it``.
A caller from Python reads them unchanged. The command line translates them: ``use --force to replace it``.
"""

from __future__ import annotations

import re

# Parameter -> option; other words in backquotes, such as sections of a configuration, stay.
FLAGS = {
    "align": "--align",
    "at": "--at",
    "base": "--base",
    "box_point": "--box-point",
    "cameras_path": "--cameras",
    "columns": "--column",
    "cutoff": "--cutoff",
    "dask": "--dask",
    "detector": "--sigma-px",
    "fail_above": "--fail-above",
    "fail_below": "--fail-below",
    "fill": "--fill",
    "force": "--force",
    "frames": "--frames",
    "from_s": "--from",
    "image_sizes": "--image-size",
    "jobs": "--jobs",
    "kind": "--kind",
    "least_score": "--least-score",
    "length_unit": "--length-unit",
    "log_path": "--log",
    "match_distance": "--match-distance",
    "max_gap_s": "--max-gap",
    "offsets": "--offset",
    "order": "--order",
    "ospa2_window": "--ospa2-window",
    "out_dir": "--out",
    "overrides": "--set",
    "pieces_s": "--pieces",
    "overlap_s": "--overlap",
    "pixel_origin": "--pixel-origin",
    "plane": "--plane",
    "plots": "--plots",
    "rate_hz": "--rate",
    "rates": "--fps",
    "region": "--region",
    "rename": "--rename",
    "require": "--require",
    "resume": "--resume",
    "rows_from": "--rows-from",
    "seed": "--seed",
    "seen_by": "--seen-by",
    "switch_cost": "--switch-cost",
    "tentative": "--tentative",
    "time_unit": "--time-unit",
    "to_s": "--to",
    "tracks": "--track",
    "true_path": "--true-cameras",
    "undistorted": "--undistorted",
    "within_s": "--within",
}
_PARAMETER = re.compile(r"(?<!`)`([a-z][a-z0-9_]*)(?:=True)?`(?!`)")


def with_flags(message: str) -> str:
    """Return a message with the options of the command line in place of parameters in backquotes."""
    return _PARAMETER.sub(lambda found: FLAGS.get(found[1], found[0]), message)
