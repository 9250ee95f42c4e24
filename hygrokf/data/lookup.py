"""Tolerant access to the data of `fit.json` and `series.npz`, of which anything may be missing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

EARLIEST_S, LATEST_S = -6.2e10, 2.5e11
"""[s] since 1970: the years 5 and 9892, the range of a calendar."""


def instants(series: Mapping[str, np.ndarray]) -> np.ndarray:
    """The instants (T,) [s] of series.npz; empty where they are missing, not finite, not increasing or out of
    range."""
    time = np.atleast_1d(np.asarray(series.get("time_s", np.empty(0)), dtype=float))
    good = time.ndim == 1 and bool(
        np.all((time > EARLIEST_S) & (time < LATEST_S)) and np.all(np.diff(time) > 0)
    )
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


def entry(data: Any, *path: str) -> Any:
    """The value at a path of nested mappings; None where anything on the way is missing or null."""
    for name in path:
        data = data.get(name) if isinstance(data, Mapping) else None
    return data


def number(data: Any, *path: str) -> float:
    """The finite number at a path; NaN where there is none."""
    value = entry(data, *path)
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else math.nan


def numbers(data: Any, *path: str) -> np.ndarray:
    """The list of numbers at a path as an array, with NaN for null; empty where there is none."""
    value = entry(data, *path)
    if not isinstance(value, (list, tuple)):
        return np.empty(0)
    return np.array([number({"": v}, "") for v in value])


def columns(data: Any, *names: str) -> list[np.ndarray]:
    """Lists of equal length under these names, as arrays of the rows in which all are finite; empty where
    lengths differ."""
    lists = [numbers(data, name) for name in names]
    if len({len(one) for one in lists}) != 1:
        return [np.empty(0) for _ in names]
    good = np.all([np.isfinite(one) for one in lists], axis=0)
    return [one[good] for one in lists]


def one_line(text: str) -> str:
    """Text without line breaks and control characters."""
    return "".join(c if c.isprintable() else " " for c in text)
