"""Options in messages: the package names parameters of its functions, the command line its options.

A message from below names a parameter in backquotes, such as ``use `force=True` to replace it``. Whoever calls the
function from Python reads it as it stands; here it becomes ``use --force to replace it``.
"""

from __future__ import annotations

import re

# Parameter -> option; other words in backquotes, such as sections of a configuration, stay.
FLAGS = {
    "at": "--at",
    "base": "--base",
    "cameras_path": "--cameras",
    "cutoff": "--cutoff",
    "dask": "--dask",
    "fail_above": "--fail-above",
    "force": "--force",
    "from_s": "--from",
    "jobs": "--jobs",
    "log_path": "--log",
    "max_gap_s": "--max-gap",
    "order": "--order",
    "ospa2_window": "--ospa2-window",
    "out_dir": "--out",
    "overrides": "--set",
    "plots": "--plots",
    "resume": "--resume",
    "seed": "--seed",
    "seen_by": "--seen-by",
    "to_s": "--to",
    "true_path": "--true-cameras",
    "within_s": "--within",
}
_PARAMETER = re.compile(r"(?<!`)`([a-z][a-z0-9_]*)(?:=True)?`(?!`)")


def with_flags(message: str) -> str:
    """Return a message with the options of the command line in place of parameters in backquotes."""
    return _PARAMETER.sub(lambda found: FLAGS.get(found[1], found[0]), message)
