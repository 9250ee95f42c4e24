"""What the values of a column say: its unit, the place where it is measured, the rated power of a turbine."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.data.signals import SIGNALS, SWITCHED, fitting_units, share_in_range, to_si, unit_mistaken
from hygrokf.data.timestamps import HOUR_S


@dataclass(frozen=True)
class Hourly:
    """Hourly means of a column, to compare columns of different clocks.

    hour: (N,) number of the hour since 1970, increasing. value: (N,).
    """

    hour: np.ndarray
    value: np.ndarray

    def beside(self, other: Hourly) -> tuple[np.ndarray, np.ndarray]:
        """Values of the common hours of this column and of another one."""
        _, here, there = np.intersect1d(self.hour, other.hour, return_indices=True)
        return self.value[here], other.value[there]


def hourly(time: np.ndarray, values: np.ndarray) -> Hourly:
    """Hourly means; time [s] (N,), values (N,), NaN = missing."""
    good = np.isfinite(time) & np.isfinite(values)
    hours, place = np.unique(np.floor(time[good] / HOUR_S), return_inverse=True)
    return Hourly(hours, np.bincount(place, values[good]) / np.maximum(np.bincount(place), 1))


def unit_by_values(values: np.ndarray, signal: str, stated: str | None) -> tuple[str, str | None]:
    """The unit of a column, and a doubt where the readings alone decide or contradict.

    values: (N,) as in the file. signal: of the table. stated: a name in `UNITS`, or None.
    """
    finite = values[np.isfinite(values)]
    units = fitting_units(signal)
    if stated in units:
        if not len(finite) or unit_mistaken(values, stated, signal) is None:
            return stated, None
        better = [one for one in units if one != stated and unit_mistaken(values, one, signal) is None]
        if better:
            return better[0], f"the header says {stated}, but the readings fit {better[0]}"
        return stated, f"the readings do not fit the unit {stated} of the header"
    ranked = list(dict.fromkeys((SIGNALS[signal].display, *units)))
    if not len(finite):
        return ranked[0], "the column holds no readings"
    if signal.endswith("_power"):
        high = float(np.quantile(np.abs(finite), 0.995))
        unit = "MW" if high < 20.0 else "kW" if high < 30e3 else "W"
        return unit, f"the header states no unit; readings up to {high:.4g} fit {unit}"
    if signal == "rain":
        unit = "1" if float(np.max(finite)) <= 1.0 else "mm"
        return unit, f"the header states no unit; readings up to {np.max(finite):.4g} fit {unit}"
    fits = [
        one
        for one in ranked
        if unit_mistaken(values, one, signal) is None and share_in_range(finite, one, signal) > 0.9
    ]
    if not fits:
        return ranked[0], "the header states no unit and the readings fit none"
    if SIGNALS[signal].dimension == "temperature" and fits[0] == "degC" and np.quantile(finite, 0.95) < 60.0:
        return "degC", None
    other = (
        f", perhaps {fits[1]}"
        if len(fits) > 1 and SIGNALS[signal].dimension in ("temperature", "angle")
        else ""
    )
    return fits[0], f"the header states no unit; the readings fit {fits[0]}{other}" if other else None


def impossible(values: np.ndarray, unit: str, signal: str) -> str | None:
    """Why readings cannot be those of a signal, although its unit fits; None where they can."""
    finite = values[np.isfinite(values)]
    if len(finite) < (3 if signal in SWITCHED else 20):
        return "hardly any readings"
    if np.ptp(finite) == 0.0:
        return f"all readings are {finite[0]:g}"
    if (
        signal == "wind_direction"
        and unit == "deg"
        and len(finite) > 1000
        and np.quantile(finite, 0.999) < 300.0
    ):
        return f"readings reach {finite.max():g}, less than a whole turn of 360 deg"
    inside = share_in_range(finite, unit, signal)
    return (
        f"{100 * (1 - inside):.0f} % of the readings are out of the physical range" if inside < 0.7 else None
    )


def like_ambient(column: Hourly, others: list[Hourly]) -> float:
    """How much a temperature looks like that of the outside air, 0 to 1: colder than the other temperatures,
    with a wider range and a daily course."""
    if len(column.value) < 24:
        return 0.0
    colder = [float(np.mean(mine < its)) for mine, its in map(column.beside, others) if len(mine) > 24]
    wider = [_spread(column) > _spread(one) for one in others if len(one.value) > 24]
    cold = float(np.mean(colder)) if colder else 0.5
    wide = float(np.mean(wider)) if wider else 0.5
    days = np.floor(column.hour / 24.0)
    _, place = np.unique(days, return_inverse=True)
    weather = float(np.std(np.bincount(place, column.value) / np.bincount(place)))
    # outside, the mean of the day wanders by several kelvins within weeks
    return (0.45 * cold + 0.3 * wide + 0.25 * daily_share(column)) * min(weather / 2.5, 1.0)


def like_cabinet(column: Hourly, ambient: Hourly | None, power: Hourly | None) -> float:
    """How much a temperature looks like that of a closed cabinet, 0 to 1: warmer than outside, moving with
    the outside air and with the power."""
    if ambient is None:
        return 0.5
    mine, outside = column.beside(ambient)
    if len(mine) < 24:
        return 0.3
    score = 0.4 * float(np.mean(mine > outside)) + 0.3 * max(_correlation(mine, outside), 0.0)
    if power is not None:
        excess, load = column.beside(power)
        score += 0.3 * max(_correlation(excess, load), 0.0)
    return score


def follows_rather(column: Hourly, one: Hourly, other: Hourly) -> bool:
    """Whether differences from one series vary less than those from another, over a day or more."""
    spreads = []
    for series in (one, other):
        mine, its = column.beside(series)
        spreads.append(float(np.std(mine - its)) if len(mine) >= 24 else math.nan)
    return spreads[0] < spreads[1]


def daily_share(column: Hourly) -> float:
    """Share of the variance within days that the mean course of the day explains, 0 to 1."""
    day = np.floor(column.hour / 24.0)
    _, place = np.unique(day, return_inverse=True)
    within = column.value - (np.bincount(place, column.value) / np.bincount(place))[place]
    clock = np.mod(column.hour, 24).astype(int)
    course = np.bincount(clock, within, 24) / np.maximum(np.bincount(clock, minlength=24), 1)
    total = float(np.var(within))
    return min(float(np.var(course[clock])) / total, 1.0) if total > 0.0 else 0.0


def rated_power(values: np.ndarray, unit: str) -> float | None:
    """Rated power by the plateau at which the power stops [kW]; None where there is no plateau.

    values: [unit] (N,).  A plateau holds at least 0.5 % of the readings within 2 % of the 99.8th
    percentile, and half as many again as the 4 % below.
    """
    power = to_si(values[np.isfinite(values)], unit, "active_power") / 1e3
    if len(power) < 100:
        return None
    top = float(np.quantile(power, 0.998))
    at = (power > 0.98 * top) & (power < 1.02 * top)
    below = (power > 0.94 * top) & (power <= 0.98 * top)
    if top <= 0.0 or at.mean() < 0.005 or at.sum() < 1.5 * below.sum():
        return None
    return float(f"{np.median(power[at]):.3g}")


def _spread(column: Hourly) -> float:
    return float(np.subtract(*np.quantile(column.value, (0.95, 0.05))))


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    if len(one) < 24 or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
