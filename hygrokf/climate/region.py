"""A region: its weather files, and the weather and power that drive its cabinets; power from a record, from
the wind by a power curve, or none."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hygrokf.cases.case_file import read_case
from hygrokf.data.actuators import ACTUATORS
from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.input_paths import centred, input_path
from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.data.toml_form import across, setting
from hygrokf.errors import HygrokfError
from hygrokf.identification.fit import Fit
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Statement
from hygrokf.weather.reading import TYPICAL, read_weather, weather_format

YEAR_S = 365.25 * DAY_S
FASTEST_M_S = 60.0
"""Wind speed above which a curve must be in another unit."""
UNUSED_S = 30.0 * DAY_S
"""[s] length of an unused part of a record that is worth a statement."""
SAME_HEIGHT = 0.05
"""Share by which two heights of the wind may differ and be called the same."""
WIND_BRIDGE_H = 6.0
RATED = (0.5, 1.2)
"""Highest power of a curve over the rated power [1]."""
LAWS = {"power": "exponent", "log": "roughness_m"}


class PowerFault(HygrokfError):
    """A record of power, or weather for a power curve, that cannot be used; with every reason."""


@dataclass(frozen=True)
class Shear:
    """How the wind grows with height: "power": v_hub = v (z_hub/z)^exponent; "log": v_hub = v
    ln(z_hub/roughness)/ln(z/roughness)."""

    law: str = setting(help="power: v ∝ z^exponent; log: v ∝ ln(z/roughness_m)", choices=tuple(LAWS))
    exponent: float | None = setting(None, "of the power law", least=-0.5, most=1.0)
    roughness_m: float | None = setting(None, "of the logarithmic law", above=0.0)

    @across("law", "exponent", "roughness_m")
    def number_of_law(self) -> str | None:
        stated = [name for name in LAWS.values() if getattr(self, name) is not None]
        if stated == [LAWS[self.law]]:
            return None
        found = " and ".join(stated) or "neither"
        return f'expected {{ law = "{self.law}", {LAWS[self.law]} = … }}, found {found}'

    @property
    def number(self) -> float:
        """Exponent or roughness length [m]."""
        return getattr(self, LAWS[self.law])

    def factor(self, hub_height_m: float, wind_height_m: float) -> float:
        """Ratio [1] of the wind speed at hub height to the wind speed at the height of the weather's wind."""
        if self.law == "power":
            return (hub_height_m / wind_height_m) ** self.number
        return math.log(hub_height_m / self.number) / math.log(wind_height_m / self.number)


