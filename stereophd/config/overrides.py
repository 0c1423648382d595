"""Overrides of a configuration: `KEY.PATH=VALUE`, grafted onto the tree of its file."""

from __future__ import annotations

from stereophd.config.yaml import KeyPath, Tree, parse_yaml
from stereophd.errors import InputError, unknown_camera

# A longer number in a key path is a name, not the index of a list.
MAX_INDEX_DIGITS = 9
# A longer override is shortened in messages.
MAX_SHOWN_OVERRIDE = 200


def parse_override(text: str) -> tuple[KeyPath, Tree]:
    """Return the key path and the value of `KEY.PATH=VALUE`."""
    key, separator, value = text.partition("=")
    source = f"`overrides` {text}" if len(text) <= MAX_SHOWN_OVERRIDE else f"`overrides` {text[:MAX_SHOWN_OVERRIDE]}..."
    if not separator or not all(key.strip().split(".")):
        raise InputError(f"{source}: expected KEY.PATH=VALUE")
    return key_path(key), parse_yaml(value, source, numbered=False)


def key_path(key: str) -> KeyPath:
    """Return the parts of a dotted key; a part of digits is the index of a list."""
    return tuple(
        int(part) if part.isdecimal() and len(part) <= MAX_INDEX_DIGITS else part for part in key.strip().split(".")
    )


def apply_override(tree: Tree, path: KeyPath, value: Tree, key: KeyPath = ()) -> None:
    """Put a value at a path of the tree; an InputError if something on the path is no mapping or list."""
    _refuse_unknown_camera(tree, path, value)
    try:
        tree.graft(path, value, key)
    except TypeError as error:
        where = ".".join(map(str, path))
        raise InputError(
            f"{value.place(())}: {where}: expected the path of a key, found no mapping or list that has {error}"
        ) from None


def _refuse_unknown_camera(tree: Tree, path: KeyPath, value: Tree) -> None:
    """Refuse a single value of a camera that is not there: its other values would be missed one by one."""
    cameras = tree.data.get("cameras") if isinstance(tree.data, dict) else None
    if path[0] != "cameras" or len(path) <= 2 or not isinstance(cameras, dict) or not cameras:
        return
    if str(path[1]) not in cameras:
        raise InputError(f"{value.place(())}: {'.'.join(map(str, path))}: {unknown_camera(path[1], cameras)}")
