"""A case of the fuzz tests: one use of a command, its files damaged and its options odd, run under a watch."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shutil
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin
from unittest import mock

from hypothesis import strategies as st

from stereophd.cli.app import command_line, run

from .commands import NoEnd, bounded
from .damage import ODD_NUMBERS, SHARES, Harm, harmed, harms
from .schema_values import fitting, leaves, near_bounds
from .test_configuration import SCHEMA
from .valid_files import USES, Use

# Options that wait for a network or for files that grow, run in real time, print a traceback on purpose, or start
# processes, which load everything anew (`--jobs` has odd values only); and places where a command writes.
LEFT_OUT = {
    "dask", "listen", "publish", "follow", "realtime", "debug", "jobs", "out", "record", "mcap", "force", "force_size",
    "verbose",
}  # fmt: skip
LEAVES = sorted({path: node for path, node in leaves(SCHEMA) if path}.items(), key=lambda item: item[0])

# Processor time of a case, s, after which a command on a damaged file is one that does not end. Where numbers of the
# configuration are odd, it may have much to do: it is ended, and no mistake.
LONGEST_S = 20.0


@dataclass(frozen=True)
class Case:
    """What is tried: the use, changes of a file of it (its place among them as a share), more words, an earlier run."""

    use: str
    file: float
    harms: tuple[Harm, ...]
    words: tuple[str, ...]
    again: bool


@cache
def parameters(command: tuple[str, ...]) -> list[Any]:
    """Return the parameters of a command."""
    found = command_line()
    for name in command:
        found = found.commands[name]
    return [one for one in found.params if one.opts[0].startswith("--") and one.name not in LEFT_OUT]


def command_of(words: str) -> tuple[str, ...]:
    """Return the words that name the command."""
    first, second, *_ = words.split()
    return (first, second) if first == "config" else (first,)


@cache
def files_of(folder: Path, words: str) -> list[Path]:
    """Return the files that words of a use name, and those of folders that they name, relative to the folder."""
    named = [folder / word for word in words.split() if (folder / word).exists()]
    found = [path for place in named for path in ([place] if place.is_file() else sorted(place.rglob("*")))]
    if words.startswith("import openptv"):
        found = sorted(folder.rglob("*"))
    return [path.relative_to(folder) for path in found if path.is_file()]


def _values(parameter: Any, names: list[str]) -> st.SearchStrategy[str]:
    kind = parameter.type_descriptor.annotation
    kinds = {kind, *get_args(kind)}
    if parameter.name == "overrides":
        return st.sampled_from(LEAVES).flatmap(
            lambda item: st.one_of(fitting(SCHEMA, item[1]), near_bounds(item[1])).map(
                lambda value: f"{'.'.join(item[0])}={value}"
            )
        )
    choices = [str(word) for one in kinds if get_origin(one) is Literal for word in get_args(one)]
    if choices:
        return st.sampled_from([*choices, "x", ""])
    if Path in kinds:
        return st.sampled_from([*names, ".", "missing", "", "\x00"])
    words = ["left", "right", "left=20", "left=0:3", "640x480", "x=u_px", "all", "0", "0,0,1,1", "position_error=1"]
    return st.sampled_from([*ODD_NUMBERS, *words, "20", "0.5", "2", "1e9", "-1e9"])


@st.composite
def cases(draw: st.DrawFn, folder: Path) -> Case:
    """Return cases of the uses whose valid files a folder holds."""
    name = draw(st.sampled_from([name for name, use in USES.items() for _ in range(use.often)]))
    use = USES[name]
    files = files_of(folder / use.folder, f"{use.words} {use.stdin}")
    share = draw(SHARES)
    changes = draw(st.sampled_from([1, 1, 1, 1, 0]))
    damage = draw(harms(files[int(share * len(files))].suffix)) if changes else []
    words: list[str] = []
    for _ in range(draw(st.sampled_from([0, 0, 0, 1] if changes else [1, 1, 2, 3]))):
        one = draw(st.sampled_from(parameters(command_of(use.words))))
        words.append(one.opts[0])
        if bool not in {one.type_descriptor.annotation, *get_args(one.type_descriptor.annotation)}:
            words.append(draw(_values(one, [str(path) for path in files])))
    return Case(name, share, tuple(damage), tuple(words), draw(st.sampled_from([False] * 4 + [True])))


@dataclass(frozen=True)
class Result:
    """What became of a case: the exit code, whether it was ended since it may have had much to do, what is wrong."""

    code: int
    ended: bool
    wrong: str


def snapshot(root: Path, apart: str) -> dict[str, tuple[int, ...]]:
    """Return what tells whether a file or folder has changed, by its path; leaves out the output."""
    found: dict[str, tuple[int, ...]] = {}
    for place, folders, files in os.walk(root):
        if Path(place) == root:
            folders[:] = [name for name in folders if not name.startswith(apart)]
        for name in files:
            path = os.path.join(place, name)
            if not (Path(place) == root and name.startswith(apart)):
                status = os.lstat(path)
                found[path] = (status.st_ino, status.st_size, status.st_mtime_ns, status.st_mode)
    return found


def contents(root: Path, name: str) -> dict[str, bytes]:
    """Return the files below the output, with their contents."""
    paths = [path for top in root.glob(f"{name}*") for path in (top.rglob("*") if top.is_dir() else [top])]
    return {str(path): path.read_bytes() for path in paths if path.is_file()}


def tried(case: Case, folder: Path) -> Result:
    """Run a case in a folder of its own, whose inputs nothing may change, and say what became of it."""
    use = USES[case.use]
    with tempfile.TemporaryDirectory(dir=folder) as name:
        root = Path(name) / "root"
        shutil.copytree(folder / use.folder, root)
        (root / "tmp").mkdir()
        with contextlib.chdir(root), mock.patch.object(tempfile, "tempdir", str(root / "tmp")):
            return _watched(case, use, folder / use.folder, root)


def _watched(case: Case, use: Use, valid: Path, root: Path) -> Result:
    words = [word.replace("OUT", "out") for word in use.words.split()]
    if case.again and "OUT" in use.words:  # over an earlier run, which must stay where the new one fails
        code, said = _run(words, use, root)
        if code:
            return Result(code, False, f"the valid files: exit code {code}: {said}")
        words.append("--force")
    files = files_of(valid, f"{use.words} {use.stdin}")
    damaged = files[int(case.file * len(files))]
    path = root / damaged
    if case.harms:
        content = path.read_bytes()
        for harm in case.harms:
            content = harmed(path, content, harm)
        path.unlink()
        path.write_bytes(content)
    before, earlier = snapshot(root, "out"), contents(root, "out")
    try:
        code, said = _run([*words, *case.words], use, root)
    except NoEnd as error:
        long = "--set" in case.words or (case.harms and path.name == "config.yaml") or "--pieces" in case.words
        return Result(-1, bool(long), "" if long else str(error))
    several = set()  # recordings that a batch finishes, although another one fails
    if "several" in case.use:
        several = {log.stem for log in files} - {damaged.stem}
    elif "of folders" in case.use:
        several = {file.parent.name for file in files} - {damaged.parent.name}
    return Result(code, False, _wrong(code, said, root, before, earlier, several))


def _run(words: list[str], use: Use, root: Path) -> tuple[int, str]:
    """Run a command in this process; return its exit code and what it says on stderr."""
    said, stdin = io.StringIO(), io.TextIOWrapper(io.BytesIO((root / use.stdin).read_bytes() if use.stdin else b""))
    with (
        contextlib.redirect_stderr(said),
        contextlib.redirect_stdout(_Nowhere()),
        mock.patch.object(sys, "stdin", stdin),
        bounded(LONGEST_S),
    ):
        code = run(words)
    return code, said.getvalue()


class _Nowhere(io.StringIO):
    """A standard output that keeps nothing, text or bytes."""

    buffer = property(lambda _: io.BytesIO())

    def write(self, text: str) -> int:
        return len(text)


def _wrong(
    code: int, said: str, root: Path, before: dict[str, tuple[int, ...]], earlier: dict[str, bytes], several: set[str]
) -> str:
    if code not in (0, 1, 2):
        return f"exit code {code}: {said[-600:]}"
    if "Traceback" in said or re.search(r"\w+Warning\b", said):
        return f"a library speaks: {said[-600:]}"
    if code == 2 and "error: " not in said.lower() and "Usage: " not in said:
        return f"no message: {said[-600:]}"
    now = snapshot(root, "out")
    changed = {place for place in before.keys() | now.keys() if before.get(place) != now.get(place)}
    if changed:
        return f"changed outside the output: {sorted(changed)}"
    after = contents(root, "out")
    if "unknown quantity" in said:  # found after the first runs, which the corrected experiment continues
        after = {place: text for place, text in after.items() if "/partial-" not in place}
    mixed = {place for place in after.keys() | earlier.keys() if after.get(place) != earlier.get(place)}
    mixed = {place for place in mixed if not place.endswith(".frames.jsonl")}  # the frames of a live run that failed
    if several:  # what was finished stays, each whole
        mixed = {place for place in mixed if Path(place).parent.name not in several and "summary" not in place}
    if code == 2 and mixed:
        return f"exit code 2 and other outputs: {sorted(mixed)}; {said[-300:]}"
    if left := [place for place in after if ".stereophd-partial" in place or "partial-" in place]:
        return f"left behind: {left}"
    return ""