@dataclass(frozen=True)
class PowerCurve:
    """A file of a power curve: the power over the wind speed at hub height; the weather's wind is given at
    the height `wind_height_m`."""

    rated_power_kW: float = setting(help="the rated power of the turbine", above=0.0)
    wind_speed_m_s: tuple[float, ...] = setting(help="speeds at hub height, rising", least=0.0)
    power_kW: tuple[float, ...] = setting(help="the power at these speeds", least=0.0)
    hub_height_m: float = setting(help="the height of the hub", above=0.0)
    wind_height_m: float = setting(help="the height of the weather's wind", above=0.0)
    shear: Shear = setting(help="how the wind grows with height")

    @across("wind_speed_m_s", "power_kW")
    def lengths(self) -> str | None:
        count, other = len(self.wind_speed_m_s), len(self.power_kW)
        if count == other and count > 1:
            return None
        return f"wind_speed_m_s and power_kW: expected as many numbers, 2 at least, found {count} and {other}"

    @across("wind_speed_m_s")
    def speeds(self) -> str | None:
        speed = self.wind_speed_m_s
        if not all(a < b for a, b in itertools.pairwise(speed)):
            return "wind_speed_m_s: expected rising numbers"
        if speed and max(speed) > FASTEST_M_S:
            return (
                f"wind_speed_m_s: expected speeds up to {FASTEST_M_S:g} m/s, found {max(speed):g}; are they "
                "in km/h? divide by 3.6"
            )
        return None

    @across("power_kW", "rated_power_kW")
    def powers(self) -> str | None:
        highest = max(self.power_kW, default=0.0)
        if RATED[0] <= highest / self.rated_power_kW <= RATED[1]:
            return None
        return (
            f"power_kW: expected a curve that reaches about rated_power_kW = {self.rated_power_kW:g}, "
            f"found {highest:g} at most; are both in kW? correct one of them"
        )

    @across("shear", "hub_height_m", "wind_height_m")
    def roughness(self) -> str | None:
        if self.shear.law == "power" or self.shear.number < min(self.hub_height_m, self.wind_height_m):
            return None
        return f"shear: roughness_m must be below both heights, found {self.shear.number:g}"

    @property
    def rated_power_W(self) -> float:
        """Rated power [W] of the turbine."""
        return 1e3 * self.rated_power_kW

    @property
    def factor(self) -> float:
        """Wind speed at hub height over that at the height of the weather's wind [1]."""
        return self.shear.factor(self.hub_height_m, self.wind_height_m)

    def power(self, wind_speed: np.ndarray) -> np.ndarray:
        """Power [W] of the wind speeds [m/s] that the weather has; NaN stays NaN, 0 beyond the ends of the
        curve."""
        hub = np.asarray(wind_speed, dtype=float) * self.factor
        found = np.interp(hub, self.wind_speed_m_s, 1e3 * np.array(self.power_kW), left=0.0, right=0.0)
        return np.where(np.isnan(hub), np.nan, found)

    @property
    def statement(self) -> Statement:
        """How the curve turns the weather's wind into power."""
        if self.shear.law == "power":
            law = ClimateCode.POWER_LAW(exponent=self.shear.number)
        else:
            law = ClimateCode.LOGARITHMIC_LAW(roughness_m=self.shear.number)
        heights = {"wind_height_m": self.wind_height_m, "hub_height_m": self.hub_height_m}
        return ClimateCode.POWER_BY_CURVE(**heights, law=law, factor=self.factor)


def power_from_wind(curve: PowerCurve, record: Record) -> Series:
    """Power [W], hour by hour, from the wind of a weather record; raises PowerFault where the record has no
    wind, or wind at another height."""
    if "wind_speed" not in record:
        raise PowerFault(
            f"{record.name}: expected a wind speed for the power curve, found {', '.join(record.signals)}; "
            "add the weather's wind, or name --power or --standstill"
        )
    wind = record["wind_speed"]
    height = wind.height_m
    if height is not None and abs(curve.wind_height_m / height - 1.0) > SAME_HEIGHT:
        raise PowerFault(
            f"{record.name}: its wind is that at {height:g} m, the power curve has wind_height_m = "
            f"{curve.wind_height_m:g}; write wind_height_m = {height:g} into the curve's file"
        )
    middle = centred(wind)
    ends = _hours(record)
    value = at_times(middle, ends - 0.5 * HOUR_S, bridge_h(middle, WIND_BRIDGE_H))
    return _hourly_power(ends, curve.power(value), wind.source)


def years_of_power(power: Series) -> int:
    """Whole years that a record of power has, one at least."""
    first, last = power.time[0] - power.interval_s, power.time[-1]
    return max(1, int(np.floor((last - first) / YEAR_S + 0.05)))


def covers(series: Series, record: Record) -> bool:
    """Whether a series is known over the time of a weather record, give or take two days."""
    first, last = series.time[0] - series.interval_s, series.time[-1]
    return first <= record.start_s + 2 * DAY_S and last >= record.end_s - 2 * DAY_S


