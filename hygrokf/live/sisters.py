"""What sister turbines read of the ambient: evidence about a turbine's own ambient sensors.

Turbines of one tracker share their weather.  The mean difference of a day between a turbine's reading and
the median of its sisters' varies little from day to day; an error of its own sensor shows in it, and one of a
sensor in its cabinet does not.  Sisters that are far away vary more and so say less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S

AMBIENT = {"ambient_temperature": "ambient_temperature", "ambient_humidity": "ambient_relative_humidity"}
"""Cause in `fault_isolation.STATES` -> signal that is compared with the sisters'."""
USUAL = 10
"""Days at the beginning of a record that show what is usual, before a shift was noticed."""
FEWEST = 5
"""Fewest of these days with readings of both."""


@dataclass(frozen=True)
class SistersChange:
    """By how much a turbine's reading departs from its sisters' on the last day [SI unit], from what was
    `usual` for it on `days` days, with the standard deviation `sd` of a day's."""

    change: float
    sd: float
    days: int
    end_s: float

    def support(self, seconds: np.ndarray, error: np.ndarray, sd: float) -> float:
        """Gain in ln L by an error (T,) [SI unit] of the turbine's own reading at times (T,) [s], known to
        `sd`, over none: Student's t, because few days tell the standard deviation."""
        day = _day(seconds, self.end_s)
        first = day > day.max() - USUAL
        expected = float(error[day == day.min()].mean() - error[first].mean())
        return self._log_density(expected, sd) - self._log_density(0.0, 0.0)

    def _log_density(self, expected: float, sd: float) -> float:
        variance, freedom = self.sd**2 + sd**2, self.days - 1
        z2 = (self.change - expected) ** 2 / variance
        return float(-0.5 * np.log(variance) - 0.5 * (freedom + 1) * np.log1p(z2 / freedom))


def sisters_change(record: Record, sisters: Sequence[Record], signal: str) -> SistersChange | None:
    """How a turbine's reading of a signal departs from its sisters'; None where too little is known.

    Each sister counts by its own usual difference, so that it may come and go.  One whose readings are the
    turbine's own, as those of a common mast, is no witness.
    """
    if signal not in record:
        return None
    own, end_s = record[signal], record.end_s
    others = [one[signal] for one in sisters if signal in one and not _same(own, one[signal])]
    days = int((end_s - record.start_s) // DAY_S) + 1
    mean = _daily(own, end_s, days)
    departures = []
    for one in others:
        difference = mean - _daily(one, end_s, days)
        known = difference[-USUAL:][np.isfinite(difference[-USUAL:])]
        if len(known) >= FEWEST:
            departures.append(difference - np.median(known))
    if not departures or days < 2 * USUAL:
        return None
    told = np.ma.median(np.ma.masked_invalid(departures), axis=0).filled(np.nan)
    usual = told[-USUAL:][np.isfinite(told[-USUAL:])]
    if not np.isfinite(told[0]) or len(usual) < FEWEST or not usual.std() > 0.0:
        return None
    sd = float(usual.std(ddof=1) * np.sqrt(1.0 + 1.0 / len(usual)))
    return SistersChange(float(told[0] - usual.mean()), sd, len(usual), end_s)


def _day(seconds: np.ndarray, end_s: float) -> np.ndarray:
    """Number (T,) of whole days before the end."""
    return ((end_s - seconds) // DAY_S).astype(int)


def _daily(series: Series, end_s: float, days: int) -> np.ndarray:
    """Means (days,) of the readings of each day, counted back from the end; NaN without any."""
    time, value = series.known
    within = (time <= end_s) & (time > end_s - days * DAY_S)
    day = _day(time[within], end_s)
    count = np.bincount(day, minlength=days)
    with np.errstate(invalid="ignore"):
        return np.bincount(day, value[within], minlength=days) / count


def _same(one: Series, other: Series) -> bool:
    """Whether two series are readings of one sensor: equal at all stamps that they share."""
    shared, first, second = np.intersect1d(one.time, other.time, return_indices=True)
    apart = np.abs(one.value[first] - other.value[second])
    return len(shared) > 0 and bool(np.all(apart <= max(one.resolution, other.resolution, 1e-9)))
