"""What an unfinished run has done: a folder inside its output folder, from which a later one continues.

`track`, the pieces of a long log, `calibrate` and `experiment` keep their work here in the same way. A whole file holds
one object. Parts hold what is too much to be written each time, such as the rows of a table; they count as far as the
state says that was written after them. `track` and `calibrate` write about once a minute, the others as they go.

Everything in the folder is data (`stereophd.io.outputs.saved`). It goes when the results come into their places.
"""

import contextlib
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from stereophd.errors import InputError
from stereophd.io.outputs.atomic import tidy
from stereophd.io.outputs.commit import files_below, is_folder
from stereophd.io.outputs.disk import TEMPORARY_PREFIX, UNFINISHED_PREFIX
from stereophd.io.outputs.json_text import read_report
from stereophd.io.outputs.locks import output_lock
from stereophd.io.outputs.saved import PART, KeptParts, decoder, is_saved, read_saved, write_saved

# Characters of the identity in the name of a folder.
_LENGTH = 16

# Ending of whole files.
WHOLE = ".saved"

# Files of an unfinished run, as `stereophd.io.outputs.atomic.OutputFolder` takes them.
UNFINISHED_FILES = (f"{UNFINISHED_PREFIX}*/*{WHOLE}", f"{UNFINISHED_PREFIX}*/*{PART}")

# Seconds between two states that are kept; more where keeping one takes more than a hundredth of it.
KEEP_EVERY_S = 60.0
MOST_SHARE = 0.01

REPORT_FILE = "report.json"


def can_resume(out: Path | str) -> bool:
    """Whether an output folder, or a folder of a batch in it, holds an unfinished run."""
    return any(next(Path(out).glob(f"{above}{UNFINISHED_PREFIX}*/*{WHOLE}"), None) is not None for above in ("", "*/"))


class UnfinishedRun:
    """The folder of an unfinished run, whose output folder is `out`.

    Its identity is the SHA-256 of what decides about the results: configuration, inputs, version.
    """

    def __init__(self, out: Path, identity: str) -> None:
        self.out = out
        self.identity = identity
        self.folder = out / f"{UNFINISHED_PREFIX}{identity[:_LENGTH]}"
        self._next_s = time.monotonic() + KEEP_EVERY_S
        self._waiting: dict[str, Any] = {}

    def prepare(self, resume: bool, force: bool) -> None:
        """Check what an earlier run left, and remove what is in the way where `force` allows it; `out` is locked.

        With `resume` this run continues the earlier one. Raises InputError if there is an unfinished run, and neither
        `resume` nor `force` is given; if it is one of another configuration or log, and `force` is not given; or if a
        folder of such a name holds other files.
        """
        folders = sorted(path for path in self.out.glob(f"{UNFINISHED_PREFIX}*") if is_folder(path))
        for folder in folders:
            for relative in files_below(folder):
                if not _is_ours(folder, relative) and not is_folder(folder / relative):
                    raise InputError(
                        f"output folder {self.out} holds {Path(folder.name, relative)}, which is no part of an "
                        "unfinished run; move it away, or choose another folder"
                    )
        holding = [folder for folder in folders if any(folder.glob(f"*{WHOLE}"))]
        if holding and not (resume or force):
            raise InputError(
                f"output folder {self.out} holds an unfinished run; use `resume=True` to continue it, or "
                "`force=True` to begin anew"
            )
        others = [folder for folder in holding if folder != self.folder]
        if others and not force:
            raise InputError(
                f"output folder {self.out} holds an unfinished run of another configuration or log "
                f"({others[0].name}): nothing to resume; use `force=True` to remove it"
            )
        for folder in folders:
            # Parts alone are of a run that was killed before its first state; empty folders are not ours.
            if any(folder.iterdir()) and not (folder == self.folder and resume and folder in holding):
                shutil.rmtree(folder, ignore_errors=True)

    @contextlib.contextmanager
    def held(self, resume: bool, force: bool) -> Iterator[None]:
        """Do a run in the block, after `prepare`; if it fails and has kept no whole file, its folder goes."""
        self.prepare(resume, force)
        try:
            yield
        except BaseException:
            if not self.exists:
                shutil.rmtree(self.folder, ignore_errors=True)
            raise

    @property
    def exists(self) -> bool:
        """Whether there is an unfinished run to continue."""
        return next(self.names(), None) is not None

    def names(self) -> Iterator[str]:
        """Yield the names of the whole files."""
        return (path.name.removesuffix(WHOLE) for path in sorted(self.folder.glob(f"*{WHOLE}")))

    def finished_report(self, record: Mapping[str, Any], force: bool) -> dict[str, Any] | None:
        """Return the report if the run is finished in its output folder; None if it is not, or is to be replaced.

        What a later run of the same began, and did not end, goes then. `record` is the provenance of the wanted run
        (`stereophd.io.outputs.provenance.provenance`). Raises InputError if the folder holds the results of another
        configuration or of other inputs, which only `force` lets a run replace.
        """
        tidy(self.out)
        try:
            report = read_report(self.out / REPORT_FILE)
        except InputError as error:
            if force:
                return None
            raise InputError(f"{error}; use `force=True` to start anew") from error
        if report is None:
            return None
        if report["provenance"] == record:
            if is_folder(self.folder):
                with output_lock(self.out):
                    self.prepare(resume=True, force=force)
                    shutil.rmtree(self.folder, ignore_errors=True)
            return report
        if force:
            return None
        raise InputError(
            f"output folder {self.out} holds the results of another configuration, log or version; use `force=True` to "
            "replace them"
        )

    def write(self, name: str, value: Any) -> None:
        """Write a whole file."""
        write_saved(self._whole(name), self.identity, value)

    def read(self, name: str, kind: Any, given: Mapping[type, Any] | None = None) -> Any:
        """Return the content of a whole file, of the type `kind`; None if there is no such file.

        `given` is that of `stereophd.io.outputs.saved.decoder`; InputError if the file is damaged, or of another run.
        """
        path = self._whole(name)
        return read_saved(path, self.identity, decoder(kind, given)) if path.exists() else None

    def keep(self, name: str, value: Any) -> None:
        """Keep a value, or what a function returns then, in a whole file: now, if the last time was a while ago.

        Else it waits for `save`, or for the next value of that name.
        """
        self._waiting[name] = value
        if time.monotonic() >= self._next_s:
            self.save()

    def save(self) -> bool:
        """Write what waits to be kept; return whether anything did."""
        start = time.monotonic()
        waiting, self._waiting = self._waiting, {}
        for name, value in waiting.items():
            self.write(name, value() if callable(value) else value)
        now = time.monotonic()
        self._next_s = now + max(KEEP_EVERY_S, (now - start) / MOST_SHARE)
        return bool(waiting)

    def parts(self, name: str, count: int = 0) -> KeptParts:
        """Return what grows under a name, continued from as many parts as count."""
        return KeptParts(self.folder / name, self.identity, count)

    def _whole(self, name: str) -> Path:
        return self.folder / f"{name}{WHOLE}"


def _is_ours(folder: Path, relative: Path) -> bool:
    """Whether a file in such a folder is part of an unfinished run."""
    is_temporary = relative.name.startswith(TEMPORARY_PREFIX)
    return len(relative.parts) == 1 and (is_temporary or is_saved(folder / relative))
