"""One task for one turbine: what it reads, what makes it the same work as before, and its row on disk."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from hygrokf.data.files import (
    BESIDE_DISCOVERY,
    CLIMATE,
    DISCOVERY,
    DISCOVERY_SERIES,
    FIT,
    REPORT,
    TRANSFER,
    TRANSFER_SERIES,
    write_text_whole,
)
from hygrokf.data.result_file import result_text
from hygrokf.data.structured import Cell, JsonObject
from hygrokf.data.toml_form import FormFault, read_toml
from hygrokf.identification.wording import one_line
from hygrokf.version import __version__

Row: TypeAlias = Mapping[str, Cell]
"""One turbine's row of the fleet's table: column → cell, None where there is no value."""
ROW = "row.json"
"""The last file that a job writes: it is done where this is there."""
DONE, FAILED, LOST = "done", "failed", "lost"
"""How a job ended: with results; with a reason that its data give; because its process died."""
WRITES = (
    ROW, FIT, "series.npz", "evaluation.json", REPORT, BESIDE_DISCOVERY, DISCOVERY, DISCOVERY_SERIES,
    TRANSFER,
    TRANSFER_SERIES, CLIMATE, "climate.csv", "test_profile.csv", "test_profile.png",
)  # fmt: skip


class FleetFault(FormFault):
    """A fleet that cannot be run, in one message; `faults` lists every reason."""


def number(row: Row, column: str) -> float:
    """The number in a column; NaN where there is none."""
    value = row.get(column)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def word(row: Row, column: str) -> str:
    """The text in a column; empty where there is none."""
    value = row.get(column)
    return "" if value is None else one_line(str(value))


@dataclass(frozen=True)
class Job:
    """One turbine's share of a fleet's work.

    turbine: its name, unique in the fleet. task: a name of `tasks.TASKS`. case: its case file. folder: where
    its results go. fit: the fitted model that the task uses, or None. options: of the task, complete, as
    plain data. key: of what it reads (`content_key`).
    """

    turbine: str
    task: str
    case: Path
    folder: Path
    fit: Path | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    key: str = ""

    def to_json(self) -> JsonObject:
        """Plain data that any process can make the job from again."""
        paths = {name: None if (p := getattr(self, name)) is None else str(p) for name in _PATHS}
        said: JsonObject = {
            "turbine": self.turbine,
            "task": self.task,
            "options": dict(self.options),
            "key": self.key,
        }
        return said | paths

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Job:
        """A job from the data of `to_json`."""
        return cls(**{**data, **{n: None if data[n] is None else Path(data[n]) for n in _PATHS}})


_PATHS = ("case", "folder", "fit")


@dataclass(frozen=True)
class Outcome:
    """What became of a job: its row of the fleet's table, and the CPU time that it took [s]."""

    row: Row
    seconds: float = 0.0

    @property
    def turbine(self) -> str:
        return str(self.row["turbine"])

    @property
    def status(self) -> str:
        return str(self.row["status"])

    def to_json(self) -> JsonObject:
        """Plain data that any process can make the outcome from again."""
        return {"row": dict(self.row), "seconds": self.seconds}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Outcome:
        """An outcome from the data of `to_json`."""
        return cls(data["row"], float(data["seconds"]))


def outcome(
    job: Job, status: str, columns: Row | None = None, reason: str = "", seconds: float = 0.0
) -> Outcome:
    """The outcome of a job: the columns that every row has, those of its task behind them; numbers that are
    not finite become None."""
    shared = {"turbine": job.turbine, "status": status, "reason": reason, "task": job.task, "key": job.key}
    return Outcome(json.loads(result_text({**shared, **(columns or {})})), seconds)


def content_key(job: Job, files: Sequence[Path] = ()) -> str:
    """SHA-256 of all that the results of a job follow from: version, task, options, and the bytes of its
    files.

    Files are the case, those that its sources name, the fit, and `files`.  One that cannot be read counts as
    absent: the job itself then says why.
    """
    digest = hashlib.sha256()

    def take(*parts: object) -> None:
        for part in parts:
            data = part if isinstance(part, bytes) else json.dumps(part, sort_keys=True).encode()
            digest.update(len(data).to_bytes(8, "little") + data)

    take(__version__, job.turbine, job.task, dict(job.options))
    take(_digest(job.case))
    for name in _source_files(job.case):
        take(name, _digest(job.case.parent / name))
    for path in (*([job.fit] if job.fit else []), *files):
        take(_digest(path / FIT if path.is_dir() else path))
    return digest.hexdigest()


def _digest(path: Path) -> bytes:
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").digest()
    except OSError:
        return b"absent"


def _source_files(case: Path) -> list[str]:
    """Files that the sources of a case name, as far as it can be read."""
    try:
        tables = read_toml(case)[1].get("source", [])
    except FormFault:
        return []
    tables = tables if isinstance(tables, list) else [tables]
    named = [one.get("file") for one in tables if isinstance(one, dict)]
    return [name for name in named if isinstance(name, str)]


def finished(job: Job) -> Outcome | None:
    """The outcome on disk of the very same work, if it was done; failures are tried again."""
    try:
        data = json.loads((job.folder / ROW).read_text(encoding="utf-8"))
        found = Outcome.from_json(data)
        same = found.row["key"] == job.key and found.turbine == job.turbine and found.status == DONE
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return found if same else None


def begin(job: Job) -> None:
    """Remove what an earlier run has left in the folder: it belongs to other data."""
    job.folder.mkdir(parents=True, exist_ok=True)
    for name in WRITES:
        (job.folder / name).unlink(missing_ok=True)


def keep(job: Job, found: Outcome) -> None:
    """Write the row, whole; from then on the job is done.  Its folder may be missing: a process can die
    before it makes it."""
    job.folder.mkdir(parents=True, exist_ok=True)
    write_text_whole(job.folder / ROW, result_text(found.to_json()))