def power_by_season(power: Series, record: Record) -> tuple[Series, Statement]:
    """Power [W], hour by hour, for a weather record, and a statement on how it was taken.

    A record that covers the weather's time is taken as it is.  From a record of other years each hour takes
    the power of the same hour and (within a day) the same day of the year, its years in turn; days of the
    year that the record lacks are unknown (NaN).
    """
    first, last = power.time[0] - power.interval_s, power.time[-1]
    if covers(power, record):
        return power, ClimateCode.POWER_BY_RECORD()
    if last - first < 0.95 * YEAR_S:
        raise PowerFault(
            f"{power.source}: expected power over the weather's time or over a whole year, found "
            f"{(last - first) / DAY_S:.0f} days of other times; use --power-curve, or a longer record"
        )
    ends = _hours(record)
    whole = years_of_power(power)
    # whole days are moved, so that the hour of the day stays; leap days never add up to more than a part of a
    # day
    back = DAY_S * np.round(np.floor((ends - first) / (whole * YEAR_S)) * whole * YEAR_S / DAY_S)
    at = ends - back
    at += DAY_S * (at <= first)
    at -= DAY_S * ((at > last) & (at <= last + DAY_S))
    value = np.where(at > last, np.nan, at_times(power, at, 1.0))
    used = _used(at[np.isfinite(value)], float(first), float(last))
    statement = ClimateCode.POWER_BY_SEASON(length=in_years(whole), used=used)
    return _hourly_power(ends, value, power.source), statement


def in_years(count: int) -> Statement:
    """The length of some years."""
    return ClimateCode.ONE_YEAR() if count == 1 else ClimateCode.MANY_YEARS(years=count)


def _used(at: np.ndarray, first: float, last: float) -> Statement:
    """Which part of a record of power from `first` to `last` [s] was used, given the hours [s] taken."""
    hours = np.unique(at)
    if not len(hours):
        return ClimateCode.POWER_UNKNOWN()
    turns = np.flatnonzero(np.diff(hours) > UNUSED_S)
    begins, ends = hours[np.append(0, turns + 1)] - HOUR_S, hours[np.append(turns, len(hours) - 1)]
    spans = list(zip(begins, ends, strict=True))
    told = [span for span in spans if span[1] - span[0] > UNUSED_S] or spans
    stated = tuple(ClimateCode.POWER_SPAN(first=float(a), last=float(b)) for a, b in told)
    if (last - first) - float(np.sum(ends - begins)) <= UNUSED_S:
        return ClimateCode.POWER_ALL_USED(spans=stated)
    return ClimateCode.POWER_PARTLY_USED(spans=stated, first=first, last=last)


def standstill(record: Record) -> Series:
    """No power at all, over the whole of a weather record."""
    ends = _hours(record)
    return _hourly_power(ends, np.zeros(len(ends)), "standstill")


def _hours(record: Record) -> np.ndarray:
    """Ends of whole hours [s] over a weather record."""
    first = np.floor(record.start_s / HOUR_S)
    return HOUR_S * np.arange(first, np.ceil(record.end_s / HOUR_S) + 1.0)


def _hourly_power(ends: np.ndarray, value: np.ndarray, source: str) -> Series:
    return Series("active_power", ends, value, interval_s=HOUR_S, source=source)


DUTIES = ("preheating", *ACTUATORS)
"""Signals of what is switched in a cabinet; they go with the power."""
TYPICAL_YEAR = 2001
"""Calendar year in which a typical year, whose months are from several years, is placed; without 29
February."""


@dataclass(frozen=True)
class Region:
    """Weather of one place under its name, as a record; `files` that it was read from, and `statements` on
    how."""

    name: str
    weather: Record
    files: tuple[str, ...] = ()
    statements: tuple[Statement, ...] = ()


def read_region(
    name: str, files: Sequence[str | os.PathLike[str]], power: Record | PowerCurve | None = None
) -> Region:
    """The weather of one region: weather files, put after each other, or one case file with ambient
    signals.

    A typical year is placed in `TYPICAL_YEAR`; with a record of `power` it is repeated once for each year of
    power, so that every one is used.  Raises PowerFault, CaseFault, TableFault.
    """
    paths = [Path(file) for file in files]
    cases = [path.name for path in paths if path.suffix == ".toml"]
    if cases and len(paths) > 1:
        raise PowerFault(
            f"{name}: expected weather files, or one case file (.toml) alone, found "
            f"{', '.join(one.name for one in paths)}"
        )
    statements: tuple[Statement, ...] = ()
    if cases:
        weather = read_case(paths[0], cabinet=False)
    else:
        typical = len(paths) == 1 and weather_format(paths[0]) in TYPICAL
        years = years_of_power(power["active_power"]) if typical and isinstance(power, Record) else 1
        weather = read_weather(paths, year=TYPICAL_YEAR if typical else None, years=years)
        if years > 1:
            statements = (ClimateCode.TYPICAL_YEAR_REPEATED(years=years),)
    return Region(name, weather, tuple(path.name for path in paths), statements)


