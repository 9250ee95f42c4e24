"""A region: its weather files, and the record of weather and power that drives a model; the power comes from
a record, from the wind by a power curve, or is zero."""

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
"""[m/s] a power curve with higher wind speeds must be in another unit."""
UNUSED_S = 30.0 * DAY_S
"""[s] an unused part of a power record is stated if it is longer than this."""
SAME_HEIGHT = 0.05
"""[1] two heights of the wind that differ by a smaller share count as the same."""
WIND_BRIDGE_H = 6.0
"""[h] longest gap of the wind speed that is interpolated."""
RATED = (0.5, 1.2)
"""[1] limits of a power curve's highest power over the rated power."""
LAWS = {"power": "exponent", "log": "roughness_m"}


class PowerFault(HygrokfError):
    """A record of power, or weather for a power curve, that cannot be used; with every reason."""


@dataclass(frozen=True)
class Shear:
    """How the wind speed grows with height: law "power": v_hub = v (z_hub/z)^exponent; law "log": v_hub = v
    ln(z_hub/roughness)/ln(z/roughness)."""

    law: str = setting(help="power: v ∝ z^exponent; log: v ∝ ln(z/roughness_m)", choices=tuple(LAWS))
    exponent: float | None = setting(None, "of the power law", least=-0.5, most=1.0)
    roughness_m: float | None = setting(None, "of the logarithmic law", above=0.0)

    @across("law", "exponent", "roughness_m")
    def number_of_law(self) -> str | None:
        """Return a fault unless exactly the number of the stated law is given."""
        stated = [name for name in LAWS.values() if getattr(self, name) is not None]
        if stated == [LAWS[self.law]]:
            return None
        found = " and ".join(stated) or "neither"
        return f'expected {{ law = "{self.law}", {LAWS[self.law]} = … }}, found {found}'

    @property
    def number(self) -> float:
        """The exponent [1], or the roughness length [m]."""
        return getattr(self, LAWS[self.law])

    def factor(self, hub_height_m: float, wind_height_m: float) -> float:
        """Return the wind speed at hub height over that at the height of the weather's wind [1]."""
        if self.law == "power":
            return (hub_height_m / wind_height_m) ** self.number
        return math.log(hub_height_m / self.number) / math.log(wind_height_m / self.number)


@dataclass(frozen=True)
class PowerCurve:
    """A power curve, as in its file: power over the wind speed at hub height; `wind_height_m`: height of the
    weather's wind [m]."""

    rated_power_kW: float = setting(help="the rated power of the turbine", above=0.0)
    wind_speed_m_s: tuple[float, ...] = setting(help="speeds at hub height, rising", least=0.0)
    power_kW: tuple[float, ...] = setting(help="the power at these speeds", least=0.0)
    hub_height_m: float = setting(help="the height of the hub", above=0.0)
    wind_height_m: float = setting(help="the height of the weather's wind", above=0.0)
    shear: Shear = setting(help="how the wind grows with height")

    @across("wind_speed_m_s", "power_kW")
    def lengths(self) -> str | None:
        """Return a fault unless there are as many powers as wind speeds, and at least two."""
        count, other = len(self.wind_speed_m_s), len(self.power_kW)
        if count == other and count > 1:
            return None
        return f"wind_speed_m_s and power_kW: expected as many numbers, 2 at least, found {count} and {other}"

    @across("wind_speed_m_s")
    def speeds(self) -> str | None:
        """Return a fault if the wind speeds do not rise, or look like km/h."""
        speed = self.wind_speed_m_s
        if not all(lower < higher for lower, higher in itertools.pairwise(speed)):
            return "wind_speed_m_s: expected rising numbers"
        if speed and max(speed) > FASTEST_M_S:
            return (
                f"wind_speed_m_s: expected speeds up to {FASTEST_M_S:g} m/s, found {max(speed):g}; are they "
                "in km/h? divide by 3.6"
            )
        return None

    @across("power_kW", "rated_power_kW")
    def powers(self) -> str | None:
        """Return a fault if the highest power does not suit the rated power."""
        highest = max(self.power_kW, default=0.0)
        if RATED[0] <= highest / self.rated_power_kW <= RATED[1]:
            return None
        return (
            f"power_kW: expected a curve that reaches about rated_power_kW = {self.rated_power_kW:g}, "
            f"found {highest:g} at most; are both in kW? correct one of them"
        )

    @across("shear", "hub_height_m", "wind_height_m")
    def roughness(self) -> str | None:
        """Return a fault if the roughness length is not below both heights."""
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
        """Return the power [W] at wind speeds [m/s] of the weather; NaN stays NaN; 0 beyond the ends of the
        curve."""
        hub_speed = np.asarray(wind_speed, dtype=float) * self.factor
        power_W = np.interp(
            hub_speed, self.wind_speed_m_s, 1e3 * np.array(self.power_kW), left=0.0, right=0.0
        )
        return np.where(np.isnan(hub_speed), np.nan, power_W)

    @property
    def statement(self) -> Statement:
        """The statement on how the curve turns the weather's wind into power."""
        if self.shear.law == "power":
            law = ClimateCode.POWER_LAW(exponent=self.shear.number)
        else:
            law = ClimateCode.LOGARITHMIC_LAW(roughness_m=self.shear.number)
        heights = {"wind_height_m": self.wind_height_m, "hub_height_m": self.hub_height_m}
        return ClimateCode.POWER_BY_CURVE(**heights, law=law, factor=self.factor)


