"""Checkpoints of long calibrations."""

from __future__ import annotations

import pickle
import time
from pathlib import Path
from typing import Any

from stereophd.errors import InputError
from stereophd.io.atomic import atomic_write

# Seconds between two checkpoints.
CHECKPOINT_EVERY_S = 60.0


class Checkpoint:
    """State of an unfinished run, in a file beside its output folder.

    Parameters
    ----------
    path : Path
    identity : str
        Of configuration and log: a checkpoint of another run is refused.
    resume : bool
        Whether to begin with what the file holds.
    """

    def __init__(self, path: Path, identity: str, resume: bool) -> None:
        self.path = path
        self._identity = identity
        self._parts: dict[str, Any] = {}
        self._saved = time.monotonic()
        if resume:
            self._parts = self._load()

    def _load(self) -> dict[str, Any]:
        try:
            with open(self.path, "rb") as stream:
                identity, parts = pickle.load(stream)
        except FileNotFoundError:
            raise InputError(f"--resume: expected a checkpoint {self.path}, found none") from None
        except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: expected a checkpoint of this version, found {error}") from None
        if identity != self._identity:
            raise InputError(f"{self.path}: expected a checkpoint of this configuration and log, found another's")
        return dict(parts)

    @property
    def holds_anything(self) -> bool:
        """Whether there is anything to continue from."""
        return bool(self._parts)

    def get(self, name: str) -> Any:
        """What was kept under a name, or None."""
        return self._parts.get(name)

    def keep(self, name: str, value: Any) -> None:
        """Keep a value; it is written now if the last time was a while ago."""
        self._parts[name] = value
        if time.monotonic() - self._saved >= CHECKPOINT_EVERY_S:
            self.save()

    def save(self) -> None:
        """Write the file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.path) as temporary, open(temporary, "wb") as stream:
            pickle.dump((self._identity, self._parts), stream)
        self._saved = time.monotonic()

    def remove(self) -> None:
        """Remove the file: the run is done."""
        self.path.unlink(missing_ok=True)
