"""Tables of text, or Parquet files, in pieces, with Arrow's reader; what is wrong with them is an `InputError`."""

import contextlib
import csv
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.documents import expecting
from stereophd.io.file_kinds import PARQUET, kind_of_file

NULLS = ["", "NA", "N/A", "NaN", "nan", "null", "NULL", "None"]
_QUOTED = re.compile(r'"[^"]*"')
# Arrow's words for a row with another number of columns; it shows long rows in part.
_TOO_SHORT = re.compile(r"Expected (?P<expected>\d+) columns, got (?P<found>\d+): (?P<line>.*)")
BLOCK_BYTES = 1 << 22
# Bytes from the end of a file in which its last line is looked for.
TAIL_BYTES = 1 << 16


def first_lines(path: Path, count: int) -> list[str]:
    """Return the first lines of a text file, without the ends of lines.

    Raises InputError when the file cannot be read, or is no text.
    """
    with expecting("text in UTF-8", path), open(path, encoding="utf-8-sig") as stream:
        return [line.rstrip("\r\n") for line, _ in zip(stream, range(count), strict=False)]


def header_of(path: Path) -> tuple[str, list[str]]:
    """Return what separates the columns of a table (`PARQUET` of a Parquet file), and their names in its first line."""
    if kind_of_file(path) == PARQUET:
        with expecting("a table", path):
            return PARQUET, list(pq.read_schema(path).names)
    line = (first_lines(path, 1) or [""])[0]
    return separator_of(line), split_line(line)


def separator_of(line: str) -> str:
    """Return what separates the columns of a line, outside quotes: comma, semicolon, tab or space."""
    bare = _QUOTED.sub("", line)
    return next((s for s in (",", ";", "\t") if s in bare), " ")


def split_line(line: str) -> list[str]:
    """Return the words of a line of a table; a word in quotes may hold the separator."""
    separator = separator_of(line)
    words = next(csv.reader([line], delimiter=separator, skipinitialspace=separator != " "), [])
    return [word.strip() for word in words]


def read_batches(
    source: Path | IO[bytes],
    separator: str,
    kinds: Mapping[str, pa.DataType],
    where: str,
    names: list[str] | None = None,
    skip: int = 0,
) -> Iterator[pa.RecordBatch]:
    """Yield the columns of `kinds` (column -> type) of a table in pieces.

    `separator` is that of `header_of`; `names` are those of all columns where the file has no header; `skip`
    lines stand before the header (or the first row). Raises InputError, naming the file `where`, for a row with too
    many or too few columns, or a value of another type.
    """
    import pyarrow.csv  # costly to import

    try:
        if separator == PARQUET:
            for batch in pq.ParquetFile(source).iter_batches(columns=list(kinds)):
                columns = [batch.column(name).cast(kind) for name, kind in kinds.items()]
                yield pa.record_batch(
                    [one.fill_null("") if one.type == pa.string() else one for one in columns], list(kinds)
                )
            return
        yield from pyarrow.csv.open_csv(
            source,
            read_options=pyarrow.csv.ReadOptions(
                use_threads=False, block_size=BLOCK_BYTES, column_names=names, skip_rows=skip
            ),
            parse_options=pyarrow.csv.ParseOptions(delimiter=separator),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=dict(kinds), include_columns=list(kinds), null_values=NULLS, strings_can_be_null=False
            ),
        )
    except pa.ArrowException as error:
        reason = str(error).splitlines()[0]
        column = re.match(r"In CSV column #(\d+): ", reason)
        names = header_of(source)[1] if names is None and not skip and isinstance(source, Path) else names
        if column is not None and names is not None and int(column[1]) < len(names):
            reason = f"in column {names[int(column[1])]}: {reason.removeprefix(column[0])}"
        hint = "; the last line is too short: the file seems to be cut off" if _is_cut_off(source, reason) else ""
        raise InputError(f"{where}: expected rows of a table of numbers, found: {reason}{hint}") from error


def _is_cut_off(source: Path | IO[bytes], reason: str) -> bool:
    """Whether Arrow refused the last line of a file because it has too few columns."""
    refused = _TOO_SHORT.search(reason)
    if refused is None or not isinstance(source, Path) or int(refused["found"]) >= int(refused["expected"]):
        return False
    with contextlib.suppress(OSError), open(source, "rb") as stream:
        stream.seek(max(0, source.stat().st_size - TAIL_BYTES))
        lines = stream.read().decode("utf-8", "replace").splitlines()
        return bool(lines) and lines[-1].startswith(refused["line"].removesuffix(" ..."))
    return False


def number_batches(
    source: Path | IO[bytes], separator: str, columns: Iterable[str], where: str, names: list[str] | None = None,
    skip: int = 0,
) -> Iterator[dict[str, Array]]:  # fmt: skip
    """Yield columns of numbers in pieces, NaN where they are empty; the rest as `read_batches`."""
    kinds = dict.fromkeys(columns, pa.float64())
    for batch in read_batches(source, separator, kinds, where, names, skip):
        yield {name: batch.column(name).to_numpy(zero_copy_only=False) for name in kinds}


def read_matrix(path: Path) -> Array | None:
    """Return a small table of numbers without a header, or None if the file is not one."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        rows = [
            [float(word) for word in line.replace(",", " ").replace(";", " ").split()] for line in lines if line.strip()
        ]
    except (OSError, ValueError):
        return None
    if not rows or len({len(row) for row in rows}) != 1:
        return None
    return np.array(rows)
