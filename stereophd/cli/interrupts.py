"""Ctrl-C and the like end a run as exceptions, so that unfinished outputs are removed on the way out.

An exception that a signal raises inside a callback from compiled code (the compiler of the kernels has
such) is printed and lost by Python. So the signal is remembered, and `check` raises it again at the next
step of the run.
"""

from __future__ import annotations

import signal
from types import FrameType

_received: int | None = None


def install() -> None:
    """Handle SIGINT, SIGTERM and SIGHUP, except where they are ignored on purpose (nohup, ``&``)."""
    global _received
    _received = None
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _handle)


def exit_code() -> int | None:
    """Return what the run exits with if a signal came, as the shell reports it: 128 + signal."""
    return None if _received is None else 128 + _received


def check() -> None:
    """Raise what a signal has raised before, if there was one."""
    code = exit_code()
    if _received == signal.SIGINT:
        raise KeyboardInterrupt
    if code is not None:
        raise SystemExit(code)


def _handle(number: int, frame: FrameType | None) -> None:
    global _received
    _received = number
    check()
