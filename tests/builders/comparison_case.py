"""Columns of a comparison whose errors are drawn, not simulated."""

from __future__ import annotations

import numpy as np

from hygrokf.data.record import Provenance
from hygrokf.transfer.comparison import ComparedColumn, ComparisonColumn, rmse_by_week
from hygrokf.transfer.transfer_results import RecordCourse

HOUR = 3600.0


def made_column(
    label: str, seed: int, size: int = 1200, shift_s: float = 0.0, scale: float = 1.0, readings: int = 1
) -> ComparisonColumn:
    """A column of hourly errors that are drawn, not simulated."""
    random = np.random.default_rng([81, seed])
    time = HOUR * np.arange(size) + shift_s
    common = np.random.default_rng(82).standard_normal(size)
    error = scale * (common + 0.3 * random.standard_normal(size))
    operating = (np.arange(size) // 50) % 3 > 0
    error[::13] = np.nan
    late = np.arange(size) > 0.75 * size
    reading = np.random.default_rng(readings).standard_normal(size)
    course = RecordCourse(
        time, float(time[late][0]), np.isfinite(error), operating,
        {"temperature_K": reading}, {"simulated": {"temperature_K": reading - error}},
    )  # fmt: skip
    weeks = {"temperature_K": rmse_by_week(course, error)}
    return ComparisonColumn(
        ComparedColumn(label, f"fit of {label}", "a case", False, (), weeks),
        course,
        {"temperature_K": error},
        {"temperature_K": {"no_dynamics": 2.0 * error}},
        {"identification": ~late, "validation": late, "whole": np.ones(size, bool)},
        Provenance.MEASURED,
    )
