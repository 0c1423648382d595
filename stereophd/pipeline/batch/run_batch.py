"""Run a command on many inputs: a folder for each, ``summary.parquet``, and one row for what failed.

Any fault of one input is a row of the summary and stops no other. The files do not depend on where and
in which order the inputs are done, nor on workers that die.
"""

import contextlib
import logging
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from stereophd.errors import GateError, InputError, StereophdError
from stereophd.io.outputs.atomic import atomic_write, output_folder
from stereophd.io.outputs.disk import TEMPORARY_PREFIX
from stereophd.io.outputs.locks import output_lock
from stereophd.io.outputs.provenance import to_metadata
from stereophd.io.tables.schemas import STRING
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.batch.names import expand, folder_names
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.pipeline.workers.places import ATTEMPTS, Workers, complete, open_workers
from stereophd.wording import LOGGER

SUMMARY_FILE = "summary.parquet"

DONE, GATE, FAILED = "done", "gate failed", "failed"

# Columns of every summary; a command adds its own.
COMMON = {"log": STRING, "folder": STRING, "status": STRING, "message": STRING}


@dataclass(frozen=True)
class Item:
    """One input of a batch."""

    name: str  # Name of its folder
    source: str  # As the user gave it, for messages and the summary
    paths: tuple[Path, ...]  # Its files, absolute: workers may have another current folder


def log_items(logs: Sequence[Path | str]) -> list[Item]:
    """Return an item for each log or file of a pattern; InputError when none fits a pattern or one is given twice."""
    paths = expand(logs)
    places = [(Path(os.path.abspath(path)),) for path in paths]
    return [Item(*item) for item in zip(folder_names(paths), map(str, paths), places, strict=True)]


# Does one item: called with it, its output folder and a progress function; returns its report.
Work = Callable[[Item, Path, Progress], Mapping[str, Any]]


@dataclass(frozen=True)
class Batch:
    """What is done for each input."""

    items: Sequence[Item]
    work: Work  # A function of a module, or `functools.partial` of one, that writes the item's folder
    # A function of a module that takes the values of a row from a report.
    values: Callable[[Mapping[str, Any]], Mapping[str, Any]]
    files: Sequence[str]  # Files that `work` may write in the folder of an item
    columns: Mapping[str, pa.DataType]  # Names and types of its values; they are null where it fails
    # Provenance of ``summary.parquet``; the hashes of the inputs are added, as ``NAME.role``.
    record: Mapping[str, Any]


@dataclass(frozen=True)
class _Outcome:
    """Values of a row, their exit code, messages that another process logged meanwhile, and hashes of the inputs."""

    row: Mapping[str, Any]
    exit_code: int = 0
    logged: tuple[tuple[int, str], ...] = ()
    inputs: Mapping[str, str] = field(default_factory=dict)


def run_batch(
    batch: Batch,
    out_dir: Path | str,
    jobs: int = 1,
    dask: str | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Progress = ignore,
) -> dict[str, Any]:
    """Do all items of a batch, into ``NAME/`` for each item and ``summary.parquet``.

    They run on `jobs` processes of this machine, or on the workers of the Dask scheduler at an address, which see the
    files under the same paths. `force` and `resume` say whether the outputs of an earlier run may be replaced, and
    whether finished ones may stay; what they mean for an item is its `work`'s matter. Returns ``logs``, the rows of the
    summary, which may hold more than the file, the numbers ``done``, ``failed`` and ``gates_failed`` (done, but with a
    gate that failed), and ``exit_code``. What is wrong with an item is logged as an error. Raises InputError when the
    output folder cannot be used, no scheduler answers, or workers have another version of the package.
    """
    out = Path(out_dir)
    with output_lock(out):
        _check_folder(batch, out, force, resume)
        with open_workers(jobs, dask) as workers:
            outcomes = _outcomes(batch, out.absolute(), workers, progress)
        rows = [{**dict.fromkeys((*COMMON, *batch.columns)), **outcome.row} for outcome in outcomes]
        _write_summary(out / SUMMARY_FILE, rows, batch, _all_inputs(batch, outcomes))
    failed = sum(row["status"] == FAILED for row in rows)
    exit_code = max((outcome.exit_code for outcome in outcomes), default=0)
    gates = sum(row["status"] == GATE for row in rows)
    return {
        "logs": rows, "done": len(rows) - failed, "failed": failed, "gates_failed": gates, "exit_code": exit_code
    }  # fmt: skip


