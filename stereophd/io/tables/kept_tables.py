"""Tables whose rows another process can write again.

The rows go to parts of an unfinished run (`stereophd.io.outputs.saved`) as Arrow IPC streams, compressed with LZ4, in
the order in which they go to the table. A process that continues replays them through a table of its own: the bytes are
those of an undisturbed run, because the rows are.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from stereophd.errors import InputError
from stereophd.io.outputs.saved import KeptParts
from stereophd.io.tables.writing import Complete, TableWriter

_OPTIONS = pa.ipc.IpcWriteOptions(compression="lz4")


class KeptTable(TableWriter):
    """A `TableWriter` that keeps its rows in `kept`, too.

    The rows that `kept` holds already are written first. Raises InputError when the file cannot be made, or these rows
    are damaged.
    """

    def __init__(
        self,
        path: Path | str,
        schema: pa.Schema,
        metadata: Mapping[Any, Any] | None,
        kept: KeptParts,
        complete: Complete | None = None,
    ) -> None:
        super().__init__(path, schema, metadata, complete)
        self._kept = kept
        self._plain = schema.with_metadata(None)
        # Rows that wait for the rest of their group and are converted already; all of them are kept.
        self._waiting: pa.Table | None = None
        try:
            for content in kept:
                self._replay(content)
        except InputError:
            self.abandon()
            raise
        except (pa.ArrowException, OSError, ValueError) as error:
            self.abandon()
            raise InputError(f"{kept.path}: expected rows of {self.path.name}, found something else") from error

    def _replay(self, content: bytes) -> None:
        with pa.ipc.open_stream(content) as stream:
            table = stream.read_all()
        table.validate(full=True)
        if table.schema != self._plain:
            raise ValueError("other columns")
        self.rows += table.num_rows
        self._waiting = table if self._waiting is None else pa.concat_tables([self._waiting, table]).combine_chunks()
        self._buffered = self._waiting.num_rows
        if self._buffered == self._row_group_rows:
            self._flush()

    def keep(self) -> int:
        """Bring all rows so far to the disk; return the number of parts that count then."""
        if self._buffer:
            self._waiting = self._take()
            self._buffered = self._waiting.num_rows
        return self._kept.flush()

    def _take(self) -> pa.Table:
        waiting, self._waiting = self._waiting, None
        if not self._buffer:
            self._buffered = 0
            return waiting
        table = super()._take()
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, self._plain, options=_OPTIONS) as stream:
            stream.write_table(table)
        self._kept.append(sink.getvalue().to_pybytes())
        return table if waiting is None else pa.concat_tables([waiting, table]).combine_chunks()
