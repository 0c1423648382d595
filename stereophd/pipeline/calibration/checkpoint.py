"""Checkpoints of long calibrations."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from stereophd.core.calibration.annealing.task import Start
from stereophd.core.calibration.sampling.bridging_state import BridgeInfo, BridgeState
from stereophd.core.calibration.sampling.sequential import SequentialInfo, SequentialState
from stereophd.core.motion.base import Motion
from stereophd.core.motion.settings import motion_models
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import atomic_write, temporary_beside
from stereophd.io.outputs.checkpoints import is_checkpoint, read_checkpoint, write_checkpoint

# Seconds between two checkpoints; more where writing one takes more than a hundredth of it.
CHECKPOINT_EVERY_S = 60.0
MOST_SHARE = 0.01

# Classes whose objects the methods keep.
KEPT = (Start, SequentialState, SequentialInfo, BridgeState, BridgeInfo)


def _motions() -> list[type]:
    """Classes of all motion models: the trajectories of a start hold theirs."""
    motion_models()
    found: list[type] = []
    waiting: list[type] = [Motion]
    while waiting:
        kinds: list[type] = waiting.pop().__subclasses__()
        found += kinds
        waiting += kinds
    return found


class Checkpoint:
    """State of an unfinished run, in a file beside its output folder.

    Parameters
    ----------
    path : Path
    identity : str
        Identity of configuration, log and version: a checkpoint of another run is refused.
    resume : bool
        Whether to begin with what the file holds. Without a file the run begins at the start.
    force : bool
        Whether the checkpoint of another run, or without `resume` of this one, may be replaced.

    Raises
    ------
    InputError
        There is another file of that name; or a checkpoint, and neither `resume` nor `force` is given; or one of
        another run, and `force` is not given.
    """

    def __init__(self, path: Path, identity: str, resume: bool, force: bool) -> None:
        self.path = path
        self._identity = identity
        self._parts: dict[str, Any] = {}
        self._next_s = time.monotonic() + CHECKPOINT_EVERY_S
        temporary_beside(path).unlink(missing_ok=True)  # of a run that was killed while it saved
        if not path.exists():
            return
        if not is_checkpoint(path):
            raise InputError(
                f"{path}: the checkpoint of this run has this name; expected none, or a checkpoint of an earlier run, "
                "found another file; move it away, or choose another output folder"
            )
        if resume:
            try:
                self._parts = read_checkpoint(path, identity, (*KEPT, *_motions()))
            except InputError:
                if not force:
                    raise
        elif not force:
            raise InputError(
                f"{path}: there is a checkpoint of an unfinished run; use `resume=True` to continue it, or "
                "`force=True` to begin anew"
            )

    @property
    def holds_anything(self) -> bool:
        """Whether there is anything to continue from."""
        return bool(self._parts)

    def get(self, name: str) -> Any:
        """Return what was kept under a name, or None."""
        return self._parts.get(name)

    def keep(self, name: str, value: Any) -> None:
        """Keep a value; it is written now if the last time was a while ago."""
        self._parts[name] = value
        if time.monotonic() >= self._next_s:
            self.save()

    def save(self) -> None:
        """Write the file."""
        start = time.monotonic()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.path) as temporary:
            write_checkpoint(temporary, self._identity, self._parts)
        now = time.monotonic()
        self._next_s = now + max(CHECKPOINT_EVERY_S, (now - start) / MOST_SHARE)

    def remove(self) -> None:
        """Remove the file: the run is done."""
        self.path.unlink(missing_ok=True)