def read_power(path: str | os.PathLike[str]) -> Record:
    """The record of a case file that has active power; of other signals pre-heating and logged actuators are
    kept.

    Raises CaseFault, PowerFault.
    """
    record = read_case(path, cabinet=False, ambient=False)
    if "active_power" not in record:
        raise PowerFault(
            f"{path}: expected a case file with signals.active_power, found {', '.join(record.signals)}"
        )
    return replace(record, series=tuple(record[name] for name in ("active_power", *DUTIES) if name in record))


def driven(fit: Fit, weather: Record, power: Record | PowerCurve | None) -> tuple[Record, list[Statement]]:
    """Weather and power as a record for a fit's model, and statements on how they were combined.

    `power`: a record of it, a power curve, or None for standstill all year.  The record's pre-heating and
    actuators are used where its power is taken hour by hour; else they are off.  Power, cabinet and
    actuators in the weather's own record are ignored.  Raises PowerFault where there is no usable power.
    """
    statements: list[Statement] = []
    kept = [s for s in weather.series if not s.signal.startswith(("cabinet_", "active_power", *DUTIES))]
    series: list[Series] = []
    if fit.design.power_scale_W is None:
        statements.append(ClimateCode.NO_POWER_INPUT())
    elif power is None:
        series.append(standstill(weather))
        statements.append(ClimateCode.NO_POWER_ALL_YEAR())
    else:
        if isinstance(power, PowerCurve):
            taken, statement = power_from_wind(power, weather), power.statement
        else:
            taken, statement = power_by_season(power["active_power"], weather)
        series.append(taken)
        statements += [statement, *_rated_differently(fit, power.rated_power_W)]
    for name in DUTIES:
        if name in fit.design.model.inputs:
            duty, statement = _duty(name, weather, power if isinstance(power, Record) else None)
            series.append(duty)
            statements.append(statement)
    return replace(weather, series=(*map(_hourly, kept), *series), until_s=None), statements


def _duty(name: str, weather: Record, power: Record | None) -> tuple[Series, Statement]:
    """The course of pre-heating or of an actuator over a weather record, and a statement on its source."""
    words = name.replace("preheating", "pre-heating")
    if power is not None and name in power and covers(power["active_power"], weather):
        if covers(power[name], weather):
            return power[name], ClimateCode.ACTUATOR_BY_RECORD(actuator=words)
    recorded = power is not None and name in power
    code = ClimateCode.ACTUATOR_NOT_COVERED if recorded else ClimateCode.ACTUATOR_NOT_RECORDED
    off = replace(standstill(weather), signal=name, source="off")
    return off, code(actuator=words)


def _rated_differently(fit: Fit, rated_W: float | None) -> list[Statement]:
    scale = fit.design.power_scale_W
    if rated_W is None or scale is None or abs(rated_W / scale - 1.0) < 0.1:
        return []
    return [ClimateCode.RATED_DIFFERENTLY(rated_kW=rated_W / 1e3, scale_kW=scale / 1e3)]


def _hourly(series: Series) -> Series:
    """Weather that is rarer than hourly, interpolated linearly to hours, so that statistics are hourly."""
    middle = input_path(series)
    steps = series.steps_s
    if not len(steps) or steps[len(steps) // 2] <= 1.01 * HOUR_S:
        return series
    time = np.arange(np.ceil(middle.time[0] / HOUR_S), np.floor(middle.time[-1] / HOUR_S) + 1.0) * HOUR_S
    return replace(middle, time=time, value=at_times(middle, time, bridge_h(middle, AMBIENT_BRIDGE_H)))
