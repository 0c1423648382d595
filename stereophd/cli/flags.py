"""Translation of messages: names of parameters become options of the command line.

The messages of the package name parameters of its functions in backquotes, such as ``use `force=True` to replace it``.
A caller from Python reads them unchanged. The command line translates them: ``use --force to replace it``.
"""

import re

from stereophd.commands.options import OPTIONS
from stereophd.options import declarations

# Parameter -> option, where no class of options declares it; other words in backquotes, such as sections, stay.
_SHELL = {"detector": "--sigma-px", "out_dir": "--out", "overrides": "--set", "seed": "--seed", "to": "--to"}
_DECLARED = [item for kind in OPTIONS.values() for item in declarations(kind).items()]
FLAGS = _SHELL | {name: declared.flag_of(name) for name, declared in _DECLARED}
_PARAMETER = re.compile(r"(?<!`)`([a-z][a-z0-9_]*)(?:=True)?`(?!`)")


def with_flags(message: str) -> str:
    """Return a message with the options of the command line in place of parameters in backquotes."""
    return _PARAMETER.sub(lambda found: FLAGS.get(found[1], found[0]), message)