def power_from_wind(curve: PowerCurve, record: Record) -> Series:
    """Return the power [W], hour by hour, from the wind of a weather record. Raises PowerFault if the record
    has no wind, or wind at another height."""
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
    centred_wind = centred(wind)
    ends = _hours(record)
    value = at_times(centred_wind, ends - 0.5 * HOUR_S, bridge_h(centred_wind, WIND_BRIDGE_H))
    return _hourly_power(ends, curve.power(value), wind.source)


def years_of_power(power: Series) -> int:
    """Return the number of whole years that a record of power covers, at least 1."""
    first, last = power.time[0] - power.interval_s, power.time[-1]
    return max(1, int(np.floor((last - first) / YEAR_S + 0.05)))


def covers(series: Series, record: Record) -> bool:
    """Return whether a series covers the time of a weather record, up to two days at either end."""
    first, last = series.time[0] - series.interval_s, series.time[-1]
    return first <= record.start_s + 2 * DAY_S and last >= record.end_s - 2 * DAY_S


def power_by_season(power: Series, record: Record) -> tuple[Series, Statement]:
    """Return the power [W], hour by hour, for a weather record, and a statement on where it was taken from.

    A power record that covers the weather's time is used as it is. Of a record of other years, each hour
    takes the power at the same hour of the day and (within a day) the same day of the year, its years in
    turn; days of the year that the record lacks are unknown (NaN). Raises PowerFault for a record of less
    than a year.
    """
    first_s, last_s = power.time[0] - power.interval_s, power.time[-1]
    if covers(power, record):
        return power, ClimateCode.POWER_BY_RECORD()
    if last_s - first_s < 0.95 * YEAR_S:
        raise PowerFault(
            f"{power.source}: expected power over the weather's time or over a whole year, found "
            f"{(last_s - first_s) / DAY_S:.0f} days of other times; use --power-curve, or a longer record"
        )
    ends = _hours(record)
    years = years_of_power(power)
    # whole days are moved, so that the hour of the day stays; leap days never add up to more than a part of a
    # day
    shift_s = DAY_S * np.round(np.floor((ends - first_s) / (years * YEAR_S)) * years * YEAR_S / DAY_S)
    source_time = ends - shift_s
    source_time += DAY_S * (source_time <= first_s)
    source_time -= DAY_S * ((source_time > last_s) & (source_time <= last_s + DAY_S))
    value = np.where(source_time > last_s, np.nan, at_times(power, source_time, 1.0))
    statement_on_use = _used(source_time[np.isfinite(value)], float(first_s), float(last_s))
    statement = ClimateCode.POWER_BY_SEASON(length=in_years(years), used=statement_on_use)
    return _hourly_power(ends, value, power.source), statement


