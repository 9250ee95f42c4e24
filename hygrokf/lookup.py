"""Reading from the data of `fit.json` and `series.npz` without trusting that everything is there."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np


def array(series: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """A series (T,) as floats; NaN throughout where it is not there or has another length."""
    length = len(np.atleast_1d(series["time_s"])) if "time_s" in series else 0
    value = np.asarray(series[name], dtype=float) if name in series else np.empty(0)
    return value if value.shape == (length,) else np.full(length, np.nan)


def entry(data: object, *path: str) -> object:
    """What stands at a path of nested mappings; None where anything on the way is missing or null."""
    for name in path:
        data = data.get(name) if isinstance(data, Mapping) else None
    return data


def number(data: object, *path: str) -> float:
    """The finite number at a path; NaN where there is none."""
    value = entry(data, *path)
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else math.nan


def numbers(data: object, *path: str) -> np.ndarray:
    """The list of numbers at a path as an array, null as NaN; empty where there is none."""
    value = entry(data, *path)
    if not isinstance(value, (list, tuple)):
        return np.empty(0)
    return np.array([number({"": v}, "") for v in value])
