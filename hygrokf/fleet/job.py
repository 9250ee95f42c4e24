"""A job: one task for one turbine, with the files that it reads, the key of their content, and its row on
disk."""

from __future__ import annotations

import hashlib
import json
import math
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from hygrokf.cases.case_file import CaseFault
from hygrokf.data.files import (
    BESIDE_DISCOVERY,
    CLIMATE,
    DISCOVERY,
    DISCOVERY_SERIES,
    FIT,
    REPORT,
    SUMMARIES,
    TRANSFER,
    TRANSFER_SERIES,
    write_text_whole,
)
from hygrokf.data.result_file import result_text
from hygrokf.data.structured import Cell, StructureFault, plain, structured
from hygrokf.data.toml_form import FormFault, read_toml
from hygrokf.errors import HygrokfError
from hygrokf.estimation.moments import DigitsFault
from hygrokf.estimation.rates_fault import RatesFault
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import one_line
from hygrokf.version import __version__

Row: TypeAlias = Mapping[str, Cell]
"""One turbine's row of the fleet's table: column → cell, None without a value."""
ROW = "row.json"
"""The last file that a job writes; a job with this file is done."""
DONE, FAILED, LOST = "done", "failed", "lost"
"""Status of a job: it has results, its data have a fault, or its process died."""
WRITES = (
    ROW, FIT, "series.npz", "evaluation.json", REPORT, BESIDE_DISCOVERY, DISCOVERY, DISCOVERY_SERIES,
    TRANSFER,
    TRANSFER_SERIES, CLIMATE, "climate.csv", "test_profile.csv", "test_profile.png",
    *SUMMARIES,
)  # fmt: skip


class FleetFault(FormFault):
    """The fleet cannot be run; `faults` holds every reason."""


def cell_number(row: Row, column: str) -> float:
    """Return the number in a column of a row; NaN if there is none."""
    value = row.get(column)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


STATEMENT_SEPARATOR = " | "
"""Separates the statements of a cell, because sentences contain semicolons."""


def flat(cell: Cell) -> bool | int | float | str | None:
    """Return a cell as a plain value: statements as text, several names or statements joined to one text."""
    if isinstance(cell, Statement):
        return cell.text
    if isinstance(cell, tuple):
        has_statement = any(isinstance(item, Statement) for item in cell)
        return (STATEMENT_SEPARATOR if has_statement else " ").join(map(str, cell))
    return cell


def cell_text(row: Row, column: str) -> str:
    """Return the text in a column of a row; "" without a value."""
    value = flat(row.get(column))
    return "" if value is None else one_line(str(value))


@dataclass(frozen=True)
class Job:
    """The task of a fleet for one turbine.

    turbine: its name, unique in the fleet. task: a name of `tasks.TASKS`. case: its case file. folder: of its
        results. fit: the fitted model for the task, or None. options: of the task, as plain data. key: hash
        of everything that the job reads (`content_key`).
    """

    turbine: str
    task: str
    case: Path
    folder: Path
    fit: Path | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    key: str = ""

    def __post_init__(self) -> None:
        for name in ("case", "folder", "fit"):
            if (path := getattr(self, name)) is not None:
                object.__setattr__(self, name, Path(path))

    def __reduce__(self) -> tuple[type[Job], tuple[object, ...]]:
        # paths as text, because earlier versions of Python on a cluster cannot read paths pickled by 3.13
        paths = (str(self.case), str(self.folder), None if self.fit is None else str(self.fit))
        return Job, (self.turbine, self.task, *paths, dict(self.options), self.key)


Work: TypeAlias = Callable[[Job], Row]
"""A function that does a job: it writes results into the job's folder and returns the columns of the task; an
exception means that the turbine failed.  Processes and Dask workers import it by its name from its module."""


def _row(data: Any) -> Row:
    """Return a row from the data of its file. Raises StructureFault."""
    return structured(Mapping[str, Cell], data)  # type: ignore[type-abstract]


