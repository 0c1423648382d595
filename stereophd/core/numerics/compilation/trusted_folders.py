"""Folders whose code is run: those that nobody else can change.

A kept kernel is machine code in a pickle. It is read only from a folder that belongs to this user or to root, as does
every folder that leads to it, and that no other user can write to; a folder that everybody may write to, such as the
temporary one, may lead to it if entries there can be renamed by their owners alone (sticky). As long as that holds at
the time of the look nobody else can exchange a part of the path, so that what is opened next is what was looked at.
"""

import os
import stat
from functools import cache
from pathlib import Path

_HAS_USERS = hasattr(os, "getuid")

# Owner alone: from the moment in which a folder of kernels is made.
FOLDER_MODE = 0o700


def is_trusted(folder: Path) -> bool:
    """Whether a folder is there, and nobody but this user and root can change it, its files, or what leads to it."""
    try:
        files = [entry.stat(follow_symlinks=False) for entry in os.scandir(folder) if not entry.is_dir()]
        return _is_path_safe(folder, is_last=True) and all(_is_safe(status, is_last=True) for status in files)
    except OSError:
        return False


def can_make(folder: Path) -> bool:
    """Whether this user can make a folder, or write to the one that is there, and nobody else can change it."""
    there = next((place for place in (folder, *folder.parents) if os.path.lexists(place)), None)
    if there is None or not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        return False
    try:
        return _is_path_safe(there, is_last=there == folder)
    except OSError:
        return False


def make_folder(folder: Path) -> bool:
    """Make a folder for this user alone, if it may be; return whether it is trusted, or raise OSError."""
    if not can_make(folder):
        return is_trusted(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=FOLDER_MODE, exist_ok=True)
    return is_trusted(folder)


def _is_path_safe(path: Path, is_last: bool) -> bool:
    """Whether a folder and all that lead to it are safe; `is_last`: nobody else may write to the folder itself."""
    real = Path(os.path.realpath(path, strict=True))
    places = dict.fromkeys(place for start in (real, path.absolute()) for place in (start, *start.parents))
    return all(_is_safe(place.lstat(), is_last and place == real) for place in places)


def _is_safe(status: os.stat_result, is_last: bool) -> bool:
    """Whether only this user and root can change a place, or, unless it is the last, rename what lies there."""
    if not _HAS_USERS:
        return True
    if status.st_uid not in (0, os.getuid()):
        return False
    if stat.S_ISLNK(status.st_mode):
        return True
    others = bool(status.st_mode & stat.S_IWOTH)
    others |= bool(status.st_mode & stat.S_IWGRP) and not _is_own_group(status.st_gid)
    return not others or (not is_last and bool(status.st_mode & stat.S_ISVTX))


@cache
def _is_own_group(number: int) -> bool:
    """Whether a group is that of this user alone, as many systems make one for each user."""
    import grp
    import pwd

    try:
        user, group = pwd.getpwuid(os.getuid()), grp.getgrgid(number)
    except KeyError:
        return False
    return number == user.pw_gid and group.gr_name == user.pw_name and set(group.gr_mem) <= {user.pw_name}
