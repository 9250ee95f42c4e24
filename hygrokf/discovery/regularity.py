"""What errors show in time and frequency, beside conditions that were logged: a period of any length, and
growth.

Shapes: n bins of equal length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.discovery.changes import drift_p
from hygrokf.discovery.significance import Null
from hygrokf.evaluation.bootstrap import autoregression, bridged

DAY_H = 24.0
FEWEST_CYCLES = 8
"""Cycles within a record from which a period is looked for."""
PADDED = 4
"""Frequencies for each independent one: a line between two of them would lose half of its power."""
AROUND = 40
"""Independent frequencies to either side whose median power is the background of one."""
HARMONICS = 4
MOST_PEAKS = 40
"""Frequencies whose course is looked at: a course that is no sine has its harmonics among the lines."""
GROWS = 2.0
"""Ratio of the errors' size at the end of a record to that at its beginning from which they grow."""


@dataclass(frozen=True)
class Period:
    """A line in the errors' spectrum: its period [h], the root mean square of its course [unit of the errors]
    and p."""

    hours: float
    size: float
    p: float


def period(values: np.ndarray, step_h: float, level: float) -> Period | None:
    """The strongest line of a chance below `level` in the spectrum of a series (n,), NaN = missing; None
    where there is none.

    The power of a windowed periodogram over the median of that around it has an exponential law where the
    spectrum is smooth; p counts all frequencies.  The day, the year and their harmonics are left to
    conditions of hour and season.
    """
    known = np.isfinite(values)
    n = len(values)
    if known.sum() < 2 * AROUND or n * step_h < FEWEST_CYCLES * DAY_H:
        return None
    window = np.hanning(n) * known
    centred = bridged(values) * known
    # a line stands out of what is flat: the slope of a red spectrum is taken out first
    phi, _ = autoregression(values, 1)
    frequency = np.fft.rfftfreq(PADDED * n, step_h)
    power = np.abs(np.fft.rfft(window * centred, PADDED * n)) ** 2
    power *= np.abs(1.0 - (phi[0] if len(phi) else 0.0) * np.exp(-2j * np.pi * frequency * step_h)) ** 2
    background = _median(power[::PADDED], AROUND) / math.log(2.0)
    ratio = power / np.interp(frequency, frequency[::PADDED], background)
    apart = 2.0 / (n * step_h)
    days = np.round(frequency * DAY_H)
    daily = (days > 0) & (np.abs(frequency - days / DAY_H) < apart)
    allowed = ~daily & (frequency > FEWEST_CYCLES / (n * step_h)) & (frequency < 0.45 / step_h)
    if not allowed.any():
        return None
    # frequencies between the independent ones double the chance of a peak
    number = allowed.sum() / PADDED * 2.0
    p = -np.expm1(number * np.log1p(-np.exp(-np.maximum(ratio, 1e-9))))
    peaks = np.flatnonzero(allowed & (p < level))
    peaks = peaks[np.argsort(-ratio[peaks])][:MOST_PEAKS]
    lines = [
        Period(h, _size(values, step_h, h), float(p[i])) for i in peaks if (h := 1.0 / float(frequency[i]))
    ]
    return max(lines, key=lambda one: one.size, default=None)


def _median(values: np.ndarray, around: int) -> np.ndarray:
    """Running median (n,) of `around` values to either side, fewer at the ends."""
    from scipy.ndimage import median_filter

    return median_filter(values, size=2 * around + 1, mode="reflect")


def _size(values: np.ndarray, step_h: float, hours: float) -> float:
    """Root mean square of the course of so many hours in a series (n,), its harmonics included."""
    known = np.isfinite(values)
    phase = 2.0 * np.pi * step_h * np.arange(len(values))[known] / hours
    count = max(1, min(HARMONICS, int(hours / (2.0 * step_h))))
    waves = [f(k * phase) for k in range(1, count + 1) for f in (np.cos, np.sin)]
    basis = np.column_stack([np.ones(len(phase)), *waves])
    found, *_ = np.linalg.lstsq(basis, values[known], rcond=None)
    return float(np.std(basis[:, 1:] @ found[1:]))


def growth(values: np.ndarray, step_h: float) -> tuple[float, float]:
    """(ratio of the errors' size at the end of a series (n,) to that at its beginning, p that they do not
    grow or shrink)."""
    day = np.floor(step_h * np.arange(len(values)) / DAY_H).astype(int)
    known = np.isfinite(values)
    number = np.bincount(day[known], minlength=day[-1] + 1)
    square = np.bincount(day[known], values[known] ** 2, day[-1] + 1)
    full = number >= 0.5 * DAY_H / step_h
    if full.sum() < 2 * FEWEST_CYCLES:
        return 1.0, 1.0
    size = np.full(len(number), np.nan)
    size[full] = 0.5 * np.log(np.maximum(square[full] / number[full], 1e-30))
    trend = (np.arange(len(size)) / (len(size) - 1.0))[:, None]
    slope = np.polyfit(trend[full, 0], size[full], 1)[0]
    return math.exp(slope), drift_p(Null.of(size, DAY_H), trend)
