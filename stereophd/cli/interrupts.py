"""Signals such as Ctrl-C end a run by an exception, so that temporary files are removed before it exits.

The first signal raises an exception. Where compiled code calls Python, an exception would be lost (the compiler of the
kernels, which then misses what it compiled) or end the process by a segmentation fault (a kernel that makes a named
tuple): it is raised as soon as the compiled code has returned (`outside_kernels`). Python prints and drops an exception
that a signal raises inside a destructor. This module suppresses the print and raises the exception again a moment
later. Compiled code may also replace it by another exception; `check` raises it again at the next step of the run.
Further signals do not disturb what the first one began; one that comes after `PATIENCE_S` ends the process at once,
and the next run removes what is left behind.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType

from stereophd.cli.early import leave

# How long the removal of unfinished outputs may take before another signal ends the process at once, s.
PATIENCE_S = 5.0

# After what time an exception that got lost is raised again, s.
_AGAIN_S = 0.02

# Not every system has every signal.
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

_received: int | None = None
_since = 0.0


def install() -> None:
    """Handle SIGINT, SIGTERM and SIGHUP, except where they are ignored on purpose (nohup, ``&``)."""
    global _received
    _received = None
    _replace((signal.SIG_DFL, signal.default_int_handler, leave), _handle)
    if hasattr(signal, "SIGALRM") and signal.getsignal(signal.SIGALRM) == signal.SIG_DFL:
        signal.signal(signal.SIGALRM, lambda number, frame: outside_kernels(frame, check))
    sys.unraisablehook = _unraisable


def late() -> None:
    """Ignore signals, now that the work is done: the interpreter is about to end.

    A process whose run was interrupted ends at once, for nothing of it is needed any more. Otherwise the interpreter
    frees what it imported, without first searching all of it twice for objects that refer to each other in a circle:
    that would take as long as the imports of the command line.
    """
    code = exit_code()
    if code is not None:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, full, or none
                stream.flush()
        os._exit(code)
    _replace((_handle,), signal.SIG_IGN)
    gc.disable()
    gc.freeze()


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


def outside_kernels(frame: FrameType | None, action: Callable[[], None]) -> None:
    """Call what raises an exception in a signal handler, now or at the next instruction outside kernels.

    Python calls the handler of a signal that came while a kernel worked at the first instruction of Python after it. A
    kernel that returns a named tuple gets its class and makes it by Python code, and takes for granted that this
    succeeds; so does the compiler of the kernels when it hands over what it compiled. `frame` is the one that the
    signal interrupted, as a handler is given it.
    """
    caller = _caller_of_compiled(frame)
    if caller is None:
        action()
        return

    def trace(traced: FrameType, _event: str, _argument: object) -> None:
        sys.settrace(None)
        traced.f_trace = None
        traced.f_trace_opcodes = False
        action()

    caller.f_trace, caller.f_trace_opcodes = trace, True
    sys.settrace(lambda *_: None)


def _caller_of_compiled(frame: FrameType | None) -> FrameType | None:
    """Return the frame that called the compiled code that is calling Python; None if there is no such code."""
    while frame is not None:
        code = frame.f_code
        gets_class = code.co_name == "_numba_unpickle"
        makes_tuple = code.co_varnames[:1] == ("_cls",) and "_tuple_new" in code.co_names  # collections.namedtuple
        hands_over = code.co_name.startswith("_raw_object_cache_")  # llvmlite's callbacks
        frame = frame.f_back
        if gets_class or makes_tuple or hands_over:
            return frame
    return None


def _replace(before: tuple[object, ...], after: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    for number in _SIGNALS:
        if signal.getsignal(number) in before:
            signal.signal(number, after)


def _handle(number: int, frame: FrameType | None) -> None:
    global _received, _since
    if _received is None:
        _received, _since = number, time.monotonic()
        outside_kernels(frame, check)
    elif time.monotonic() - _since > PATIENCE_S:
        os._exit(128 + _received)


def _unraisable(lost: sys.UnraisableHookArgs) -> None:
    """Take note of an exception that Python cannot raise where it is; print it if it is not that of a signal."""
    if _received is not None and issubclass(lost.exc_type, (KeyboardInterrupt, SystemExit)):
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
    else:
        sys.__unraisablehook__(lost)
