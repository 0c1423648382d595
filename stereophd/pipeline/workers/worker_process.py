"""A worker process: it receives calls as pickles on standard input, and answers on standard output."""

import ctypes
import json
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any

from stereophd.core.numerics.threads import OF_ALL, OF_LINEAR_ALGEBRA
from stereophd.errors import StereophdError
from stereophd.wording import PROGRESS, Stages

# How often a worker looks for the process that started it where the system does not end it, s; the call for that.
WATCH_EVERY_S, PR_SET_PDEATHSIG = 0.5, 1

# Numbers of threads that libraries read when they are loaded.
THREADS = (OF_ALL, *OF_LINEAR_ALGEBRA, "NUMBA_NUM_THREADS")

PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from stereophd.pipeline.workers.worker_process import main; main(int(sys.argv[2]))"
)

# Bytes of the length before a message.
HEADER = 8


class WorkersLostError(StereophdError):
    """Worker processes died; the arguments without a result are to be done again."""


class WorkerProcess:
    """A worker, for the process that starts it; its libraries use this many threads if the environment states none."""

    def __init__(self, threads: int) -> None:
        options = [f"-W{option}" for option in sys.warnoptions]
        self._process = subprocess.Popen(
            # -P: a file of the working folder does not take the place of a module of Python
            [sys.executable, "-P", *options, "-c", PROGRAM, json.dumps(sys.path), str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**dict.fromkeys(THREADS, str(threads)), **os.environ},
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._calls, self._results = self._process.stdin, self._process.stdout

    def call(self, function: Callable[[Any], Any], argument: Any, tell: Callable[[str], None] | None = None) -> Any:
        """Return the result of a call of a function of a module; WorkersLostError if the worker died.

        What the call logs of its progress goes to `tell` meanwhile.
        """
        call = pickle.dumps((function, argument), pickle.HIGHEST_PROTOCOL)
        try:
            _send(self._calls, call)
            while (received := _receive(self._results)) and isinstance(told := pickle.loads(received), str):
                if tell is not None:
                    tell(told)
        except OSError:
            received = None
        if received is None:
            raise WorkersLostError(f"a worker process ended with exit code {self._process.wait()}")
        result, error, where = told
        if error is not None:
            raise error from RuntimeError(f"in a worker process:\n{where}")
        return result

    def kill(self) -> None:
        """End the worker, whatever it does."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """Close the pipes, once nobody uses them."""
        self._results.close()
        with suppress(OSError):  # a call that the worker did not read
            self._calls.close()


def main(parent: int) -> None:
    """Do the calls that come from the process `parent`, until it closes their pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with(parent)
    calls, results = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    # What a call prints goes to the standard error: the output is for results.
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)
    try:
        os.dup2(2, 1)
    except OSError:  # there is no standard error
        os.dup2(nothing, 1)
    # it has a lock: threads of a call may tell something at once
    PROGRESS.handlers = [Stages(lambda stage: _send(results, pickle.dumps(stage)))]
    PROGRESS.setLevel(logging.DEBUG)
    PROGRESS.propagate = False
    while (call := _receive(calls)) is not None:
        _send(results, _outcome(call))


def end_with(parent: int) -> None:
    """End this process when `parent`, which started it, is gone: by the system (Linux), else by looking for it.

    The system also ends it with the thread that started it. It needs no lock of Python, which a long computation holds.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_EVERY_S)
        os._exit(1)

    if not _is_ended_by_system():
        threading.Thread(target=watch, name="watch the parent", daemon=True).start()
    elif os.getppid() != parent:
        os._exit(1)


def _is_ended_by_system() -> bool:
    """Whether the system is to kill this process with the one that started it."""
    try:
        return bool(ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL) == 0)
    except (AttributeError, OSError, TypeError):
        return False


def _outcome(call: bytes) -> bytes:
    """Do a call; return a pickle of its result, of the error that it ended with, and of where that was."""
    try:
        function, argument = pickle.loads(call)
        return pickle.dumps((function(argument), None, ""), pickle.HIGHEST_PROTOCOL)
    except BaseException as error:
        where = traceback.format_exc()
        try:
            told = pickle.dumps((None, error, where), pickle.HIGHEST_PROTOCOL)
            pickle.loads(told)
        except Exception:  # some errors cannot be sent
            told = pickle.dumps((None, RuntimeError(repr(error)), where), pickle.HIGHEST_PROTOCOL)
        return told


def _send(stream: IO[bytes], message: bytes) -> None:
    stream.write(len(message).to_bytes(HEADER, "little"))
    stream.write(message)
    stream.flush()


def _receive(stream: IO[bytes]) -> bytes | None:
    """Return a message, or None where the other end has gone."""
    header = stream.read(HEADER)
    length = int.from_bytes(header, "little")
    message = stream.read(length)
    return message if len(header) == HEADER and len(message) == length else None