def in_years(count: int) -> Statement:
    """Return the statement of a number of years."""
    return ClimateCode.ONE_YEAR() if count == 1 else ClimateCode.MANY_YEARS(years=count)


def _used(hours_taken: np.ndarray, first_s: float, last_s: float) -> Statement:
    """Return the statement on which part of a power record from `first_s` to `last_s` was used; hours_taken:
    [s] the hours that were taken from it."""
    used_hours = np.unique(hours_taken)
    if not len(used_hours):
        return ClimateCode.POWER_UNKNOWN()
    gap_starts = np.flatnonzero(np.diff(used_hours) > UNUSED_S)
    begins, ends = (
        used_hours[np.append(0, gap_starts + 1)] - HOUR_S,
        used_hours[np.append(gap_starts, len(used_hours) - 1)],
    )
    spans = list(zip(begins, ends, strict=True))
    long_spans = [span for span in spans if span[1] - span[0] > UNUSED_S] or spans
    span_statements = tuple(
        ClimateCode.POWER_SPAN(first=float(start), last=float(end)) for start, end in long_spans
    )
    if (last_s - first_s) - float(np.sum(ends - begins)) <= UNUSED_S:
        return ClimateCode.POWER_ALL_USED(spans=span_statements)
    return ClimateCode.POWER_PARTLY_USED(spans=span_statements, first=first_s, last=last_s)


def standstill(record: Record) -> Series:
    """Return a power of zero over the whole of a weather record."""
    ends = _hours(record)
    return _hourly_power(ends, np.zeros(len(ends)), "standstill")


def _hours(record: Record) -> np.ndarray:
    """Return the ends of all whole hours [s] of a weather record."""
    first = np.floor(record.start_s / HOUR_S)
    return HOUR_S * np.arange(first, np.ceil(record.end_s / HOUR_S) + 1.0)


def _hourly_power(ends: np.ndarray, value: np.ndarray, source: str) -> Series:
    """Return hourly means of the power [W] as a series; ends: of the hours [s]."""
    return Series("active_power", ends, value, interval_s=HOUR_S, source=source)


DUTIES = ("preheating", *ACTUATORS)
"""Signals of pre-heating and actuators in a cabinet; they are taken from the record of the power."""
TYPICAL_YEAR = 2001
"""Calendar year in which a typical year, whose months are from several years, is placed; without 29
February."""


@dataclass(frozen=True)
class Region:
    """The weather of one place as a record; `files` that it was read from, and `statements` on how it was
    read."""

    name: str
    weather: Record
    files: tuple[str, ...] = ()
    statements: tuple[Statement, ...] = ()


def read_region(
    name: str, files: Sequence[str | os.PathLike[str]], power: Record | PowerCurve | None = None
) -> Region:
    """Read the weather of one region: several weather files in sequence, or one case file with ambient
    signals.

    A typical year is placed in `TYPICAL_YEAR`; with a record of `power` it is repeated for each year of this
    record, so that all its years are used. Raises PowerFault, CaseFault, TableFault.
    """
    paths = [Path(file) for file in files]
    cases = [path.name for path in paths if path.suffix == ".toml"]
    if cases and len(paths) > 1:
        raise PowerFault(
            f"{name}: expected weather files, or one case file (.toml) alone, found "
            f"{', '.join(path.name for path in paths)}"
        )
    statements: tuple[Statement, ...] = ()
    if cases:
        weather = read_case(paths[0], cabinet=False)
    else:
        is_typical = len(paths) == 1 and weather_format(paths[0]) in TYPICAL
        years = years_of_power(power["active_power"]) if is_typical and isinstance(power, Record) else 1
        weather = read_weather(paths, year=TYPICAL_YEAR if is_typical else None, years=years)
        if years > 1:
            statements = (ClimateCode.TYPICAL_YEAR_REPEATED(years=years),)
    return Region(name, weather, tuple(path.name for path in paths), statements)


