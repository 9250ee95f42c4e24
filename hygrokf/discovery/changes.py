"""The course of errors in time: drifts, changes of the mean at an unknown date, sharp jumps between two
readings, periods of any length, and growth.

If a lasting change is taken for noise, it raises the estimated memory of the errors and its own p with it:
the noise is judged without it.  And slow wandering looks like a change.  Both are therefore compared with
how the partial sums of the errors wander beside them (self-normalisation).

Shapes: n bins or readings, B surrogates, m candidate dates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.discovery.significance import Null, centred, tail
from hygrokf.evaluation.bootstrap import autoregression, bridged

LEAST_LEAD = -4.0
CLEAR_LEAD = 2.0
"""Twice the log-likelihood by which a lasting jump must lead a stray reading or a kick: to be considered,
and to be clear."""
FEWEST_STEP = 200
"""Readings below which no jump between two of them is looked for."""
EDGE = 0.05
"""[1] share of the record at either end in which no jump is looked for."""
FEWEST_CYCLES = 8
"""Cycles within a record from which a period is looked for."""
PADDED = 4
"""Frequencies for each independent one: a line between two of them would lose half of its power."""
AROUND = 40
"""Independent frequencies to either side whose median power is the background of a frequency."""
HARMONICS = 4
MOST_PEAKS = 40
"""Frequencies whose course is looked at: a course that is no sine has its harmonics among the lines."""
GROWS = 2.0
"""[1] ratio of the errors' size at the end of a record to that at its beginning from which they grow."""


def change_p(null: Null, candidates: np.ndarray) -> tuple[float, int]:
    """p that the clearest lasting change of the mean is chance, over candidate bins (m,), and its first bin.

    Self-normalised CUSUM: the difference between after and before is compared with how the partial sums
    wander on either side of the date, so that slow wandering is not taken for a change, nor a large change
    for wandering.  The law comes from surrogates of the noise without the change.

    Source: Shao & Zhang 2010, doi:10.1198/jasa.2010.tm10103.
    """
    known = np.isfinite(null.values)
    width = int(candidates[1] - candidates[0]) if len(candidates) > 1 else int(candidates[0])
    edges = np.arange(0, len(known), width)
    number = np.cumsum(np.add.reduceat(known.astype(float), edges))
    place = candidates // width - 1
    ratio = _changes(np.add.reduceat(null.deviations[None], edges, axis=1), number)[0, place]
    first = int(candidates[int(np.argmax(ratio))])
    noise = null.without((np.arange(len(known)) >= first)[:, None].astype(float))
    world = _changes(np.add.reduceat(noise.made, edges, axis=1), number)[:, place].max(axis=1)
    return tail(math.log(max(float(ratio.max()), 1e-12)), np.log(np.maximum(world, 1e-12))), first


