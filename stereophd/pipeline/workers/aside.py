"""Work in a process of its own, beside a run that goes on."""

import logging
import os
import threading
from collections.abc import Callable
from typing import Any

from stereophd.pipeline.workers.worker_process import WorkerProcess

# What is added to the niceness of the process: the run comes first.
NICER = 10


class Aside:
    """One piece of work at a time in a new process, which waits when the run needs its core, unless `nicer` is 0."""

    def __init__(self, nicer: int = NICER) -> None:
        self._nicer = nicer
        self._thread: threading.Thread | None = None
        self._worker: WorkerProcess | None = None
        self._outcome: Any = None

    @property
    def is_busy(self) -> bool:
        """Whether work goes on, or its outcome has not been taken."""
        return self._thread is not None

    def start(self, work: Callable[[WorkerProcess], Any]) -> None:
        """Begin work, a function of the new process; a thread of this process calls it."""
        self._thread = threading.Thread(target=self._do, args=(work,), daemon=True)
        self._thread.start()

    def take(self) -> Any:
        """Return what the work returned, or the error that ended it; None while it goes on."""
        if self._thread is None or self._thread.is_alive():
            return None
        self._thread = None
        return self._outcome

    def wait(self, longest_s: float) -> None:
        """Wait until the work has ended, if any goes on."""
        if self._thread is not None:
            self._thread.join(longest_s)

    def stop(self) -> None:
        """End the work, if any goes on; wait until it is gone."""
        while self._thread is not None and self._thread.is_alive():
            if self._worker is not None:
                self._worker.kill()
            self._thread.join(0.1)
        self._thread = None

    def _do(self, work: Callable[[WorkerProcess], Any]) -> None:
        try:
            # started by this thread: the system ends a worker with the thread that started it
            self._worker = worker = WorkerProcess(1)
        except OSError as error:  # no more processes, or no memory for one
            self._outcome = error
            return
        try:
            worker.call(logging.disable, logging.CRITICAL)  # what it finds is for the outcome to tell
            if hasattr(os, "nice"):
                worker.call(os.nice, self._nicer)
            self._outcome = work(worker)
        except Exception as error:
            self._outcome = error
        finally:
            worker.kill()
            worker.close()
