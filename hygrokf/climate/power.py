"""The power that a cabinet has in a climate: from a record, from the wind by a power curve, or none at all.

A power curve is a TOML file:

    rated_power_kW = 2050
    wind_speed_m_s = [0, 3.5, 5, 8, 12, 25]      # at hub height, rising; beyond the ends the power is 0
    power_kW       = [0, 20, 150, 800, 2050, 2050]
    hub_height_m = 80
    wind_height_m = 10                           # at which the weather's wind stands
    shear = { law = "power", exponent = 0.2 }    # or { law = "log", roughness_m = 0.03 }
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hygrokf.climate.form import FormFault, is_number, read_toml, unknown_keys
from hygrokf.data.ambient import at_times, bridge_h
from hygrokf.data.input_paths import centred
from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import stamp_text
from hygrokf.errors import HygrokfError

HOUR_S = 3600.0
DAYS_A_YEAR = 365.25
FASTEST_M_S = 60.0
"""Wind speed of a curve above which it is in another unit."""
UNUSED_S = 30.0 * 86400.0
"""Length of a record's part from which it is said that it was not used."""
SAME_HEIGHT = 0.05
"""Share by which two heights of the wind may differ and be called the same."""
WIND_BRIDGE_H = 6.0
RATED = (0.5, 1.2)
"""Highest power of a curve over the rated power [1]."""
LAWS = {"power": "exponent", "log": "roughness_m"}


class PowerFault(HygrokfError):
    """Power that cannot be used, with every reason."""


@dataclass(frozen=True)
class PowerCurve:
    """Power (k,) [W] over wind speed (k,) [m/s] at `hub_height_m`, for wind known at `wind_height_m`.

    `law` "power": v_hub = v (z_hub/z)^number; "log": v_hub = v ln(z_hub/number)/ln(z/number), the number a roughness
    length [m].  `rated_power_W` of the turbine.
    """

    wind_speed: np.ndarray
    power_W: np.ndarray
    hub_height_m: float
    wind_height_m: float
    law: str
    number: float
    rated_power_W: float

    @property
    def factor(self) -> float:
        """Wind speed at hub height over that at the height of the weather's wind [1]."""
        if self.law == "power":
            return (self.hub_height_m / self.wind_height_m) ** self.number
        return math.log(self.hub_height_m / self.number) / math.log(self.wind_height_m / self.number)

    def power(self, wind_speed: np.ndarray) -> np.ndarray:
        """Power [W] of the wind speeds [m/s] that the weather has; NaN stays NaN, 0 beyond the ends of the curve."""
        hub = np.asarray(wind_speed, dtype=float) * self.factor
        found = np.interp(hub, self.wind_speed, self.power_W, left=0.0, right=0.0)
        return np.where(np.isnan(hub), np.nan, found)

    def words(self) -> str:
        how = (
            f"power law, exponent {self.number:g}"
            if self.law == "power"
            else f"log law, roughness {self.number:g} m"
        )
        return (
            f"power by the power curve from the weather's wind at {self.wind_height_m:g} m, brought to "
            f"{self.hub_height_m:g} m by the {how} (factor {self.factor:.3f}); no faults, no curtailment, no wakes"
        )


def read_power_curve(path: str | os.PathLike[str]) -> PowerCurve:
    """A power curve from TOML; raises FormFault with everything that is wrong."""
    data = read_toml(path, "a power curve")
    known = ("rated_power_kW", "wind_speed_m_s", "power_kW", "hub_height_m", "wind_height_m", "shear")
    faults = unknown_keys(data, known, "the file")
    numbers: dict[str, Any] = {}
    for name in ("rated_power_kW", "hub_height_m", "wind_height_m"):
        numbers[name] = value = data.get(name)
        if not is_number(value) or not value > 0:
            faults.append(f"{name}: expected a number above 0, found {value!r}")
    speed: Any
    power: Any
    speed, power = (data.get(name) for name in ("wind_speed_m_s", "power_kW"))
    for name, values in (("wind_speed_m_s", speed), ("power_kW", power)):
        if not isinstance(values, list) or len(values) < 2 or not all(map(is_number, values)):
            faults.append(f"{name}: expected a list of at least two numbers, found {values!r}")
        elif min(values) < 0:
            faults.append(f"{name}: expected numbers from 0 on, found {min(values):g}")
    if not faults and len(speed) != len(power):
        faults.append(
            f"wind_speed_m_s and power_kW: expected as many numbers, found {len(speed)} and {len(power)}"
        )
    if not faults and not all(a < b for a, b in itertools.pairwise(speed)):
        faults.append("wind_speed_m_s: expected rising numbers")
    if not faults and max(speed) > FASTEST_M_S:
        faults.append(
            f"wind_speed_m_s: expected speeds up to {FASTEST_M_S:g} m/s, found {max(speed):g}; are they in km/h? divide by 3.6"
        )
    if not faults and not RATED[0] <= max(power) / numbers["rated_power_kW"] <= RATED[1]:
        faults.append(
            f"power_kW: expected a curve that reaches about rated_power_kW = {numbers['rated_power_kW']:g}, found "
            f"{max(power):g} at most; are both in kW? correct one of them"
        )
    law, number = _shear(data.get("shear"), numbers, faults)
    if faults:
        raise FormFault(path, faults)
    return PowerCurve(
        np.array(speed, float), 1e3 * np.array(power, float), numbers["hub_height_m"], numbers["wind_height_m"],
        law, number, 1e3 * numbers["rated_power_kW"],
    )  # fmt: skip