def read_power(path: str | os.PathLike[str]) -> Record:
    """Read the power, pre-heating and logged actuators of a case file.

    Raises CaseFault, PowerFault.
    """
    record = read_case(path, cabinet=False, ambient=False)
    if "active_power" not in record:
        raise PowerFault(
            f"{path}: expected a case file with signals.active_power, found {', '.join(record.signals)}"
        )
    return replace(record, series=tuple(record[name] for name in ("active_power", *DUTIES) if name in record))


def driven(fit: Fit, weather: Record, power: Record | PowerCurve | None) -> tuple[Record, list[Statement]]:
    """Return weather and power as one record for a fit's model, and statements on how they were combined.

    power: a record, a power curve, or None for standstill all year. Pre-heating and actuators of the power's
        record are used if its power is taken hour by hour; otherwise they are off. Power, cabinet and
        actuators in the weather's own record are ignored. Raises PowerFault if there is no usable power.
    """
    statements: list[Statement] = []
    weather_series = [
        series_of_weather
        for series_of_weather in weather.series
        if not series_of_weather.signal.startswith(("cabinet_", "active_power", *DUTIES))
    ]
    series: list[Series] = []
    if fit.design.power_scale_W is None:
        statements.append(ClimateCode.NO_POWER_INPUT())
    elif power is None:
        series.append(standstill(weather))
        statements.append(ClimateCode.NO_POWER_ALL_YEAR())
    else:
        if isinstance(power, PowerCurve):
            power_series, statement = power_from_wind(power, weather), power.statement
        else:
            power_series, statement = power_by_season(power["active_power"], weather)
        series.append(power_series)
        statements += [statement, *_rated_differently(fit, power.rated_power_W)]
    for name in DUTIES:
        if name in fit.design.model.inputs:
            duty_series, statement = _duty(name, weather, power if isinstance(power, Record) else None)
            series.append(duty_series)
            statements.append(statement)
    return replace(weather, series=(*map(_hourly, weather_series), *series), until_s=None), statements


def _duty(name: str, weather: Record, power: Record | None) -> tuple[Series, Statement]:
    """Return pre-heating or an actuator over a weather record, and a statement on its source."""
    name_in_words = name.replace("preheating", "pre-heating")
    if power is not None and name in power and covers(power["active_power"], weather):
        if covers(power[name], weather):
            return power[name], ClimateCode.ACTUATOR_BY_RECORD(actuator=name_in_words)
    is_recorded = power is not None and name in power
    code = ClimateCode.ACTUATOR_NOT_COVERED if is_recorded else ClimateCode.ACTUATOR_NOT_RECORDED
    off = replace(standstill(weather), signal=name, source="off")
    return off, code(actuator=name_in_words)


def _rated_differently(fit: Fit, rated_W: float | None) -> list[Statement]:
    """Return a statement if the rated power of the power's turbine differs from that of the fit."""
    scale_W = fit.design.power_scale_W
    if rated_W is None or scale_W is None or abs(rated_W / scale_W - 1.0) < 0.1:
        return []
    return [ClimateCode.RATED_DIFFERENTLY(rated_kW=rated_W / 1e3, scale_kW=scale_W / 1e3)]


def _hourly(series: Series) -> Series:
    """Interpolate weather with steps above an hour linearly to hours, so that all statistics are hourly."""
    path = input_path(series)
    steps = series.steps_s
    if not len(steps) or steps[len(steps) // 2] <= 1.01 * HOUR_S:
        return series
    first, last = np.ceil(path.time[0] / HOUR_S), np.floor(path.time[-1] / HOUR_S)
    time = np.arange(first, last + 1.0) * HOUR_S
    return replace(path, time=time, value=at_times(path, time, bridge_h(path, AMBIENT_BRIDGE_H)))
