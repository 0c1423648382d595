"""Of all tests."""

from __future__ import annotations

import contextlib
import signal

# A shell starts what runs in the background with SIGINT ignored, and nohup with SIGHUP; both would be inherited by
# the processes that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
with contextlib.suppress(AttributeError):  # not on Windows
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
