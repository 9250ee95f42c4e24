"""Which stretches of a long record to show closely: day and night in part load, the liveliest, the
standstill."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.data.timestamps import HOUR_S
from hygrokf.report.figures.drawing import means

LENGTH_H = 144.0
"""[h] length of an excerpt, a quarter of the record if that is shorter."""
PACE_H = 6.0
PART_LOAD = (0.05, 0.85)
"""[1] relative power that counts as part load."""


@dataclass(frozen=True)
class Excerpt:
    """A stretch [s] of the record and why it was chosen."""

    start_s: float
    end_s: float
    reason: str


def hourly(time: np.ndarray, value: np.ndarray, hours: int) -> np.ndarray:
    """Means (hours,) over the hours since the first instant; NaN without a value. time: [s] (T,)."""
    there = np.isfinite(value)
    place = np.minimum(((time[there] - time[0]) // HOUR_S).astype(int), hours - 1)
    return means(place, value[there], hours)


def choose_excerpts(series: Mapping[str, np.ndarray]) -> tuple[Excerpt, ...]:
    """Up to three stretches of six days that do not overlap, in order of time.

    series: the arrays of series.npz.  Chosen are: the longest standstill with pre-heating (without one:
    operation close to rated power; without power: the largest errors of the free run), the most dynamic
    stretch, and part load with a pronounced day-night cycle (without power: the most pronounced cycle).
    Stretches with few readings or unknown inputs are passed over where there are others.  A record of less
    than two days is one excerpt.
    """
    time = series["time_s"]
    if len(time) < 2 or not time[-1] > time[0]:
        return ()
    hours = int((time[-1] - time[0]) // HOUR_S) + 1
    if hours < 48:
        return (Excerpt(float(time[0]), float(time[-1]), "the whole record"),)
    length = int(min(LENGTH_H, max(hours // 4, 12)))
    state = _State(series, hours)
    starts = np.arange(0, hours - length + 1, int(PACE_H if length >= 24 else 1))
    window = _Windows(starts, length)
    usable = window.mean(state.known) * np.maximum(window.mean(state.scored), 0.05)
    good = usable >= 0.75 * usable.max()
    chosen: list[tuple[int, str]] = []
    for rank, reason in (state.rare(window), state.lively(window), state.daily(window)):
        free = good & np.array([all(abs(s - other) >= length for other, _ in chosen) for s in starts])
        rank = np.where(free & np.isfinite(rank), rank, -np.inf)
        if rank.max() > -np.inf:
            chosen.append((int(starts[int(rank.argmax())]), reason))
    first = float(time[0])
    return tuple(
        Excerpt(first + s * HOUR_S, min(first + (s + length) * HOUR_S, float(time[-1])), reason)
        for s, reason in sorted(chosen)
    )


@dataclass(frozen=True)
class _Windows:
    starts: np.ndarray
    length: int

    def mean(self, value: np.ndarray) -> np.ndarray:
        """Mean over each window; an hour without a value counts as 0."""
        total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(value))])
        return (total[self.starts + self.length] - total[self.starts]) / self.length

    def end(self, value: np.ndarray, hours: int) -> np.ndarray:
        """Mean over the last hours of each window."""
        hours = min(hours, self.length)
        return _Windows(self.starts + self.length - hours, hours).mean(value)

    def daily_amplitude(self, value: np.ndarray) -> np.ndarray:
        """Amplitude of the sine of 24 h in each window."""
        known = np.isfinite(value)
        centred = np.where(known, value - (value[known].mean() if known.any() else 0.0), 0.0)
        wave = np.exp(-2j * np.pi * np.arange(len(value)) / 24.0)
        total = np.concatenate([[0.0], np.cumsum(centred * wave)])
        return 2.0 * np.abs(total[self.starts + self.length] - total[self.starts]) / self.length


class _State:
    """Hourly means of what the choice depends on."""

    def __init__(self, series: Mapping[str, np.ndarray], hours: int) -> None:
        time = series["time_s"]

        def of(name: str) -> np.ndarray:
            return hourly(time, series[name], hours)

        temperature = of("temperature_measured")
        has_temperature = bool(np.isfinite(temperature).any())
        self.measured = temperature if has_temperature else of("absolute_humidity_measured")
        simulated = "temperature_simulated" if has_temperature else "absolute_humidity_simulated"
        self.known = np.isfinite(self.measured).astype(float)
        self.scored = of("scored")
        self.ambient = of("ambient_temperature")
        self.error = self.measured - of(simulated)
        self.power = of("power")
        self.operating = of("operating")
        self.preheating = np.nan_to_num(of("preheating"))
        self.has_power = bool(np.nanmax(self.operating, initial=0.0) > 0)

    def rare(self, window: _Windows) -> tuple[np.ndarray, str]:
        still = 1.0 - self.operating
        if self.has_power and np.nansum(still) >= 12:
            heated = window.mean(self.preheating)
            rank = window.mean(still) + 8.0 * heated
            # the end of a standstill, with the return to operation in the picture, says the most
            rank = rank + 0.2 * window.end(self.operating, 24)
            words = "standstill and pre-heating" if self.preheating.max() > 0 else "standstill"
            return rank, words
        if self.has_power:
            return window.mean(self.power), "operation close to rated power"
        return window.mean(self.error**2), "largest errors of the free run"

    def lively(self, window: _Windows) -> tuple[np.ndarray, str]:
        rank = window.mean(np.abs(np.diff(self.measured, prepend=np.nan)))
        rank = rank / max(float(np.max(rank)), 1e-12)
        if self.has_power:
            jumps = window.mean(np.abs(np.diff(self.power, prepend=np.nan)))
            rank = rank + jumps / max(float(np.max(jumps)), 1e-12)
        return rank, "most dynamic"

    def daily(self, window: _Windows) -> tuple[np.ndarray, str]:
        rank = window.daily_amplitude(self.ambient)
        if not self.has_power:
            return rank, "pronounced day-night cycle"
        part = (self.power > PART_LOAD[0]) & (self.power < PART_LOAD[1]) & (self.operating > 0.5)
        return rank * window.mean(part.astype(float)), "part load, day-night cycle"