def _check_folder(batch: Batch, out: Path, force: bool, resume: bool) -> None:
    """Check that an output folder may be used; without its summary the batch there is not finished."""
    names = [SUMMARY_FILE, *(f"*/{name}" for name in (*batch.files, f"{TEMPORARY_PREFIX}*"))]
    found = output_folder(out, True, names)
    if found and not (force or resume):
        raise InputError(
            f"output folder {out} already holds {found[0]}; use `resume=True` to do what is missing, or `force=True` "
            "to replace it"
        )
    others = sorted({path.parts[0] for path in found if len(path.parts) > 1} - {item.name for item in batch.items})
    if others:
        LOGGER.warning("%s: folders of inputs that are not in this batch stay: %s", out, ", ".join(others))
    (out / SUMMARY_FILE).unlink(missing_ok=True)


def _outcomes(batch: Batch, out: Path, workers: Workers, progress: Progress) -> list[_Outcome]:
    """Do the items; return what became of each, in their order."""
    found: dict[int, _Outcome] = {}
    total = len(batch.items)

    def tick(done: float = 0, of: float = 0) -> None:
        progress(len(found), total)

    attempt = partial(
        _attempt, batch.work, batch.values, out, collect=workers.remote, tick=ignore if workers.remote else tick
    )
    for number, outcome in complete(workers, attempt, batch.items):
        item = batch.items[number]
        if outcome is None:
            why = f"{item.source}: the worker process died {ATTEMPTS} times, or once alone: is there enough memory?"
            outcome = _Outcome(_row(item, FAILED, why), InputError.exit_code)
        for level, text in outcome.logged:
            LOGGER.log(level, "%s", text)
        if outcome.row["status"] != DONE:
            LOGGER.error("%s: %s", item.name, outcome.row["message"])
        found[number] = outcome
        tick()
    return [found[number] for number in range(total)]


def _attempt(
    work: Work,
    values: Callable[[Mapping[str, Any]], Mapping[str, Any]],
    out: Path,
    item: Item,
    collect: bool,
    tick: Progress,
) -> _Outcome:
    """Do one item; any failure becomes its outcome."""
    with _collected(collect) as logged:
        try:
            report = work(item, out / item.name, tick)
            return _Outcome({**_row(item, DONE, ""), **values(report)}, 0, tuple(logged), _inputs(report))
        except GateError as error:
            found = {} if error.report is None else values(error.report)
            inputs = _inputs(error.report or {})
            return _Outcome({**_row(item, GATE, str(error)), **found}, error.exit_code, tuple(logged), inputs)
        except InputError as error:
            return _Outcome(_row(item, FAILED, str(error)), error.exit_code, tuple(logged))
        except Exception as error:
            text = " ".join(str(error).split())
            if not isinstance(error, StereophdError):
                text = f"internal error: {type(error).__name__}: {text or 'no details'}"
            return _Outcome(_row(item, FAILED, text), StereophdError.exit_code, tuple(logged))


def _inputs(report: Mapping[str, Any]) -> Mapping[str, str]:
    """Return the hashes of the inputs of a report by their roles."""
    return dict(report.get("provenance", {}).get("inputs", {}))


def _all_inputs(batch: Batch, outcomes: Sequence[_Outcome]) -> dict[str, str]:
    """Return the hashes of what the batch and its items have read; inputs of all items keep their role."""
    common: dict[str, str] = dict(batch.record["inputs"])
    own = {
        f"{item.name}.{role}": digest
        for item, outcome in zip(batch.items, outcomes, strict=True)
        for role, digest in outcome.inputs.items()
        if role not in common
    }
    return {**common, **own}


def _row(item: Item, status: str, message: str) -> dict[str, Any]:
    return {"log": item.source, "folder": item.name, "status": status, "message": message}


@contextlib.contextmanager
def _collected(collect: bool) -> Iterator[list[tuple[int, str]]]:
    """Collect the messages of this thread, if it runs in a process that shows none."""
    messages: list[tuple[int, str]] = []
    if not collect:
        yield messages
        return

    thread = threading.get_ident()

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.thread == thread:
                messages.append((record.levelno, record.getMessage()))

    handler = Collector(logging.WARNING)
    LOGGER.addHandler(handler)
    try:
        yield messages
    finally:
        LOGGER.removeHandler(handler)


def _write_summary(path: Path, rows: Sequence[Mapping[str, Any]], batch: Batch, inputs: Mapping[str, str]) -> None:
    """Write one row per item; `inputs` are the hashes of all inputs."""
    metadata = to_metadata({**batch.record, "inputs": dict(inputs)})
    columns = {**COMMON, **batch.columns}
    fields = [pa.field(name, kind, nullable=name not in COMMON) for name, kind in columns.items()]
    with atomic_write(path) as temporary, TableWriter(temporary, pa.schema(fields), metadata) as table:
        if rows:
            texts = {name: [str(row[name] or "") for row in rows] for name, kind in columns.items() if kind == STRING}
            table.append({name: [row[name] for row in rows] for name in columns} | texts)
