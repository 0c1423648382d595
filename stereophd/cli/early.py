"""Signals in the first tenth of a second, while the command line is imported: the process ends at once.

Nothing has begun then. This module imports nothing that takes time: `_signal` is the compiled part of `signal`, and a
part of the interpreter.
"""

import _signal  # type: ignore[import-not-found, unused-ignore]
import os


def leave(number: int, frame: object) -> None:
    """End the process at once, with the exit code that a shell reports."""
    os._exit(128 + number)


def handle() -> None:
    """Handle signals so until `stereophd.cli.interrupts.install`, except where they are ignored on purpose."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(_signal, name, None)  # not every system has every signal
        if number is not None and _signal.getsignal(number) in (_signal.SIG_DFL, _signal.default_int_handler):
            _signal.signal(number, leave)