def _changes(sums: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Self-normalised change (B, m) after each of m stretches, from their sums (B, m) and running numbers
    (m,)."""
    total, all_n = np.cumsum(sums, axis=1), number[-1]

    def wandering(s: np.ndarray, i: np.ndarray) -> np.ndarray:
        """Σ_{j ≤ k} (S_j − i_j/i_k S_k)² for every k."""
        slope = s / np.maximum(i, 1.0)
        return np.cumsum(s**2, axis=1) - 2.0 * slope * np.cumsum(i * s, axis=1) + slope**2 * np.cumsum(i**2)

    change = total - number / all_n * total[:, -1:]
    back = (total[:, -1:] - total)[:, ::-1][:, 1:], (all_n - number)[::-1][1:]
    later = wandering(*back)[:, ::-1]
    around = wandering(total, number)
    around[:, :-1] += later
    return np.where(np.arange(len(number)) < len(number) - 1, change**2 / np.maximum(around, 1e-300), 0.0)


def drift_p(null: Null, trend: np.ndarray) -> float:
    """p that a series is free of a slow trend (n, 1), judged by how its partial sums wander
    (self-normalised).

    Source: Kiefer, Vogelsang & Bunzel 2000, doi:10.1111/1468-0262.00128.
    """
    known = np.isfinite(null.values)
    x = centred(trend, known)[known, 0]
    x = x / math.sqrt(float(x @ x))

    def ratio(series: np.ndarray) -> np.ndarray:
        slope = series @ x
        wandering = np.cumsum((series - slope[:, None] * x) * x, axis=1)
        return np.abs(slope) / np.sqrt(np.maximum((wandering**2).mean(axis=1), 1e-300))

    noise = null.without(trend).made[:, known]
    world = ratio(noise - noise.mean(axis=1, keepdims=True))
    typical = float(np.median(world)) or 1.0
    # the law has wide tails; its logarithm has those of a gamma law
    return tail(
        math.log1p(float(ratio(null.deviations[None, known])[0]) / typical), np.log1p(world / typical)
    )


# --- sharp jumps -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """A lasting jump of readings: at which reading, its size [unit of the series], z, and p over all dates.

    lead: twice the log-likelihood by which it explains the readings around it better than an effect that does
        not last.
    """

    place: int
    size: float
    z: float
    p: float
    lead: float

    @property
    def clear(self) -> bool:
        """Whether the readings around the jump distinguish it from a stray reading or a kick."""
        return self.lead >= CLEAR_LEAD


def sharp_step(values: np.ndarray) -> Step | None:
    """The likeliest lasting jump between two readings of a series (n,) at equal steps, by generalised least
    squares.

    Without the memory of the series a jump has a pattern of its own, different from those of a stray reading
    and of a kick that the memory forgets; both are tried beside it.  So a jump of 0.6 K stands out from a
    cabinet's smooth errors of 1.5 K, where the means before and after hardly differ.  The tails of the law
    are those of the pattern at all other dates.  None where there are too few readings, or where another
    pattern explains them clearly better.
    """
    from scipy.stats import norm

    phi, w = autoregression(values, 24)
    valid, p = np.isfinite(w), len(phi)
    n = len(w)
    if valid.sum() < max(FEWEST_STEP, 0.5 * n):
        return None
    scale = float(w[valid].std())
    w = np.where(valid, w, 0.0) / scale
    there = valid.astype(float)
    kernel = np.concatenate([[1.0], -phi])
    course = np.cumsum(kernel)
    sharp, rest = course[:-1], course[-1]
    margin = max(p + 1, round(EDGE * n))
    dates = np.arange(margin, n - margin)
    head = _sums_ahead(w, sharp)
    after = np.concatenate([np.cumsum(w[::-1])[::-1], np.zeros(p + 1)])
    number = np.concatenate([np.cumsum(there[::-1])[::-1], np.zeros(p + 1)])
    # regressors: the jump without memory, and the constant of the mean before it
    constant = max(rest**2 * number[0], 1e-300)
    xw = head[dates] + rest * after[dates + p]
    x1 = rest * (_sums_ahead(there, sharp)[dates] + rest * number[dates + p])
    xx = _sums_ahead(there, sharp**2)[dates] + rest**2 * number[dates + p] - x1**2 / constant
    beta = (xw - x1 * rest * after[0] / constant) / np.maximum(xx, 1e-300)
    z = beta * np.sqrt(np.maximum(xx, 0.0))
    best = int(np.argmax(np.abs(z)))
    near = slice(max(0, dates[best] - 2), dates[best] + 3)
    stray = (_sums_ahead(w, kernel) / math.sqrt(float(kernel @ kernel)))[near]
    rival = max(float(np.max(stray**2)), float(np.max(w[near] ** 2)))
    lead = float(z[best]) ** 2 - rival
    if lead < LEAST_LEAD:
        return None
    # the tails of the pattern's sharp part at all other dates; its lasting part wanders and has none
    others = np.abs(np.delete(head, slice(max(0, dates[best] - 2 * p - 2), dates[best] + 2 * p + 3)))
    normal = float(norm.isf(0.001)) / float(norm.isf(0.05)) * float(np.quantile(others, 0.9))
    heavy = max(1.0, float(np.quantile(others, 0.998)) / normal)
    chance = 2.0 * len(dates) * float(norm.sf(abs(float(z[best])) / heavy))
    return Step(int(dates[best]), float(beta[best]) * scale, float(z[best]), min(1.0, chance), lead)


def _sums_ahead(values: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Σ_j pattern[j] values[t + j] for every t."""
    if not len(pattern):
        return np.zeros(len(values))
    return np.correlate(values, pattern, "full")[len(pattern) - 1 :]


# --- periods and growth -----------------------------------------------------------------------


@dataclass(frozen=True)
class Period:
    """A line in the errors' spectrum: its period [h], the root mean square of its course [unit of the errors]
    and p."""

    hours: float
    size: float
    p: float


def period(values: np.ndarray, step_h: float, level: float) -> Period | None:
    """The strongest line with p below `level` in the spectrum of a series (n,), NaN = missing; None where
    there is none.

    The power of a windowed periodogram over the median power around it has an exponential law where the
    spectrum is smooth; p counts all frequencies.  The day, the year and their harmonics are left to the
    strata of hour and season.
    """
    known = np.isfinite(values)
    n = len(values)
    if known.sum() < 2 * AROUND or n * step_h < FEWEST_CYCLES * 24.0:
        return None
    window = np.hanning(n) * known
    filled = bridged(values) * known
    # a line stands out of a flat spectrum: the slope of a red one is taken out first
    phi, _ = autoregression(values, 1)
    frequency = np.fft.rfftfreq(PADDED * n, step_h)
    power = np.abs(np.fft.rfft(window * filled, PADDED * n)) ** 2
    power *= np.abs(1.0 - (phi[0] if len(phi) else 0.0) * np.exp(-2j * np.pi * frequency * step_h)) ** 2
    background = _median(power[::PADDED], AROUND) / math.log(2.0)
    ratio = power / np.interp(frequency, frequency[::PADDED], background)
    apart = 2.0 / (n * step_h)
    days = np.round(frequency * 24.0)
    daily = (days > 0) & (np.abs(frequency - days / 24.0) < apart)
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
    """Root mean square of the course with a period [h] in a series (n,), its harmonics included."""
    known = np.isfinite(values)
    phase = 2.0 * np.pi * step_h * np.arange(len(values))[known] / hours
    count = max(1, min(HARMONICS, int(hours / (2.0 * step_h))))
    waves = [f(k * phase) for k in range(1, count + 1) for f in (np.cos, np.sin)]
    basis = np.column_stack([np.ones(len(phase)), *waves])
    found, *_ = np.linalg.lstsq(basis, values[known], rcond=None)
    return float(np.std(basis[:, 1:] @ found[1:]))


def growth(values: np.ndarray, step_h: float) -> tuple[float, float]:
    """(ratio of the errors' size at the end of a series (n,) to that at its beginning, p that this is
    chance)."""
    day = np.floor(step_h * np.arange(len(values)) / 24.0).astype(int)
    known = np.isfinite(values)
    number = np.bincount(day[known], minlength=day[-1] + 1)
    square = np.bincount(day[known], values[known] ** 2, day[-1] + 1)
    full = number >= 0.5 * 24.0 / step_h
    if full.sum() < 2 * FEWEST_CYCLES:
        return 1.0, 1.0
    size = np.full(len(number), np.nan)
    size[full] = 0.5 * np.log(np.maximum(square[full] / number[full], 1e-30))
    trend = (np.arange(len(size)) / (len(size) - 1.0))[:, None]
    slope = np.polyfit(trend[full, 0], size[full], 1)[0]
    return math.exp(slope), drift_p(Null.of(size, 24.0), trend)
