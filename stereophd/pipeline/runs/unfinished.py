"""Where an unfinished run keeps what it has done: a folder inside its output folder."""

from __future__ import annotations

import shutil
from pathlib import Path

from stereophd.errors import InputError
from stereophd.io.outputs.atomic import TEMPORARY_PREFIX
from stereophd.io.outputs.checkpoints import is_checkpoint
from stereophd.io.outputs.disk import UNFINISHED_PREFIX

# Characters of the hash in the name of a folder.
_LENGTH = 16

# Tables that an unfinished run has begun: Parquet files that have no end yet. They count only beside a checkpoint.
UNFINISHED_TABLE = "*.part"

# Files of an unfinished run, as `stereophd.io.outputs.atomic.OutputFolder` takes them.
UNFINISHED_FILES = (
    f"{UNFINISHED_PREFIX}*/*.npz",
    f"{UNFINISHED_PREFIX}*/*/*.npz",
    f"{UNFINISHED_PREFIX}*/{UNFINISHED_TABLE}",
)


def can_resume(out: Path | str) -> bool:
    """Whether an output folder, or a folder of a batch in it, holds an unfinished run."""
    return any(next(Path(out).glob(f"{above}{UNFINISHED_PREFIX}*/"), None) is not None for above in ("", "*/"))


class UnfinishedRun:
    """The folder of an unfinished run: checkpoints without code (`stereophd.io.outputs.checkpoints`), and tables.

    Parameters
    ----------
    out : Path
        Output folder.
    identity : str
        SHA-256 of configuration, log and version.
    """

    def __init__(self, out: Path, identity: str) -> None:
        self.out = out
        self.folder = out / f"{UNFINISHED_PREFIX}{identity[:_LENGTH]}"
        self.identity = identity

    def prepare(self, resume: bool, force: bool) -> None:
        """Check what an earlier run left, and remove what is in the way where that is allowed; `out` is locked.

        Parameters
        ----------
        resume : bool
            Whether this run continues it.
        force : bool
            Whether what belongs to other runs may be removed.

        Raises
        ------
        InputError
            There is an unfinished run, and neither `resume` nor `force` is given; it is one of another configuration
            or log, and `force` is not given; or a folder of such a name holds other files.
        """
        folders = sorted(path for path in self.out.glob(f"{UNFINISHED_PREFIX}*") if path.is_dir())
        for path in (path for folder in folders for path in folder.rglob("*")):
            if path.is_file() and not _is_ours(path):
                raise InputError(
                    f"output folder {self.out} holds {path.relative_to(self.out)}, which is no part of an unfinished "
                    "run; move it away, or choose another folder"
                )
        if folders and not (resume or force):
            raise InputError(
                f"output folder {self.out} holds an unfinished run; use `resume=True` to continue it, or "
                "`force=True` to begin anew"
            )
        others = [folder for folder in folders if folder != self.folder]
        if others and not force:
            raise InputError(
                f"output folder {self.out} holds an unfinished run of another configuration or log "
                f"({others[0].name}): nothing to resume; use `force=True` to remove it"
            )
        for folder in [*others, *([] if resume else [self.folder])]:
            _remove(folder)

    @property
    def exists(self) -> bool:
        """Whether there is an unfinished run to continue."""
        return self.folder.is_dir()

    def remove(self) -> None:
        """Remove the folder: the run is done."""
        _remove(self.folder)


def _remove(folder: Path) -> None:
    """Remove a folder of an unfinished run, the checkpoints last: tables without one are not known as ours."""
    for path in folder.glob(UNFINISHED_TABLE):
        path.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def _is_ours(path: Path) -> bool:
    """Whether a file in such a folder is part of an unfinished run."""
    if path.match(UNFINISHED_TABLE):
        return any(map(is_checkpoint, path.parent.glob("*.npz")))
    return path.name.startswith(TEMPORARY_PREFIX) or is_checkpoint(path)