def row_of(job: Job, status: str, columns: Row | None = None, reason: str | Statement = "") -> Row:
    """Return the row of a job: the columns common to all tasks, then those of its task; numbers that are not
    finite become None."""
    common = {"turbine": job.turbine, "status": status, "reason": reason, "task": job.task, "key": job.key}
    return _row(plain({**common, **(columns or {})}))


def content_key(job: Job, files: Sequence[Path] = ()) -> str:
    """Return the SHA-256 of everything that determines the results of a job: version, task, options, and the
    bytes of its files.

    The files are the case, the files of its sources, the fit, and `files`. A file that cannot be read counts
    as absent; the job itself reports the fault.
    """
    digest = hashlib.sha256()

    def add_to_hash(*items: object) -> None:
        for item in items:
            item_bytes = item if isinstance(item, bytes) else json.dumps(item, sort_keys=True).encode()
            digest.update(len(item_bytes).to_bytes(8, "little") + item_bytes)

    add_to_hash(__version__, job.turbine, job.task, dict(job.options))
    add_to_hash(_digest(job.case))
    for name in _source_files(job.case):
        add_to_hash(name, _digest(job.case.parent / name))
    for path in (*([job.fit] if job.fit else []), *files):
        add_to_hash(_digest(path / FIT if path.is_dir() else path))
    return digest.hexdigest()


def _digest(path: Path) -> bytes:
    """Return the SHA-256 of a file; b"absent" if it cannot be read."""
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").digest()
    except OSError:
        return b"absent"


def _source_files(case: Path) -> list[str]:
    """Return the files that the sources of a case name; empty if the case cannot be read."""
    try:
        tables = read_toml(case)[1].get("source", [])
    except FormFault:
        return []
    tables = tables if isinstance(tables, list) else [tables]
    names = [table.get("file") for table in tables if isinstance(table, dict)]
    return [name for name in names if isinstance(name, str)]


def stored_row(job: Job) -> Row | None:
    """The row on disk if the same job is done; None if it failed, or if its files or options have changed."""
    try:
        row = _row(json.loads((job.folder / ROW).read_text(encoding="utf-8")))
        is_done = (row["key"], row["turbine"], row["status"]) == (job.key, job.turbine, DONE)
    except (OSError, ValueError, KeyError, TypeError, RecursionError, StructureFault):
        return None
    return row if is_done else None


def clear_folder(job: Job) -> None:
    """Remove the results of an earlier run, made from other data, from the job's folder."""
    job.folder.mkdir(parents=True, exist_ok=True)
    for name in WRITES:
        (job.folder / name).unlink(missing_ok=True)


def write_row(job: Job, row: Row) -> None:
    """Write the row, which marks the job as done; makes the folder if the job's process died before it
    did."""
    job.folder.mkdir(parents=True, exist_ok=True)
    write_text_whole(job.folder / ROW, result_text(row))


def perform(job: Job, work: Work) -> Row:
    """Do a job unless its row is on disk already; an exception becomes the reason in the row."""
    if (stored := stored_row(job)) is not None:
        return stored
    try:
        clear_folder(job)
        row = row_of(job, DONE, work(job))
    except Exception as fault:
        row = row_of(job, FAILED, reason=failure_reason(fault))
    try:
        write_row(job, row)
    except OSError as fault:
        return row_of(job, FAILED, reason=f"{job.folder}: cannot be written: {fault.strerror or fault}")
    return row


def failure_reason(fault: Exception) -> str:
    """Return the reason for a failure on one line; for an unexpected exception, with the place where it was
    raised."""
    faults = getattr(fault, "faults", ())
    message = " ".join(("; ".join(map(str, faults)) if faults else str(fault)).split())
    if isinstance(fault, FormFault) and not isinstance(fault, CaseFault):  # the row itself names the turbine
        message = f"{fault.file}: {message}"
    if isinstance(fault, HygrokfError | RatesFault | DigitsFault) or type(fault) in (ValueError, OSError):
        return message or type(fault).__name__
    stack = traceback.extract_tb(fault.__traceback__)
    place_text = f" ({Path(stack[-1].filename).name}, line {stack[-1].lineno})" if stack else ""
    return f"{type(fault).__name__}: {message or 'no message'}{place_text}"
