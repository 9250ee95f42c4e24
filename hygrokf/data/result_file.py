"""Results on disk: JSON files, read with every fault and their version; the arrays of series.npz."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from hygrokf.data.structured import StructureFault, plain, structured
from hygrokf.errors import HygrokfError

T = TypeVar("T")
FIRST_S, LAST_S = -6.2e10, 2.5e11
"""[s] since 1970: the years 5 and 9892, the range of a calendar."""


class ResultFault(HygrokfError):
    """A result file that cannot be read, in one message."""


def result_text(found: object) -> str:
    """The JSON text of a result; numbers that JSON cannot hold (NaN, ±∞) become null."""
    return json.dumps(plain(found), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def read_json(path: Path, command: str) -> Any:
    """The data of a JSON file that `command` wrote.  Raises ResultFault."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ResultFault(
            f"{path}: no such file; run `{command}` with --out {path.parent} first"
        ) from None
    except (OSError, ValueError, RecursionError) as fault:
        reason = getattr(fault, "strerror", None) or f"{type(fault).__name__} {fault}"
        raise ResultFault(
            f"{path}: expected the results of `{command}`, found: {reason}; run it again"
        ) from None


def read_result(kind: type[T], path: Path, command: str) -> T:
    """The result of a class in a file that `command` wrote.  Raises ResultFault."""
    data = read_json(path, command)
    try:
        return structured(kind, data)
    except StructureFault as fault:
        version = data.get("version") if isinstance(data, dict) else None
        found = f"; the file was written by hygrokf {version}" if isinstance(version, str) else ""
        raise ResultFault(
            f"{path}: expected the results of `{command}`, found: {fault}{found}; run it again"
        ) from None


def read_arrays(path: Path, command: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz file that `command` wrote.  Raises ResultFault with the reason and the remedy."""
    again = f"run `{command}` with --out {path.parent} first"
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise ResultFault(f"{path}: no such file; {again}") from None
    except (OSError, ValueError, EOFError, KeyError, AttributeError, BadZipFile) as fault:
        found = f"{path}: expected arrays written by `{command}`, found: {fault}; {again}"
        raise ResultFault(found) from None


def instants(series: Mapping[str, np.ndarray]) -> np.ndarray:
    """The instants (T,) [s] of series.npz; empty where they are missing, not finite, not increasing or out of
    range."""
    time = np.atleast_1d(np.asarray(series.get("time_s", np.empty(0)), dtype=float))
    good = time.ndim == 1 and bool(np.all((time > FIRST_S) & (time < LAST_S)) and np.all(np.diff(time) > 0))
    return time if good else np.empty(0)


def array(series: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """A series (T,) as floats with NaN for infinities; NaN throughout where it is missing or has another
    length."""
    length = len(instants(series))
    value = np.atleast_1d(np.asarray(series.get(name, np.empty(0)), dtype=float))
    return (
        np.where(np.isfinite(value), value, np.nan) if value.shape == (length,) else np.full(length, np.nan)
    )


def scalar(series: Mapping[str, np.ndarray], name: str) -> float:
    """A single number of series.npz; NaN where it is missing."""
    value = np.asarray(series.get(name, math.nan), dtype=float).ravel()
    return float(value[0]) if len(value) == 1 else math.nan
