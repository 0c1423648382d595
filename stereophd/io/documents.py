"""The one reader of documents that other programs (or strangers) wrote: none of them expands without end.

A small file may claim to be large: YAML aliases and merges, members of archives, arrays that a header announces. Every
claim is therefore counted before it is believed, and a document that exceeds a limit is an `InputError`. (Entities of
XML are bounded by the parser itself, Expat since 2.4.1.)
"""

import gzip
import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import yaml

from stereophd.errors import InputError
from stereophd.wording import instant

# Bytes of a document that is held in memory as a whole; far more than any camera file or configuration needs.
MAX_DOCUMENT_BYTES = 8_000_000
# Values of a YAML document, its aliases and merges expanded; no real one comes near this.
MAX_NODES = 100_000
# Data that is packed or announced may expand to so many bytes, and so many for each byte of the file.
FREE_BYTES, MAX_EXPANSION = 64_000_000, 200
MAX_MEMBERS = 10_000
# Lists and mappings within each other; parsers that call themselves end the process far beyond it.
MAX_DEPTH = 100
# More detections of one instant than any cameras make.
MAX_DETECTIONS_AT_ONCE = 1_000_000

# PyYAML's loader of plain data: in C where it was built with it, six times as fast.
SAFE_LOADER: type[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


# A longer reason is cut in the message.
MAX_SHOWN = 200


@contextmanager
def expecting(what: str, where: object) -> Iterator[None]:
    """Refuse a file whose reading fails in the block: it cannot be read, or is not `what` was expected."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # what libraries raise at another structure has no common name
        if isinstance(error, OSError) and error.errno is not None:
            raise InputError(f"{where}: cannot be read: {error.strerror or error}") from error
        reason = " ".join(str(error).split())[:MAX_SHOWN]
        reason = f"missing key {reason}" if isinstance(error, KeyError) else reason or type(error).__name__
        raise InputError(f"{where}: expected {what}, found: {reason}") from error


def need_package(package: str, purpose: str, module: str = "") -> Any:
    """Import what is needed of an optional package, by default the module of its name; InputError without it."""
    try:
        return import_module(module or package)
    except ImportError as error:
        raise InputError(f"{purpose} needs the package {package}; install it with: pip install {package}") from error


def most_bytes(packed: int) -> int:
    """Return the number of bytes to which `packed` bytes of a file may expand."""
    return FREE_BYTES + MAX_EXPANSION * packed


def check_claim(claimed: int, present: int, where: str) -> None:
    """Refuse, by an InputError, data that claim more bytes than the `present` ones may expand to (`most_bytes`)."""
    if claimed > most_bytes(present):
        raise InputError(
            f"{where}: expected data that the file holds, found {present} bytes that claim to be {claimed}"
        )


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a document; InputError if it cannot be read, or is larger than any of its kind."""
    with expecting("a document", path), open(path, "rb") as stream:
        content = stream.read(MAX_DOCUMENT_BYTES + 1)
    if len(content) > MAX_DOCUMENT_BYTES:
        raise InputError(f"{path}: expected a document of at most {MAX_DOCUMENT_BYTES // 10**6} MB, found more")
    return content


def compose_yaml(content: str | bytes, where: str, loader: type[Any]) -> yaml.Node | None:
    """Return the nodes of a YAML document that is finite when its aliases and merges are expanded.

    `where` is the file, for messages; `loader` is PyYAML's class of loaders. Raises `yaml.YAMLError` when the text is
    not YAML, and InputError when it expands beyond `MAX_NODES` values, or is nested deeper than `MAX_DEPTH`.
    """
    depth = 0
    for event in yaml.parse(content, Loader=loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise InputError(f"{where}: expected a document, found lists or mappings nested too deeply")
    node: yaml.Node | None = yaml.compose(content, Loader=loader)
    if node is not None:
        _count_expanded(node, where, {}, set())
    return node


def _count_expanded(node: yaml.Node, where: str, counts: dict[int, int], above: set[int]) -> int:
    """Return the number of values of a node without expanding it: what an alias repeats is counted once."""
    if id(node) in counts:
        return counts[id(node)]
    if id(node) in above:
        raise InputError(f"{where}:{node.start_mark.line + 1}: expected a finite document, found one that holds itself")
    above.add(id(node))
    children: list[yaml.Node] = []
    if isinstance(node, yaml.MappingNode):
        children = [part for pair in node.value for part in pair]
    elif isinstance(node, yaml.SequenceNode):
        children = node.value
    total = 1 + sum(_count_expanded(child, where, counts, above) for child in children)
    above.discard(id(node))
    if total > MAX_NODES:
        line = node.start_mark.line + 1
        raise InputError(
            f"{where}:{line}: expected a finite document, found aliases that expand without end, or more than "
            f"{MAX_NODES} values"
        )
    counts[id(node)] = total
    return total


def check_instant(count: int, time_s: float, where: str) -> None:
    """Refuse, by an InputError, a frame of more than `MAX_DETECTIONS_AT_ONCE` detections: no camera makes as many."""
    if count > MAX_DETECTIONS_AT_ONCE:
        raise InputError(
            f"{where}: expected at most {MAX_DETECTIONS_AT_ONCE} detections at one time, found more at "
            f"{instant(time_s, 9)}"
        )


def load_yaml(content: str | bytes, where: str, loader: type[Any] = SAFE_LOADER) -> Any:
    """Return the data of a YAML document; see `compose_yaml`."""
    if compose_yaml(content, where, loader) is None:
        return None
    return yaml.load(content, Loader=loader)


def load_npz(path: Path) -> dict[str, Any]:
    """Return the arrays of a NumPy archive whose headers claim no more than the archive holds.

    Raises InputError when the file is not such an archive.
    """
    try:
        with open_archive(path) as archive:
            return {info.filename.removesuffix(".npy"): _load_npy(archive, info, path) for info in archive.infolist()}
    except (ValueError, OSError, MemoryError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: expected arrays of numbers (NPZ), found: {error}") from error


def _load_npy(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> Any:
    with archive.open(info) as member:
        content = _bounded(member, MAX_DOCUMENT_BYTES, f"{path}: {info.filename}").read()
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    if dtype.hasobject or int(np.prod(shape, dtype=object)) * dtype.itemsize > len(content):
        raise ValueError(f"{info.filename} claims an array of {shape} {dtype} in {len(content)} bytes")
    return np.load(io.BytesIO(content), allow_pickle=False)


@contextmanager
def open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive; InputError if it is none, is damaged, or has more than `MAX_MEMBERS` members."""
    try:
        with zipfile.ZipFile(path) as archive:
            if len(archive.infolist()) > MAX_MEMBERS:
                raise InputError(f"{path}: expected at most {MAX_MEMBERS} members, found {len(archive.infolist())}")
            yield archive
    except (zipfile.BadZipFile, NotImplementedError, OSError) as error:  # OSError: a place before the beginning
        raise InputError(f"{path}: expected a zip archive, found a damaged one: {error}") from error


def read_member(path: Path, name: str) -> bytes | None:
    """Return a member of an archive as a document, or its ``.gz``, unpacked; None if there is neither.

    Raises InputError when the archive is damaged, or the member expands beyond `MAX_DOCUMENT_BYTES`.
    """
    with open_archive(path) as archive:
        names = set(archive.namelist())
        if name not in names and f"{name}.gz" not in names:
            return None
        with archive.open(name if name in names else f"{name}.gz") as member:
            stream = member if name in names else gzip.GzipFile(fileobj=member)
            return _bounded(cast(IO[bytes], stream), MAX_DOCUMENT_BYTES, f"{path}: {name}").read()


@contextmanager
def open_packed_table(path: Path, name: str) -> Iterator[IO[bytes]]:
    """Open a gzipped member of an archive as a stream that ends in an error where it expands beyond `most_bytes`.

    Raises InputError when the archive lacks the member, or is damaged; while reading, when the member expands too far.
    """
    with open_archive(path) as archive:
        if name not in archive.namelist():
            raise InputError(f"{path}: expected {name} in the archive, found none")
        with archive.open(name) as packed, gzip.open(packed) as table:
            yield _bounded(cast(IO[bytes], table), most_bytes(path.stat().st_size), f"{path}: {name}")


class _Bounded(io.RawIOBase):
    """A stream that raises `InputError` once it has given more than a number of bytes."""

    def __init__(self, stream: IO[bytes], most: int, where: str) -> None:
        self._stream, self._remaining, self._most, self._where = stream, most, most, where

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._stream.read(len(buffer))
        self._remaining -= len(data)
        if self._remaining < 0:
            raise InputError(f"{self._where}: expected at most {self._most} bytes when unpacked, found more")
        buffer[: len(data)] = data
        return len(data)


def _bounded(stream: IO[bytes], most: int, where: str) -> IO[bytes]:
    return cast(IO[bytes], io.BufferedReader(_Bounded(stream, most, where), 1 << 16))


def check_hdf5(file: Any, path: Path) -> None:
    """Refuse, by an InputError, an HDF5 file (h5py) in which a dataset claims bytes that were never written."""

    def check(name: str, item: Any) -> None:
        if hasattr(item, "nbytes"):
            check_claim(int(item.nbytes), int(item.id.get_storage_size()), f"{path}: {name}")

    file.visititems(check)


def check_parquet(metadata: Any, path: Path | str) -> None:
    """Refuse a Parquet file whose footer claims far more values than its bytes can hold, as `check_claim` does."""
    packed = sum(
        metadata.row_group(i).column(k).total_compressed_size
        for i in range(metadata.num_row_groups)
        for k in range(metadata.num_columns)
    )
    check_claim(8 * metadata.num_rows * metadata.num_columns, packed, str(path))