def _shear(shear: Any, heights: Mapping, faults: list[str]) -> tuple[str, float]:
    law = shear.get("law") if isinstance(shear, dict) else None
    if not isinstance(law, str) or law not in LAWS:
        faults.append(
            'shear: expected { law = "power", exponent = … } or { law = "log", roughness_m = … }, found '
            f"{shear!r}"
        )
        return "power", 0.0
    number = shear.get(LAWS[law])
    low: list[Any] = [heights.get(name) for name in ("hub_height_m", "wind_height_m")]
    most = 1.0 if law == "power" else min([one for one in low if is_number(one)] or [10.0])
    least = -0.5 if law == "power" else 0.0
    if not is_number(number) or not least < number < most or set(shear) - {"law", LAWS[law]}:
        faults.append(
            f'shear: expected {{ law = "{law}", {LAWS[law]} = … }} with a number between {least:g} and {most:g}, '
            f"found {shear!r}"
        )
        return law, 0.0
    return law, float(number)


def power_from_wind(curve: PowerCurve, record: Record) -> Series:
    """Power [W], hour by hour, of the wind of a weather record; raises PowerFault where it has none, or at another height."""
    if "wind_speed" not in record:
        raise PowerFault(
            f"{record.name}: expected a wind speed for the power curve, found {', '.join(record.signals)}; "
            "add the weather's wind, or name --power or --standstill"
        )
    wind = record["wind_speed"]
    height = wind.height_m
    if height is not None and abs(curve.wind_height_m / height - 1.0) > SAME_HEIGHT:
        raise PowerFault(
            f"{record.name}: its wind is that at {height:g} m, the power curve has wind_height_m = {curve.wind_height_m:g}; "
            f"write wind_height_m = {height:g} into the curve's file"
        )
    middle = centred(wind)
    ends = _hours(record)
    value = at_times(middle, ends - 0.5 * HOUR_S, bridge_h(middle, WIND_BRIDGE_H))
    return _hourly_power(ends, curve.power(value), wind.source)


def years_of_power(power: Series) -> int:
    """Whole years that a record of power has, one at least."""
    first, last = power.time[0] - power.interval_s, power.time[-1]
    return max(1, int(np.floor((last - first) / (DAYS_A_YEAR * 86400.0) + 0.05)))


def covers(series: Series, record: Record) -> bool:
    """Whether a series is known over the time of a weather record, give or take two days."""
    first, last = series.time[0] - series.interval_s, series.time[-1]
    return first <= record.start_s + 2 * 86400.0 and last >= record.end_s - 2 * 86400.0


def power_by_season(power: Series, record: Record) -> tuple[Series, str]:
    """Power [W] for a weather record from one of other years, hour by hour; and in words how it was taken.

    Where it covers the weather's time it is taken as it is.  Else each hour has the power of the same hour and, give or
    take one, the same day of the year, of the years that the record of the power has one after another; days of the year
    that the record does not have are unknown (NaN).
    """
    first, last = power.time[0] - power.interval_s, power.time[-1]
    if covers(power, record):
        return power, "power at the weather's own hours, as its record has it"
    year_s = DAYS_A_YEAR * 86400.0
    if last - first < 0.95 * year_s:
        raise PowerFault(
            f"{power.source}: expected power over the weather's time or over a whole year, found "
            f"{(last - first) / 86400.0:.0f} days of other times; use --power-curve, or a longer record"
        )
    ends = _hours(record)
    whole = years_of_power(power)
    # whole days are moved, so that the hour of the day stays; leap days never add up to more than a part of a day
    back = 86400.0 * np.round(np.floor((ends - first) / (whole * year_s)) * whole * DAYS_A_YEAR)
    at = ends - back
    at += 86400.0 * (at <= first)
    at -= 86400.0 * ((at > last) & (at <= last + 86400.0))
    value = np.where(at > last, np.nan, at_times(power, at, 1.0))
    span = "a year" if whole == 1 else f"{whole} years"
    return _hourly_power(ends, value, power.source), (
        f"power of other times than the weather's, taken by the time of the year from a record of {span}: "
        f"it does not go with this weather's wind; {_used_words(at[np.isfinite(value)], first, last)}"
    )


def _used_words(at: np.ndarray, first: float, last: float) -> str:
    """Which part of a record of power from `first` to `last` [s] the hours [s] are that were taken, and what was not."""
    hours = np.unique(at)
    if not len(hours):
        return "none of it is known"
    turns = np.flatnonzero(np.diff(hours) > UNUSED_S)
    begins, ends = hours[np.append(0, turns + 1)] - HOUR_S, hours[np.append(turns, len(hours) - 1)]
    spans = list(zip(begins, ends, strict=True))
    told = [span for span in spans if span[1] - span[0] > UNUSED_S] or spans
    listed = " and ".join(f"{stamp_text(a)[:10]} … {stamp_text(b)[:10]}" for a, b in told)
    if (last - first) - float(np.sum(ends - begins)) <= UNUSED_S:
        return f"used is {listed}, all of it"
    return (
        f"used is {listed}; the rest of the record, which is from {stamp_text(first)[:10]} to {stamp_text(last)[:10]}, is not, "
        "and the choice matters: another year has other hours of standstill"
    )


def standstill(record: Record) -> Series:
    """No power at all, over the whole of a weather record."""
    ends = _hours(record)
    return _hourly_power(ends, np.zeros(len(ends)), "standstill")


def _hours(record: Record) -> np.ndarray:
    """Ends of whole hours [s] over a weather record."""
    first = np.floor(record.start_s / HOUR_S)
    return HOUR_S * np.arange(first, np.ceil(record.end_s / HOUR_S) + 1.0)


def _hourly_power(ends: np.ndarray, value: np.ndarray, source: str) -> Series:
    return Series("active_power", ends, value, "zero-order", HOUR_S, source=source)
