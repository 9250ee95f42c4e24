"""Results on disk, as frames and as pictures: JSON files, read with every fault and their version, and the
arrays of series.npz.

A column states its unit in brackets, as "value [h]", or `frame.attrs["units"]` does, as {column: unit}; where
the unit changes from row to row, it is the column "unit".

The report is a higher layer than the results: none of them imports the report, its colours or matplotlib, and
its drawing functions are imported at their first use.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from hygrokf.data.structured import StructureFault, plain, structured
from hygrokf.errors import HygrokfError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame, DatetimeIndex


ENDINGS = {
    "_h": "h", "_s": "s", "_K": "K", "_degC": "°C", "_percent": "%", "_g_m3": "g/m³", "_kW": "kW", "_W": "W",
    "_share": "1", "_coverage": "1", "confidence": "1",
}  # fmt: skip
"""Units of columns by the end of their names, as results write them."""


# -- frames and pictures -------------------------------------------------------------------------------------
def with_units(frame: DataFrame, units: Mapping[str, str], stamps: Sequence[str] = ()) -> DataFrame:
    """The frame with the units of its columns, and with the columns `stamps` (text in ISO 8601) as times in
    UTC."""
    import pandas as pd

    for name in stamps:
        frame[name] = pd.to_datetime(frame[name], utc=True, format="ISO8601")
    frame.attrs["units"] = {name: unit for name, unit in units.items() if name in frame.columns}
    return frame


def units_by_name(columns: Sequence[str]) -> dict[str, str]:
    """The units of columns by the endings of their names; bounds have the unit of their value."""
    units = {}
    for name in columns:
        bare = name.removesuffix("_lower").removesuffix("_upper")
        unit = next((unit for end, unit in ENDINGS.items() if bare.endswith(end)), "")
        if unit:
            units[name] = unit
    return units


def utc_index(time_s: np.ndarray) -> DatetimeIndex:
    """Times [s] since 1970-01-01T00:00Z as an index in UTC, to the microsecond."""
    import pandas as pd

    stamps = np.round(1e6 * np.asarray(time_s, dtype=float)).astype("int64").astype("datetime64[us]")
    return pd.DatetimeIndex(stamps, name="time").tz_localize("UTC")


PLOTS = "hygrokf.report.plots"


def drawn(result: object, axes: Axes | Sequence[Axes] | None) -> tuple[Axes, ...]:
    """Draw a result on axes by `hygrokf.report.plots`; returns the axes."""
    axes_drawn: tuple[Axes, ...] = import_module(PLOTS).plotted(result, axes)
    return axes_drawn


T = TypeVar("T")
FIRST_INSTANT_S, LAST_INSTANT_S = -6.2e10, 2.5e11
"""[s] since 1970: the years 5 and 9892, the range of a calendar."""


# -- files ---------------------------------------------------------------------------------------------------
class ResultFault(HygrokfError):
    """A result file that cannot be read."""


def result_text(result: object) -> str:
    """The JSON text of a result; numbers that JSON cannot hold (NaN, ±∞) become null."""
    return json.dumps(plain(result), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def read_json(path: Path, command: str) -> Any:
    """The data of a JSON file that `command` wrote.  Raises ResultFault."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ResultFault(f"{path}: no such file; run `{command}` with --out {path.parent} first") from None
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
        origin = f"; the file was written by hygrokf {version}" if isinstance(version, str) else ""
        raise ResultFault(
            f"{path}: expected the results of `{command}`, found: {fault}{origin}; run it again"
        ) from None


def read_arrays(path: Path, command: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz file that `command` wrote.  Raises ResultFault with the reason and the remedy."""
    remedy = f"run `{command}` with --out {path.parent} first"
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise ResultFault(f"{path}: no such file; {remedy}") from None
    except (OSError, ValueError, EOFError, KeyError, AttributeError, BadZipFile) as fault:
        message = f"{path}: expected arrays written by `{command}`, found: {fault}; {remedy}"
        raise ResultFault(message) from None


def instants(series: Mapping[str, np.ndarray]) -> np.ndarray:
    """The instants (T,) [s] of series.npz; empty where they are missing, not finite, not increasing or out of
    range."""
    time = np.atleast_1d(np.asarray(series.get("time_s", np.empty(0)), dtype=float))
    is_valid = time.ndim == 1 and bool(
        np.all((time > FIRST_INSTANT_S) & (time < LAST_INSTANT_S)) and np.all(np.diff(time) > 0)
    )
    return time if is_valid else np.empty(0)


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
