"""Which files a batch takes, and the name of the folder of each."""

import glob
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from stereophd.errors import InputError

# File names that state the kind of file, not the recording: the folder names the recording.
NATIVE_STEMS = frozenset({"detections", "tracks", "truth"})

LOG_FILE = "detections.parquet"
_WILD = frozenset("*?[")


def expand(paths: Sequence[Path | str]) -> list[Path]:
    """Return logs: each pattern replaced by the files that fit it, in order of name, each folder by the log in it.

    Raises InputError when nothing fits a pattern.
    """
    logs: list[Path] = []
    for path in map(Path, paths):
        fitting = [path]
        if not path.exists() and _WILD & set(str(path)):
            fitting = sorted(Path(name) for name in glob.glob(str(path), recursive=True))
        if not fitting:
            raise InputError(f"{path}: expected a pattern that fits a file, found no such file")
        logs += [log if (log := place / LOG_FILE).is_file() else place for place in fitting]
    return logs


def folder_names(paths: Sequence[Path]) -> list[str]:
    """Return a name for each file: its own without the ending, or its folder's where its own states only the kind.

    Files that would have one name get the names of the folders above them in front, as many as they need to differ.
    Raises InputError when a file is given twice.
    """
    places = [Path(os.path.abspath(path)) for path in paths]
    for place, count in Counter(places).items():
        if count > 1:
            raise InputError(f"{place}: expected each file once, found it {count} times")
    parts = [_parts(place) for place in places]
    taken = [1] * len(parts)
    while True:
        names = ["-".join(part[-count:]) for part, count in zip(parts, taken, strict=True)]
        groups: dict[str, list[int]] = {}
        for index, name in enumerate(names):
            groups.setdefault(name.casefold(), []).append(index)
        alike = [group for group in groups.values() if len(group) > 1]
        if not alike:
            return names
        longer = [index for group in alike for index in group if taken[index] < len(parts[index])]
        if not longer:
            first, second = alike[0][:2]
            raise InputError(f"{paths[first]} and {paths[second]}: expected files of different names, found both alike")
        for index in longer:
            taken[index] += 1


def _parts(place: Path) -> list[str]:
    """Return the folders of a file, and its name without the ending where that names the recording."""
    folders = [part for part in place.parent.parts if part != place.anchor]
    return folders if place.stem in NATIVE_STEMS and folders else [*folders, place.stem]


Pairs = dict[str, tuple[Path, Path]]


def pairs_by_name(left: Path, right: Path, left_name: str, right_name: str) -> tuple[Pairs, Pairs]:
    """Match the files of two folders by their names; return NAME -> file of each folder, and those of `right` alone.

    The folders hold ``NAME/FILE``, FILE being `left_name` (such as ``tracks.parquet``) or `right_name`; `right` may
    hold ``NAME.parquet`` instead. Every name of `left` is among the pairs, in order; their file of `right` may be
    missing. Raises InputError when a folder is none, or `left` holds no such file.
    """
    for folder in (left, right):
        if not folder.is_dir():
            raise InputError(f"{folder}: expected a folder, as {left if folder == right else right}, found none")
    names = sorted(entry.name for entry in left.iterdir() if (entry / left_name).is_file())
    if not names:
        raise InputError(f"{left}: expected folders that hold {left_name}, found none")
    files = {entry.stem: entry for entry in right.glob("*.parquet") if entry.is_file()}
    inside = {entry.name: entry / right_name for entry in right.iterdir() if (entry / right_name).is_file()}
    found = inside | files
    pairs = {name: (left / name / left_name, found.get(name, right / name / right_name)) for name in names}
    alone = {name: (left / name / left_name, found[name]) for name in sorted(found.keys() - pairs.keys())}
    return pairs, alone
