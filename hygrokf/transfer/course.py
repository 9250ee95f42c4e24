"""Readings and simulations over time, for pictures, and the .npz file that holds those of several records."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from hygrokf.data.files import write_bytes_whole
from hygrokf.data.result_file import ResultFault, instants
from hygrokf.evaluation.scoring import SCORED
from hygrokf.evaluation.simulation import Prediction, measured
from hygrokf.modelling.inputs import Run


@dataclass(frozen=True)
class Course:
    """One record's readings and what one or several models simulate of them, by quantity [K], [g/m³].

    `time_s` (T,) [s since 1970]; `until_s` [s since 1970] the end of the identification period, NaN without
    one; `scored` (T,) True where all inputs are known; `operating` (T,); `measured` (T,) by quantity;
    `simulated` (T,) by the name of the model or of its values, then by quantity.
    """

    time_s: np.ndarray
    until_s: float
    scored: np.ndarray
    operating: np.ndarray
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, Mapping[str, np.ndarray]]

    @classmethod
    def of(cls, run: Run, until_s: float | None, simulated: Mapping[str, Prediction]) -> Course:
        """The readings of a run, and simulations of it by name."""
        t, known = run.timeline, measured(run)
        courses = {
            name: {q: pair[0] for q in SCORED if (pair := prediction.of(q)) is not None}
            for name, prediction in simulated.items()
        }
        end_s = math.nan if until_s is None else until_s
        return cls(t.seconds, end_s, run.scored, run.operating, {q: known[q] for q in SCORED}, courses)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a file: `temperature_K_measured`, `temperature_K_as_is`, and so on."""
        found = {
            "time_s": self.time_s,
            "scored": self.scored.astype(float),
            "operating": self.operating.astype(float),
            "until_s": np.array(self.until_s),
        }
        for name, one in {"measured": self.measured, **self.simulated}.items():
            found |= {f"{quantity}_{name}": value for quantity, value in one.items()}
        return found

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Course:
        """A course from the data of `arrays`.  Raises ValueError with all faults."""
        time = instants(arrays)
        faults = [] if len(time) else ["time_s: expected increasing instants [s since 1970]"]
        values = {name: np.asarray(v, dtype=float) for name, v in arrays.items() if name != "time_s"}
        until = values.pop("until_s", np.array(np.nan))
        for name in ("scored", "operating"):
            if name not in values:
                faults.append(f"{name}: expected, and missing")
        faults += [
            f"{name}: expected {len(time)} numbers, found {v.size}"
            for name, v in values.items()
            if len(time) and v.shape != time.shape
        ]
        if until.size != 1:
            faults.append(f"until_s: expected one number, found {until.size}")
        if faults:
            raise ValueError("; ".join(faults))
        by: dict[str, dict[str, np.ndarray]] = {"measured": {}}
        for quantity in SCORED:
            for name in (n for n in values if n.startswith(f"{quantity}_")):
                by.setdefault(name.removeprefix(f"{quantity}_"), {})[quantity] = values[name]
        measured = by.pop("measured")
        return cls(time, float(until), values["scored"] > 0, values["operating"] > 0, measured, by)


def write_courses(courses: Sequence[Course], path: str | os.PathLike[str]) -> Path:
    """Write courses to one .npz file, atomically.  Raises OSError from the system."""
    named = {f"{i}/{name}": v for i, one in enumerate(courses) for name, v in one.arrays().items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **named)  # type: ignore[arg-type]  # its flag is a keyword too
    return write_bytes_whole(path, buffer.getvalue())


def read_courses(path: Path, count: int, command: str) -> tuple[Course, ...]:
    """The courses of `count` records from a file that `command` wrote.  Raises ResultFault."""
    found: dict[int, dict[str, np.ndarray]] = {}
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            for key in file.files:
                place, _, name = key.partition("/")
                found.setdefault(int(place), {})[name] = file[key]
        if sorted(found) != list(range(count)):
            raise ValueError(f"those of {len(found)} records where {count} were expected")
        return tuple(Course.from_arrays(found[place]) for place in range(count))
    except (OSError, ValueError, EOFError, BadZipFile) as fault:
        reason = getattr(fault, "strerror", None) or fault
    raise ResultFault(f"{path}: expected the courses of `{command}`, found: {reason}; run it again")
