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
class Departures:
    """By how much a turbine's reading departed from its sisters' on each day before `end_s` [s], the newest
    first: `size` (D,) [SI unit] beyond the mean of the last `USUAL` of them, NaN for a day that is not known;
    `sd` of such a departure, from `count` days."""

    size: np.ndarray
    sd: float
    count: int
    end_s: float

    def support(self, seconds: np.ndarray, error: np.ndarray, sd: float) -> float:
        """Gain in ln L by an error (T,) [SI unit] of the turbine's own reading at times (T,) [s], known to
        `sd`, over none: Student's t, because few days tell the standard deviation."""
        expected = _daily(seconds, error, self.end_s, len(self.size))
        expected = expected - np.nanmean(expected[-USUAL:])
        gain = self._log_density(self.size - expected, sd) - self._log_density(self.size, 0.0)
        return float(np.nansum(gain[:-USUAL]))

    def _log_density(self, apart: np.ndarray, sd: float) -> np.ndarray:
        variance, freedom = self.sd**2 + sd**2, self.count - 1
        return -0.5 * np.log(variance) - 0.5 * self.count * np.log1p(apart**2 / (freedom * variance))


def departures(record: Record, sisters: Sequence[Record], signal: str) -> Departures | None:
    """How a turbine's reading of a signal departs from its sisters'; None where too little is known.

    Each sister counts by its own usual difference, so that it may come and go.  One whose readings are the
    turbine's own, as those of a common mast, is no witness.
    """
    if signal not in record:
        return None
    own, end_s = record[signal], record.end_s
    days = int((end_s - record.start_s) // DAY_S) + 1
    mean = _daily(*own.known, end_s, days)
    found = []
    for other in (one[signal] for one in sisters if signal in one and not _same(own, one[signal])):
        difference = mean - _daily(*other.known, end_s, days)
        if np.isfinite(difference[-USUAL:]).sum() >= FEWEST:
            found.append(difference - np.nanmedian(difference[-USUAL:]))
    if not found or days < 2 * USUAL:
        return None
    size = np.ma.median(np.ma.masked_invalid(found), axis=0).filled(np.nan)
    usual = size[-USUAL:][np.isfinite(size[-USUAL:])]
    if not usual.std() > 0.0:
        return None
    sd = float(usual.std(ddof=1) * np.sqrt(1.0 + 1.0 / len(usual)))
    return Departures(size - usual.mean(), sd, len(usual), end_s)


def _daily(time: np.ndarray, value: np.ndarray, end_s: float, days: int) -> np.ndarray:
    """Means (days,) of the values of each day, counted back from the end; NaN without any."""
    day = ((end_s - time) // DAY_S).astype(int)
    within = (day >= 0) & (day < days)
    count = np.bincount(day[within], minlength=days)
    total = np.bincount(day[within], value[within], minlength=days)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _same(one: Series, other: Series) -> bool:
    """Whether two series are readings of one sensor: equal at all stamps that they share."""
    shared, first, second = np.intersect1d(one.time, other.time, return_indices=True)
    apart = np.abs(one.value[first] - other.value[second])
    return len(shared) > 0 and bool(np.all(apart <= max(one.resolution, other.resolution, 1e-9)))
