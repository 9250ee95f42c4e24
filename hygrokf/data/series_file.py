"""The arrays of `series.npz` for figures; what is missing or damaged is NaN or empty."""

from __future__ import annotations

import math
from collections.abc import Mapping

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
