"""Which of the options that a user states a format makes use of: one that nothing reads would silently do nothing."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from stereophd.errors import InputError, unknown_camera
from stereophd.io.interchange.base import ExportOptions, ImportOptions

Options = TypeVar("Options", ImportOptions, ExportOptions)


def consulted(options: Options) -> tuple[Options, set[str]]:
    """Return options that note what is read of them, and the names noted so far."""
    read: set[str] = set()

    class Noted(type(options)):  # type: ignore[misc]
        def __getattribute__(self, name: str) -> Any:
            read.add(name)
            return super().__getattribute__(name)

    noted: Options = Noted(**vars(options))
    return noted, read


def with_source_names(options: ImportOptions) -> tuple[ImportOptions, list[str]]:
    """Return options that note the cameras that they are asked to name, and their names in the source so far."""
    asked: list[str] = []

    class Naming(type(options)):  # type: ignore[misc]
        def name(self, camera: str) -> str:
            asked.append(camera)
            named: Callable[[str], str] = super().name
            return named(camera)

    naming: ImportOptions = Naming(**vars(options))
    return naming, asked


def refuse_unread(options: Options, read: set[str], what: str) -> None:
    """Refuse, by an InputError that names the first, options that differ from their defaults and that nothing has read.

    `read` has the names of those that were read, from `consulted`; `what` was read or written: "a source of format
    mot".
    """
    for name in options.plain():
        if name not in read:
            raise InputError(f"`{name}`: expected an option that {what} has a use for, found one that it has not")


def refuse_other_cameras(
    options: ImportOptions, cameras: Sequence[str], in_source: Sequence[str], sources: Sequence[Path]
) -> None:
    """Refuse, by an InputError that names the first, statements about cameras that a source does not have.

    `cameras` are the native names of those it has, `in_source` their names in the source, from `with_source_names`;
    `sources` are the files that the user stated.
    """
    known, files = list(dict.fromkeys(cameras)), str(sources[0])
    if len(sources) > 1:
        files += f" and {len(sources) - 1} more"
    for key in ("rates", "offsets", "frames", "image_sizes"):
        for name in getattr(options, key).named:
            if name not in known:
                raise InputError(f"`{key}`: {unknown_camera(name, known, files)}")
    originals = list(dict.fromkeys(in_source))
    for before in options.rename:
        if before not in originals:
            raise InputError(f"`rename`: {unknown_camera(before, originals, files)}")
