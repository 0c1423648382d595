"""Kinds by name: the modules of a package, and those that other distributions add to it as entry points.

A distribution adds a module to one of `GROUPS`, for example in its `pyproject.toml`::

    [project.entry-points."stereophd.motion"]
    spiral = "my_package.spiral"

The module offers what a module of the package itself offers (`FORMAT`, `SETTINGS` or `LENS`).
"""

import pkgutil
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType, ModuleType

from stereophd.errors import InputError

# Package -> group of entry points.
GROUPS = {
    "stereophd.io.formats": "stereophd.formats",
    "stereophd.core.bodies.shapes": "stereophd.shapes",
    "stereophd.core.motion": "stereophd.motion",
    "stereophd.core.multi.filter_settings": "stereophd.filters",
    "stereophd.core.geometry.lenses": "stereophd.lenses",
}


@cache
def module_names(package: str) -> Mapping[str, str]:
    """Return the full names of the modules of a package and of its plug-ins, by word, sorted; imports none of them.

    A package, by its full name, that is no key of `GROUPS` takes no plug-ins. Raises InputError if two plug-ins have
    the same name, or one has that of a module of the package.
    """
    names = {info.name: f"{package}.{info.name}" for info in pkgutil.iter_modules(import_module(package).__path__)}
    for entry in _entries().get(package, ()):
        if entry.name in names:
            raise InputError(
                f"{_described(entry)}: expected a name that is free, found {entry.name}, which is {names[entry.name]}"
            )
        names[entry.name] = entry.value
    return MappingProxyType(dict(sorted(names.items())))


def import_member(package: str, word: str) -> ModuleType:
    """Import the module of a word of `module_names`; raises InputError if it is a plug-in that cannot be imported."""
    name = module_names(package)[word]
    if name.startswith(f"{package}."):
        return import_module(name)
    try:
        return import_module(name)
    except Exception as error:
        entry = next(entry for entry in _entries()[package] if entry.name == word)
        raise InputError(
            f"{_described(entry)}: expected a module that can be imported, found {type(error).__name__}: {error}"
        ) from error


@cache
def _entries() -> dict[str, tuple[EntryPoint, ...]]:
    found = entry_points()  # reads the metadata of all that is installed
    return {package: tuple(found.select(group=group)) for package, group in GROUPS.items()}


def _described(entry: EntryPoint) -> str:
    distribution = "" if entry.dist is None else f" of {entry.dist.name} {entry.dist.version}"
    return f"plug-in {entry.group}: {entry.value}{distribution}"
