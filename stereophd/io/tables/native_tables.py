"""Tables with native columns, as Parquet or as text with a header (CSV), which other programs write more easily."""

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa

from stereophd.io.file_kinds import CSV, PARQUET, kind_of_file
from stereophd.io.interchange.documents.text_tables import header_of, read_batches
from stereophd.io.tables.reading import check_columns, checked_table, open_parquet, read_table


def column_names(path: Path, what: str) -> list[str]:
    """Return the names of the columns of a table, which should be `what`."""
    if _is_text(path):
        return header_of(path)[1]
    with open_parquet(path, what) as parquet:
        return list(parquet.schema_arrow.names)


def read_native_table(
    path: Path, required: Mapping[str, pa.DataType], optional: Mapping[str, pa.DataType], what: str
) -> pa.Table:
    """Read columns of a table, checked and in their types, as `read_table`; a text has no metadata."""
    if not _is_text(path):
        return read_table(path, required, optional, what)
    separator, names = header_of(path)
    kinds = {name: kind for name, kind in {**required, **optional}.items() if name in names}
    check_columns(pa.schema([(name, kinds.get(name, pa.null())) for name in names]), required, optional, path)
    batches = list(read_batches(path, separator, kinds, str(path)))
    return checked_table(pa.Table.from_batches(batches, pa.schema(kinds)), required, optional, path)


def _is_text(path: Path) -> bool:
    kind = kind_of_file(path)
    return kind == CSV or (kind != PARQUET and path.suffix.lower() == ".csv")
